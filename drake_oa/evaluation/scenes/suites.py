"""Suites of synthetic scenes: the distribution of scenes, and the settings in which methods run.

Lengths are in meters; a baseline is the distance from start to goal, and x points from start to
goal. The random suites have obstacles in the paper's box (section on novel scenarios of Pairet et
al., RA-L 2019). An obstacle in this box is along x at least 5 cm away from start and goal, and its
center has y and z within +-0.4 m. Its semi-axes are 2.5 to 25 cm; at the 0.5 m baseline the first
one, which is along x without a rotation, is at most 20 cm. Scene i of a random suite has the
baseline BASELINES[i mod 4], so that scenes are evenly distributed over the baselines.

Random numbers are those of `numpy.random.default_rng`: the same name, count and seed give the same
scenes.
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
"""Number of steps of the ternary search for the point of a line nearest to an obstacle."""

Draw = Callable[[Generator, int], Scenes]
"""Function from a random generator and a number of scenes to as many synthetic scenes."""


def draw_accepted(
    rng: Generator, count: int, draw: Draw, accept: Callable[[Scenes], BoolArray]
) -> Scenes:
    """Draws random scenes in batches until enough of them are accepted (rejection sampling).

    Args:
        rng: random generator.
        count: number of accepted scenes.
        draw: function that draws a batch of scenes.
        accept: function from N scenes to a boolean mask (N,) of the accepted ones.
    """
    parts: list[Scenes] = []
    total, batch = 0, max(256, 2 * count)
    while total < count:
        proposed = draw(rng, batch)
        valid = proposed.rows(accept(proposed))
        parts.append(valid)
        total += len(valid)
        # The remaining number at the last acceptance rate, plus 10 %, in batches of limited size.
        rate = max(len(valid) / batch, 1e-3)
        batch = int(np.clip(1.1 * (count - total) / rate, 256, 200_000))
    return Scenes.joined(parts).rows(slice(count))


def random_rotations(rng: Generator, count: int) -> FloatArray:
    """Draws `count` rotation matrices (count, 3, 3), uniformly distributed over all rotations."""
    w, x, y, z = rng.standard_normal((4, count))
    return Rotation.from_quat(np.column_stack([x, y, z, w])).as_matrix()


def line_distance(scenes: Scenes) -> FloatArray:
    """Computes the signed distance of the straight line from start to goal to the obstacle.

    Args:
        scenes: N scenes.

    Returns:
        (N,) minimum distances, negative if the line enters the obstacle [m].
    """
    low, high = np.zeros((2, len(scenes), 1))
    high += 1.0
    # The distance to a convex body is convex along a line, hence ternary search converges.
    for _ in range(_THIRDS):
        third = (high - low) / 3.0
        nearer = obstacle_distance(scenes, (low + third) * scenes.goal) < obstacle_distance(
            scenes, (high - third) * scenes.goal
        )
        nearer = nearer[:, None]
        low, high = np.where(nearer, low, low + third), np.where(nearer, high - third, high)
    return obstacle_distance(scenes, 0.5 * (low + high) * scenes.goal)


BASELINES = (0.5, 1.0, 1.5, 2.0)
"""Distances from start to goal in the suites of random scenes [m]."""
CLEARANCE = 0.15
"""Requested clearance Delta in the suites of random scenes, as in Pairet et al., RA-L 2019 [m]."""
FAMILIAR_CLEARANCES = (0.05, 0.10, 0.15, 0.20, 0.25)
"""Requested clearances Delta in the settings of the suite `familiar` [m].

Its scenes are the ellipses of the training set of Pairet et al., RA-L 2019."""
MARGIN = 0.05
"""Minimum distance from the surface of a random obstacle to start and goal, along the line through
both [m]."""
POINT_RADIUS = 0.025
"""Radius of the point-like obstacle in the dead-zone figure of Pairet et al. [m].

It is the smallest semi-axis in their training set."""

_MAX_OFFSET = 0.4
"""Maximum absolute y and z coordinate of a random obstacle's center [m].

