"""Trains the three networks of the project's chain on its training set."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from drake_oa.common.files import provenance
from drake_oa.regulation.regressor import TARGETS, ChainWeights
from drake_oa.training.checkpoint import Checkpoint, Report
from drake_oa.training.dataset import Exploration, TrainingSet
from drake_oa.training.levenberg_marquardt import Schedule
from drake_oa.training.networks import (
    HIDDEN,
    TRAIN_SHARE,
    Score,
    nmse,
    predict,
    train_network,
)


def train_chain(
    rows: TrainingSet,
    exploration: Exploration,
    seed: int,
    schedule: Schedule | None = None,
    *,
    device: str = "cpu",
    checkpoint: Checkpoint | None = None,
    report: Report | None = None,
) -> tuple[ChainWeights, list[Score]]:
    """Trains Y1 (kappa), Y2 (psi) and Y3 (alpha), each on the true values before it.

    All three learn the logarithm of their target, which keeps it positive, and pass
    it on as such. Y1 and Y2 learn the choices; Y3 also the rows around them.

    Args:
        rows: the training set.
        exploration: what it was made with; recorded.
        seed: of the initial weights and of the split.
        schedule: of Levenberg-Marquardt.
        device: of torch, "cpu" or "cuda".
        checkpoint: where to keep each iteration, and to go on from.
        report: told how far it is.

    Returns:
        The chain with its metadata, and the score of each network.
    """
    schedule = schedule or Schedule()
    features = np.column_stack((rows.inputs, np.log(rows.targets)))
    # A choice and the rows around it share an input: the split is by inputs.
    _, group = np.unique(rows.inputs, axis=0, return_inverse=True)
    rank = np.random.default_rng((seed, 0)).permutation(group.max() + 1)
    in_train = (rank < TRAIN_SHARE * len(rank))[group.ravel()]
    networks, scores = {}, []
    for i, name in enumerate(TARGETS):
        use = np.ones(len(features), dtype=bool) if name == "alpha" else rows.chosen
        x, y, mask = features[use, : 4 + i], features[use, 4 + i], in_train[use]
        networks[name] = train_network(
            name,
            x[mask],
            y[mask],
            schedule,
            seed=(seed, 1, i),
            device=device,
            checkpoint=checkpoint,
            report=report,
        )
        guess = predict(networks[name], x)
        scores.append(Score(name, nmse(y, guess, mask), nmse(y, guess, ~mask), len(y)))
    chosen = rows.inputs[rows.chosen]
    lower, upper = chosen.min(axis=0), chosen.max(axis=0)
    metadata = _metadata(rows, exploration, seed, schedule, scores)
    metadata["ranges"] = {"lower": lower.tolist(), "upper": upper.tolist()}
    return (
        ChainWeights(networks, lower, upper, np.ones(4), frozenset(TARGETS), rows.limit, metadata),
        scores,
    )


def _metadata(
    rows: TrainingSet,
    exploration: Exploration,
    seed: int,
    schedule: Schedule,
    scores: list[Score],
) -> dict[str, Any]:
    return {
        "inputs": "lambda1'/L, lambda2'/L (semi-axes), Delta/L, position/L",
        "units": {"kappa": "1/L^2", "psi": "rad", "alpha": "1/T"},
        "recipe": "project",
        "seed": seed,
        "rows": {"chosen": int(rows.chosen.sum()), "alpha": len(rows.inputs)},
        "rollouts": rows.rollouts,
        "exploration": exploration.settings(),
        "training": {"hidden": list(HIDDEN), "train_share": TRAIN_SHARE, **asdict(schedule)},
        "nmse": {s.target: {"train": s.train, "test": s.test} for s in scores},
        **provenance(),
    }


def score_table(scores: list[Score]) -> str:
    """Markdown table of the networks' normalised mean squared errors."""
    lines = ["| target | NMSE train | NMSE test | rows |", "|---|---|---|---|"]
    lines += [f"| ln {s.target} | {s.train:.2g} | {s.test:.2g} | {s.rows:,} |" for s in scores]
    return "\n".join(lines)
