"""How often the motions that a chain's parameters lead to keep what is asked: measured, and fitted.

Scenes of one ellipsoid are drawn whose section lies inside or outside of the range that the chain
was trained for, centred on the baseline or beside it; half of them are turned, so that neither the
section's axes nor what stands out of the plane is known. The running system's action level goes
each with what the chain proposes, and it has kept what is asked or not. A network is fitted to that
by the logarithmic score, which is least for the true probability, and put to scenes of another
draw.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import nn

from drake_oa.common.messages import BoolArray, FloatArray, IntArray
from drake_oa.geometry.ellipsoid import shape_matrix
from drake_oa.policy.coupling import ALPHA, KAPPA, N_COLUMNS, NORMAL, PSI
from drake_oa.policy.dmp import ALPHA_X
from drake_oa.regulation.confidence import MISSED, N_INPUTS, SHORT, Confidence
from drake_oa.regulation.network import Network
from drake_oa.regulation.regressor import ChainWeights
from drake_oa.regulation.rollout import SpatialScenes, spatial_rollouts
from drake_oa.training.checkpoint import Report
from drake_oa.training.networks import HIDDEN, Perceptron
from drake_oa.training.rollouts import STEPS, straight_dmp

LOWER = np.array([0.005, 0.005, 0.0, -0.2, 0.0])
UPPER = np.array([0.6, 0.6, 0.5, 1.2, 0.6])
"""What is measured: extents, clearance, place along the baseline, beside it; in baselines."""

_BEYOND, _ALONG, _BESIDE = 1.4, (0.3, 0.7), 0.4
"""Of the half of the scenes that are like those in use: how far beyond the chain's range the
greatest sections are, and places."""
_LEAST_AXIS = 0.1
"""Of an ellipsoid's semi-axes the least over the greatest, before its section is stretched."""

_ROLLED = 4000


@dataclass(frozen=True)
class ConfidenceRecipe:
    """How the confidence is measured and fitted.

    Attributes:
        scenes: scenes to fit to.
        held_out: scenes to judge it by.
        end: s at which a motion has to have arrived.
        epochs: passes over the scenes.
        batch: scenes a step.
        rate: first step length of Adam; it falls to 0 along a cosine.
    """

    scenes: int = 120_000
    held_out: int = 30_000
    end: float = 1.25
    epochs: int = 60
    batch: int = 2000
    rate: float = 0.01


class Scenes(NamedTuple):
    """N scenes and what became of them: descriptors (N, 5), whether kept, whether in range (N,)."""

    descriptor: FloatArray
    kept: BoolArray
    in_range: BoolArray


class Calibration(NamedTuple):
    """How well B bins of stated probability agree with what happened.

    stated (B,) mean probability, happened (B,) share kept, scenes (B,) number, of each bin that has
    any; error, the expected calibration error (mean |stated - happened| over the scenes); brier,
    the mean squared error of the probability.
    """

    stated: FloatArray
    happened: FloatArray
    scenes: IntArray
    error: float
    brier: float


def draw_scenes(
    chain: ChainWeights,
    count: int,
    seed: tuple[int, ...],
    end: float = 1.25,
    report: Report | None = None,
) -> Scenes:
    """Draws scenes and rolls out what the chain proposes, with the fade that it is for.

    Args:
        chain: of the running system's action level.
        count: number of scenes.
        seed: of the draw.
        end: s at which a motion has to have arrived.
        report: told how far it is.

    Raises:
        ValueError: for a chain of another action level, or one that is not asked for a clearance.
    """
    unit = chain.metadata.get("units", {}).get("alpha", "1/T")
    if unit != "1/T" or len(chain.lower) < 3:
        raise ValueError(
            "the confidence is measured on the running system's action level, for chains that a "
            f"clearance is asked of; this one counts alpha in {unit} and has {len(chain.lower)} "
            "inputs: train one with --recipe paper_running or project"
        )
    rng = np.random.default_rng(seed)
    descriptor = rng.uniform(LOWER, UPPER, (count, N_INPUTS))
    trained = rng.random(count) < 0.5
    number = int(trained.sum())
    most = np.minimum(_BEYOND * chain.upper[:3], UPPER[:3])
    descriptor[trained, :3] = rng.uniform(chain.lower[:3], most, (number, 3))
    descriptor[trained, 3] = rng.uniform(*_ALONG, number)
    # The nearer the baseline, the denser.
    descriptor[trained, 4] = _BESIDE * rng.random(number) ** 2
    R_WO, semi_axes = _with_sections(descriptor[:, :2], rng)
    fade = float(chain.metadata.get("exploration", {}).get("fade", 0.0))
    kept, in_range = np.empty(count, dtype=bool), np.empty(count, dtype=bool)
    for begin in range(0, count, _ROLLED):
        rows = slice(begin, begin + _ROLLED)
        extents, asked, center = np.split(descriptor[rows], [2, 3], axis=1)
        found = chain.parameters(extents, asked[:, 0], 1.0, center[:, 0])
        in_range[rows] = found.in_range
        ellipsoids = (center, R_WO[rows], semi_axes[rows], asked)
        kept[rows] = _kept(ellipsoids, found.as_array(), end, fade)
        if report is not None:
            report("roll out", min(1.0, (begin + _ROLLED) / count))
    return Scenes(descriptor, kept, in_range)


