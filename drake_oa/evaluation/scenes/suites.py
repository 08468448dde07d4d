"""The suites: which scenes are sampled, and in which settings methods run on them.

Lengths in meters. "The paper's box": the obstacle anywhere along x between start and
goal so that its extent along x leaves 5 cm to both, its center's y and z within 0.4 m of
the baseline, semi-axes of 2.5-25 cm (along x 20 cm at most at the 0.5 m baseline); see the
paper's section on novel scenarios. Scene i has the baseline BASELINES[i mod 4], so that
any number of scenes is spread evenly.

Seeded by `numpy.random.default_rng`: the same name, count and seed give the same scenes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from drake_oa.common.config import check_choice
from drake_oa.common.messages import BoolArray, FloatArray
from drake_oa.evaluation.scenes.scenes import Scenes, Setting, make_scenes, obstacle_distance

_THIRDS = 28
"""Number of times that a segment is cut to two thirds around its nearest point."""

Draw = Callable[[Generator, int], Scenes]


def accepted(rng: Generator, count: int, draw: Draw, keep: Callable[[Scenes], BoolArray]) -> Scenes:
    """`count` scenes that `keep` accepts, from batches that `draw` proposes."""
    parts: list[Scenes] = []
    found, batch = 0, max(256, 2 * count)
    while found < count:
        proposed = draw(rng, batch)
        kept = proposed.rows(keep(proposed))
        parts.append(kept)
        found += len(kept)
        # What is missing at the rate seen so far, and a little more; never an endless batch.
        rate = max(len(kept) / batch, 1e-3)
        batch = int(np.clip(1.1 * (count - found) / rate, 256, 200_000))
    return Scenes.joined(parts).rows(slice(count))


def random_rotations(rng: Generator, count: int) -> FloatArray:
    """Draws rotations (count, 3, 3), uniform over all."""
    w, x, y, z = rng.standard_normal((4, count))
    return Rotation.from_quat(np.column_stack([x, y, z, w])).as_matrix()


def line_distance(scenes: Scenes) -> FloatArray:
    """Computes signed distances (N,) of the lines from start to goal to the obstacles [m]."""
    low, high = np.zeros((2, len(scenes), 1))
    high += 1.0
    # Along a line the distance to a convex body is convex.
    for _ in range(_THIRDS):
        third = (high - low) / 3.0
        nearer = obstacle_distance(scenes, (low + third) * scenes.goal) < obstacle_distance(
            scenes, (high - third) * scenes.goal
        )
        nearer = nearer[:, None]
        low, high = np.where(nearer, low, low + third), np.where(nearer, high - third, high)
    return obstacle_distance(scenes, 0.5 * (low + high) * scenes.goal)


BASELINES = (0.5, 1.0, 1.5, 2.0)
CLEARANCE = 0.15
"""Delta of the suites that do not vary it."""
FAMILIAR_CLEARANCES = (0.05, 0.10, 0.15, 0.20, 0.25)
MARGIN = 0.05
POINT_RADIUS = 0.025
"""Radius of the dead-zone figure's point obstacle: the smallest that was trained."""

_ASIDE = 0.4
_SEMI_AXES = (0.025, 0.25)


@dataclass(frozen=True)
class Suite:
    """A family of scenes.

    Attributes:
        sample: (generator, count) -> scenes.
        count: how many by default.
        settings: how each scene is run.
    """

    sample: Draw
    count: int
    settings: tuple[Setting, ...] = (Setting(),)


def draw_scenes(name: str, count: int | None = None, seed: int = 0) -> Scenes:
    """Draws the scenes of a suite.

    Args:
        name: of the suite.
        count: how many; None: the suite's default.
        seed: of the generator.

    Raises:
        ValueError: for an unknown name, and for `familiar` a count that is not a square.
    """
    check_choice("suite", SUITES, name)
    suite = SUITES[name]
    count = suite.count if count is None else count
    return suite.sample(np.random.default_rng(seed), count)