The line from start to goal is the x axis."""
_SEMI_AXES = (0.025, 0.25)
"""Minimum and maximum semi-axis of an obstacle in synthetic scenes [m]."""


@dataclass(frozen=True)
class Suite:
    """Suite of synthetic scenes: distribution of the scenes, and settings in which methods run.

    Attributes:
        sample: function that draws a given number of scenes.
        count: default number of scenes.
        settings: settings of the avoidance method (requested clearance and scaling of the
            duration), in each of which all scenes are run.
    """

    sample: Draw
    count: int
    settings: tuple[Setting, ...] = (Setting(),)


def draw_scenes(name: str, count: int | None = None, seed: int = 0) -> Scenes:
    """Draws the synthetic scenes of a suite by a seeded random generator.

    Args:
        name: name of the suite, a key of `SUITES`: "novel", "hit", "familiar", "dead-zone", "demo".
        count: number of scenes; None: the suite's default.
        seed: seed of the random generator.

    Raises:
        ValueError: if the name is unknown, or the count for `familiar` is not a square.
    """
    check_choice("suite", SUITES, name)
    suite = SUITES[name]
    count = suite.count if count is None else count
    return suite.sample(np.random.default_rng(seed), count)


def _familiar(_: Generator, count: int) -> Scenes:
    """Returns scenes with the ellipses of the paper's training set, in the middle of a 1 m line.

    The line goes from start to goal. The semi-axes (lambda1', lambda2') are a k x k lattice of
    linspace(0.025, 0.25, k). The third semi-axis equals the second one, so that every plane through
    the line has the same section.

    Args:
        _: random generator, which is not used.
        count: number of scenes k^2.

    Raises:
        ValueError: if the number is not a square of at least 4.
    """
    k = math.isqrt(count)
    if k * k != count or k < 2:
        raise ValueError(
            f"--scenes: must be a square of at least 4 for the k x k ellipses of familiar, "
            f"not {count}"
        )
    lattice = np.linspace(*_SEMI_AXES, k)
    first, second = (grid.ravel() for grid in np.meshgrid(lattice, lattice, indexing="ij"))
    center = np.tile((0.5, 0.0, 0.0), (count, 1))
    return make_scenes(1.0, center, np.column_stack([first, second, second]))


def _boxed(
    rng: Generator, count: int, baseline: float, posed: bool = False, own_extent: bool = True
) -> Scenes:
    """Draws scenes with a random obstacle in the box of Pairet et al. around the line to the goal.

    An obstacle in the box is along the line (x axis) at least 5 cm away from start and goal, its
    center has y and z within +-0.4 m, and its semi-axes are 2.5 to 25 cm. An obstacle that is too
    long to be 5 cm from both start and goal gets a center of NaN.

    Args:
        rng: random generator.
        count: number of scenes.
        baseline: distance from start to goal [m].
        posed: whether orientations are random; else obstacles are axis-aligned.
        own_extent: whether each obstacle's own extent along x limits the position of its center.
            Otherwise the extent of the longest possible obstacle limits all centers, as in the
            authors' demo program; at the 0.5 m baseline they are then all in the middle.
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
    center = rng.uniform(-_MAX_OFFSET, _MAX_OFFSET, (count, 3))
    center[:, 0] = MARGIN + extent + rng.random(count) * room
    # 1e-12: the room of the longest obstacle is 0 up to rounding.
    center[room < -1e-12] = np.nan
    return make_scenes(baseline, center, a, R=R, clearance=CLEARANCE)


def _single(rng: Generator, count: int, limit: float, **box: Any) -> Scenes:
    """Draws random scenes in which the line from start to goal is near the obstacle.

    The scenes are evenly distributed over the distances from start to goal in `BASELINES`.

    Args:
        rng: random generator.
        count: number of scenes.
        limit: distance between line and obstacle, below which a scene is accepted [m].
        box: `posed` and `own_extent`, see `_boxed`, which draws the obstacles.
    """
    parts, places = [], []
    for k, baseline in enumerate(BASELINES):
        rows = np.arange(k, count, len(BASELINES))
        if len(rows):
            draw = partial(_boxed, baseline=baseline, **box)
            parts.append(
                draw_accepted(rng, len(rows), draw, lambda scenes: line_distance(scenes) < limit)
            )
            places.append(rows)
    return Scenes.joined(parts).rows(np.argsort(np.concatenate(places)))


def _dead_zone(_: Generator, count: int) -> Scenes:
    """Returns scenes with a small obstacle on or beside the middle of a 1 m line to the goal.

    They show the dead zone of a coupling term, which turns the motion away from an obstacle: some
    terms do not act if the obstacle is straight ahead. The obstacle is a sphere of 2.5 cm, the
    smallest one in the training set. In the first scene it is exactly on the line; in the others
    its offset along y is 10 um to 10 cm in equal ratios. The requested clearance is 5 cm.

    Args:
        _: random generator, which is not used.
        count: number of scenes.
    """
    center = np.tile((0.5, 0.0, 0.0), (count, 1))
    center[1:, 1] = np.geomspace(1e-5, 0.1, count - 1)
    return make_scenes(1.0, center, np.full((count, 3), POINT_RADIUS), clearance=0.05)


def _familiar_settings() -> tuple[Setting, ...]:
    """Returns the 12 settings of the suite `familiar`, as in Pairet et al., RA-L 2019.

    The scenes of this suite have the ellipses of the training set. Each of six models gives two
    settings: with the temporal scaling tau, and with tau = 1. Five models are the regressor chain
    RC(lambda', Delta) with one of the requested clearances Delta in `FAMILIAR_CLEARANCES`. The
    sixth is the chain RC(lambda') without a requested clearance (Delta = 0). A regressor chain
    predicts the parameters of the coupling term, from the semi-axes lambda' of the ellipse alone or
    from lambda' and Delta.
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
    # Scenes of Table II: the margin of 5 cm is measured from the extent of the longest obstacle.
    "demo": Suite(partial(_single, limit=CLEARANCE, own_extent=False), 4000),
}
"""Name of a suite of synthetic scenes -> suite.

The random suites `novel` and `demo` have obstacles within 0.15 m of the line from start to goal;
those of `demo` are placed as by the authors' demo program. `hit` has randomly oriented obstacles
that intersect the line. `familiar` has the ellipses of the training set of Pairet et al., RA-L
2019, and `dead-zone` a point-like obstacle on or beside the line.
"""