def _with_sections(extents: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Ellipsoids, half of them turned, whose sections by z = 0 have the extents (N, 2).

    Returns:
        (N, 3, 3) orientations and (N, 3) semi-axes.
    """
    count = len(extents)
    R = Rotation.from_quat(rng.normal(size=(count, 4))).as_matrix()
    R[rng.random(count) < 0.5] = np.eye(3)
    # x^T G x = 1 on the surface.
    G = np.linalg.inv(shape_matrix(R, rng.uniform(_LEAST_AXIS, 1.0, (count, 3))))
    section = np.linalg.inv(G[:, :2, :2])
    stretch = np.empty((count, 3))
    stretch[:, :2] = extents / np.sqrt(np.diagonal(section, axis1=1, axis2=2))
    stretch[:, 2] = np.sqrt(stretch[:, 0] * stretch[:, 1])
    value, vector = np.linalg.eigh(G / (stretch[:, :, None] * stretch[:, None, :]))
    vector[:, :, 0] *= np.linalg.det(vector)[:, None]
    return vector, 1.0 / np.sqrt(value)


def _kept(
    ellipsoids: tuple[FloatArray, ...], parameters: FloatArray, end: float, fade: float
) -> BoolArray:
    """(N,) whether the motion from rest at 0 to x = 1, in z = 0, keeps what is asked.

    Args:
        ellipsoids: (N, 2) centres, (N, 3, 3) orientations, (N, 3) semi-axes and (N, 1) asked
            clearance.
        parameters: (N, 3) alpha, psi, kappa of the terms about them.
        end: s at the end.
        fade: as in `spatial_rollouts`.
    """
    center, R_WO, semi_axes, asked = ellipsoids
    count = len(center)
    still, p_WO = np.zeros((count, 3)), np.column_stack((center, np.zeros(count)))
    terms = np.zeros((count, N_COLUMNS))
    terms[:, :3], terms[:, NORMAL + 2] = p_WO, 1.0
    terms[:, [ALPHA, PSI, KAPPA]] = parameters
    scenes = SpatialScenes(
        p_WE=still,
        z_W=still,
        p_WG=still + (1.0, 0.0, 0.0),
        R_WL=np.tile(np.eye(3), (count, 1, 1)),
        baseline=np.ones(count),
        p_WO=p_WO[:, None],
        R_WO=R_WO[:, None],
        semi_axes=semi_axes[:, None],
        v_WO=np.zeros((count, 1, 3)),
        asked_clearance=asked,
    )
    rolled = spatial_rollouts(
        scenes,
        np.arange(count),
        terms,
        dmp=straight_dmp(ALPHA_X),
        steps=STEPS,
        end=end,
        fade=fade,
        # What falls short of that is decided.
        shortest=SHORT,
    )
    kept = ~rolled.contact & (rolled.margin >= -SHORT) & (rolled.goal_error <= MISSED)
    return np.asarray(kept)


def fit_confidence(
    scenes: Scenes, recipe: ConfidenceRecipe, seed: int, report: Report | None = None
) -> Confidence:
    """Fits the network to whether the scenes were kept; the same seed gives the same weights."""
    gain = 2.0 / (UPPER - LOWER)
    x = torch.from_numpy((scenes.descriptor - LOWER) * gain - 1.0)
    y = torch.from_numpy(scenes.kept.astype(float))
    rng = np.random.default_rng((seed, 2))
    perceptron = Perceptron(N_INPUTS, rng)
    adam = torch.optim.Adam(perceptron.parameters(), lr=recipe.rate)
    steps = recipe.epochs * -(-len(x) // recipe.batch)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(adam, steps)
    score = nn.BCEWithLogitsLoss()
    for epoch in range(recipe.epochs):
        for rows in torch.from_numpy(rng.permutation(len(x))).split(recipe.batch):
            adam.zero_grad()
            score(perceptron(x[rows]), y[rows]).backward()
            adam.step()
            schedule.step()
        if report is not None:
            report("fit", (epoch + 1) / recipe.epochs)
    weights, biases = perceptron.arrays()
    network = Network(weights, biases, LOWER, gain, 0.0, 1.0, out_min=0.0)
    return Confidence(network, LOWER, UPPER)


def calibration(probability: FloatArray, kept: BoolArray, bins: int = 10) -> Calibration:
    """Puts stated probabilities (N,) beside what happened (N,), in bins of equal width."""
    place = np.minimum((probability * bins).astype(int), bins - 1)
    count = np.bincount(place, minlength=bins)
    there = count > 0
    stated, happened = (
        np.bincount(place, values, minlength=bins)[there] / count[there]
        for values in (probability, kept.astype(float))
    )
    count = count[there]
    error = float((count * np.abs(stated - happened)).sum() / len(kept))
    return Calibration(stated, happened, count, error, float(np.mean((probability - kept) ** 2)))


def with_confidence(
    chain: ChainWeights,
    recipe: ConfidenceRecipe | None = None,
    seed: int = 0,
    report: Report | None = None,
) -> tuple[ChainWeights, dict[str, Calibration]]:
    """The chain, its networks as they are, with a measured confidence.

    Args:
        chain: of the running system's action level.
        recipe: how to measure and fit.
        seed: of the scenes and of the first weights; those that judge are drawn apart.
        report: told how far it is.

    Returns:
        The chain, and how well are calibrated, in held-out scenes: its "confidence", the
        "in_range" that it stands in for, and the "confidence, inside" and "confidence, outside" of
        the range.

    Raises:
        ValueError: as `draw_scenes` does.
    """
    recipe = recipe or ConfidenceRecipe()
    seen = draw_scenes(chain, recipe.scenes, (seed, 0), recipe.end, report)
    confidence = fit_confidence(seen, recipe, seed, report)
    judged = draw_scenes(chain, recipe.held_out, (seed, 1), recipe.end, report)
    stated = confidence.probability(judged.descriptor)
    found = {
        "confidence": calibration(stated, judged.kept),
        "in_range": calibration(judged.in_range.astype(float), judged.kept),
    }
    for name, rows in (("inside", judged.in_range), ("outside", ~judged.in_range)):
        if rows.any():
            found[f"confidence, {name}"] = calibration(stated[rows], judged.kept[rows])
    told = {
        "seed": seed,
        **asdict(recipe),
        "hidden": list(HIDDEN),
        "short": SHORT,
        "missed": MISSED,
        "held_out_scores": {n: {"ece": c.error, "brier": c.brier} for n, c in found.items()},
    }
    metadata = {**chain.metadata, "confidence": told}
    return replace(chain, confidence=confidence, metadata=metadata), found


def calibration_table(found: Mapping[str, Calibration]) -> str:
    """Markdown: how well each is calibrated, and how often what is asked was kept."""
    lines = [
        "| stated by | calibration error | Brier score | kept | scenes |",
        "|---|---|---|---|---|",
    ]
    for name, told in found.items():
        number = int(told.scenes.sum())
        kept = float((told.happened * told.scenes).sum()) / number
        lines.append(f"| {name} | {told.error:.4f} | {told.brier:.4f} | {kept:.3f} | {number:,} |")
    return "\n".join(lines)