def _familiar(_: Generator, count: int) -> Scenes:
    """Ellipses of the training set: a lattice of semi-axes, midway on a 1 m baseline.

    Semi-axes (lambda1', lambda2') on k x k points of linspace(0.025, 0.25, k); the third
    is the second, so that every plane through the baseline shows the same ellipse.
    """
    k = math.isqrt(count)
    if k * k != count or k < 2:
        raise ValueError(
            f"familiar has a k x k lattice of ellipses: the number of scenes must be a square "
            f"of at least 4, not {count}"
        )
    lattice = np.linspace(*_SEMI_AXES, k)
    first, second = (grid.ravel() for grid in np.meshgrid(lattice, lattice, indexing="ij"))
    center = np.tile((0.5, 0.0, 0.0), (count, 1))
    return make_scenes(1.0, center, np.column_stack([first, second, second]))


def _boxed(
    rng: Generator,
    count: int,
    baseline: float,
    posed: bool = False,
    own_extent: bool = True,
) -> Scenes:
    """Proposals in the paper's box; NaN centers where the obstacle is too long for it.

    Without `own_extent` the margin is that of the longest obstacle, whatever the obstacle's own
    extent, as in the released demo program: at the 0.5 m baseline all are midway.
    """
    a = rng.uniform(*_SEMI_AXES, (count, 3))
    longest = 0.5 * baseline - MARGIN
    if longest < _SEMI_AXES[1]:
        a[:, 0] = rng.uniform(_SEMI_AXES[0], longest, count)
    R = random_rotations(rng, count) if posed else np.tile(np.eye(3), (count, 1, 1))
    extent = np.linalg.norm(R[:, 0] * a, axis=-1)
    if not own_extent:
        extent = np.full(count, min(longest, _SEMI_AXES[1]))
    room = baseline - 2.0 * (MARGIN + extent)
    center = rng.uniform(-_ASIDE, _ASIDE, (count, 3))
    center[:, 0] = MARGIN + extent + rng.random(count) * room
    # 1e-12: the longest one has no room but that of rounding.
    center[room < -1e-12] = np.nan
    return make_scenes(baseline, center, a, R=R, clearance=CLEARANCE)


def _single(rng: Generator, count: int, limit: float, **box: Any) -> Scenes:
    """Draws scenes of the paper's box whose straight line comes nearer than a limit.

    They are spread over the baselines; box: see `_boxed`.
    """
    parts, places = [], []
    for k, baseline in enumerate(BASELINES):
        rows = np.arange(k, count, len(BASELINES))
        if len(rows):
            draw = partial(_boxed, baseline=baseline, **box)
            parts.append(
                accepted(rng, len(rows), draw, lambda scenes: line_distance(scenes) < limit)
            )
            places.append(rows)
    return Scenes.joined(parts).rows(np.argsort(np.concatenate(places)))


def _dead_zone(_: Generator, count: int) -> Scenes:
    """A point obstacle midway on a 1 m baseline, on it and then beside it.

    The point has the size of the smallest obstacle trained (a sphere of 2.5 cm), as it
    has one in the paper's figure. It is exactly on the line in the first scene, and off it by
    10 um to 10 cm in equal ratios in the others; 5 cm are asked for.
    """
    center = np.tile((0.5, 0.0, 0.0), (count, 1))
    center[1:, 1] = np.geomspace(1e-5, 0.1, count - 1)
    return make_scenes(1.0, center, np.full((count, 3), POINT_RADIUS), clearance=0.05)


def _familiar_settings() -> tuple[Setting, ...]:
    """Returns the paper's 12 settings: six models, with the duration scaled and not.

    RC(lambda') asks for no clearance: its scenes have Delta = 0.
    """
    models = {f"RC(lambda',{delta:g})": delta for delta in FAMILIAR_CLEARANCES}
    return tuple(
        Setting(f"{label}, tau {'scaled' if scaled else '= 1'}", delta > 0.0, scaled, delta)
        for scaled in (True, False)
        for label, delta in ({"RC(lambda')": 0.0} | models).items()
    )


SUITES: dict[str, Suite] = {
    "novel": Suite(partial(_single, limit=CLEARANCE), 4000),
    "hit": Suite(partial(_single, limit=0.0, posed=True), 1000),
    "familiar": Suite(_familiar, 100, _familiar_settings()),
    "dead-zone": Suite(_dead_zone, 41),
    # Of Table II: obstacles are 5 cm from both ends to the extent of the longest one.
    "demo": Suite(partial(_single, limit=CLEARANCE, own_extent=False), 4000),
}
"""Name of a suite -> the suite; `drake-oa evaluate --help` describes the first two."""
