"""Trains the three networks of the regressor chain on a training set."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np

from drake_oa.regressor import TARGETS, ChainWeights, Network
from drake_oa.training.dataset import Exploration, TrainingSet
from drake_oa.training.levenberg_marquardt import Schedule, initial_layers, train
from drake_oa.values import FloatArray

HIDDEN = (24, 24, 24)
"""Widths of the tanh layers, as in the paper."""

TRAIN_SHARE = 0.7
"""Share of the rows to train on, as in the paper."""


@dataclass(frozen=True)
class Score:
    """Normalised mean squared error (over the variance of the targets) of one network.

    Attributes:
        target: kappa, psi or alpha; the error is that of its logarithm.
        train: NMSE on the rows trained on.
        test: NMSE on the others.
        rows: number of rows, both together.
    """

    target: str
    train: float
    test: float
    rows: int


def train_chain(
    rows: TrainingSet,
    exploration: Exploration,
    seed: int,
    schedule: Schedule | None = None,
    *,
    commit: str = "",
    progress: Callable[[str, int, float], None] | None = None,
) -> tuple[ChainWeights, list[Score]]:
    """Trains Y1 (kappa), Y2 (psi) and Y3 (alpha), each on the true values before it.

    All three learn the logarithm of their target, which keeps it positive, and pass
    it on as such. Y1 and Y2 learn the choices; Y3 also the rows around them.

    Args:
        rows: the training set.
        exploration: what it was made with; recorded.
        seed: of the initial weights and of the split.
        schedule: of Levenberg-Marquardt.
        commit: version of the code; recorded.
        progress: told target, iteration and mean squared error.

    Returns:
        The chain with its metadata, and the score of each network.
    """
    schedule = schedule or Schedule()
    rng = np.random.default_rng(seed)
    features = np.column_stack((rows.inputs, np.log(rows.targets)))
    # A choice and the rows around it share an input: the split is by inputs.
    _, group = np.unique(rows.inputs, axis=0, return_inverse=True)
    is_train_group = rng.permutation(group.max() + 1) < TRAIN_SHARE * (group.max() + 1)
    in_train = is_train_group[group.ravel()]
    networks, scores = {}, []
    for i, name in enumerate(TARGETS):
        use = np.ones(len(features), dtype=bool) if name == "alpha" else rows.chosen
        x, y, mask = features[use, : 4 + i], features[use, 4 + i], in_train[use]
        network = _train_network(
            x[mask],
            y[mask],
            rng,
            schedule,
            partial(progress, name) if progress else None,
        )
        prediction = network.evaluate(np.vstack((x.T, np.ones(len(x)))))
        scores.append(
            Score(
                name,
                _nmse(y[mask], prediction[mask]),
                _nmse(y[~mask], prediction[~mask]),
                len(y),
            )
        )
        networks[name] = network
    chosen = rows.inputs[rows.chosen]
    metadata = _metadata(rows, exploration, seed, schedule, scores, commit)
    return (
        ChainWeights(
            networks,
            chosen.min(axis=0),
            chosen.max(axis=0),
            np.ones(4),
            frozenset(TARGETS),
            rows.limit,
            metadata,
        ),
        scores,
    )


def _nmse(y: FloatArray, prediction: FloatArray) -> float:
    return float(np.mean((y - prediction) ** 2) / np.var(y))


def _train_network(
    x: FloatArray,
    y: FloatArray,
    rng: np.random.Generator,
    schedule: Schedule,
    progress: Callable[[int, float], None] | None,
) -> Network:
    low, high = x.min(axis=0), x.max(axis=0)
    out_low, out_high = float(y.min()), float(y.max())
    gain, out_gain = 2.0 / (high - low), 2.0 / (out_high - out_low)
    scaled, target = (x - low) * gain - 1.0, (y - out_low) * out_gain - 1.0
    layers = initial_layers([x.shape[1], *HIDDEN, 1], rng)
    layers = train(layers, scaled, target, schedule, progress)
    weights, biases = zip(*layers, strict=True)
    return Network(weights, biases, low, gain, out_low, out_gain)


def _metadata(
    rows: TrainingSet,
    exploration: Exploration,
    seed: int,
    schedule: Schedule,
    scores: list[Score],
    commit: str,
) -> dict[str, Any]:
    explored = {
        name: value.tolist() if isinstance(value, np.ndarray) else value
        for name, value in vars(exploration).items()
    }
    return {
        "format": "drake_oa regressor chain 1",
        "inputs": "lambda1'/L, lambda2'/L (semi-axes), Delta/L, position/L",
        "units": {"kappa": "1/L^2", "psi": "rad", "alpha": "1/T"},
        "recipe": "project, first",
        "seed": seed,
        "rows": {"chosen": int(rows.chosen.sum()), "alpha": len(rows.inputs)},
        "rollouts": rows.rollouts,
        "exploration": explored,
        "training": {"hidden": list(HIDDEN), "train_share": TRAIN_SHARE, **asdict(schedule)},
        "nmse": {s.target: {"train": s.train, "test": s.test} for s in scores},
        "commit": commit,
    }
