"""The suites: which scenes are sampled, and in which settings methods run on them.

Lengths in metres. "The paper's box": the obstacle anywhere along x between start and
goal so that its extent along x leaves 5 cm to both, its centre's y and z within 0.4 m of
the baseline, semi-axes of 2.5-25 cm (along x 20 cm at most at the 0.5 m baseline); see the
paper's section on novel scenarios. Scene i has the baseline BASELINES[i mod 4], so that
any number of scenes is spread evenly.

Seeded by `numpy.random.default_rng`: the same name, count and seed give the same scenes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import BoolArray, FloatArray
from drake_oa.geometry.ellipsoid import signed_distance
from drake_oa.policy.dmp import minimum_jerk_share
from drake_oa.studies.scenes.scenes import (
    DURATION,
    Scenes,
    Setting,
    scene_distance,
    single_obstacle,
)

_THIRDS = 28
"""Number of times that a segment is cut to two thirds around its nearest point."""

Draw = Callable[[np.random.Generator, int], Scenes]


def accepted(
    rng: np.random.Generator, count: int, draw: Draw, keep: Callable[[Scenes], BoolArray]
) -> Scenes:
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


def random_rotations(rng: np.random.Generator, count: int) -> FloatArray:
    """Draws rotations (count, 3, 3), uniform over all."""
    w, x, y, z = rng.standard_normal((4, count))
    return Rotation.from_quat(np.column_stack([x, y, z, w])).as_matrix()


def segment_distance(
    begin: FloatArray, end: FloatArray, center: FloatArray, R: FloatArray, semi_axes: FloatArray
) -> FloatArray:
    """Least signed distance (N,) of segments (N, 3) to (N, 3) to N ellipsoids at rest [m]."""
    low, high = np.zeros((len(center), 1)), np.ones((len(center), 1))

    def distance(share: FloatArray) -> FloatArray:
        return signed_distance(begin + share * (end - begin), center, R, semi_axes)

    # Along a line the distance to a convex body is convex.
    for _ in range(_THIRDS):
        third = (high - low) / 3.0
        nearer = (distance(low + third) < distance(high - third))[:, None]
        low, high = np.where(nearer, low, low + third), np.where(nearer, high - third, high)
    return distance(0.5 * (low + high))


def line_distance(scenes: Scenes) -> FloatArray:
    """Signed distance (N, M) of the straight line from start to goal to each obstacle.

    The obstacles are taken as they stand at t = 0; inf for absent ones.
    """
    there = scenes.present
    distance = np.full(there.shape, np.inf)
    goal = np.broadcast_to(scenes.goal[:, None, :], scenes.center.shape)[there]
    distance[there] = segment_distance(
        np.zeros_like(goal), goal, scenes.center[there], scenes.R[there], scenes.semi_axes[there]
    )
    return distance


def line_hits(scenes: Scenes) -> BoolArray:
    """Whether the straight line from start to goal meets each obstacle at t = 0, (N, M)."""
    turned = np.swapaxes(scenes.R, -1, -2)
    begin = -np.einsum("nmij,nmj->nmi", turned, scenes.center) / scenes.semi_axes
    way = turned[..., 0] * scenes.baseline[:, None, None] / scenes.semi_axes
    along = -(begin * way).sum(axis=-1) / (way * way).sum(axis=-1)
    nearest = begin + np.clip(along, 0.0, 1.0)[..., None] * way
    return np.asarray((nearest * nearest).sum(axis=-1) < 1.0)


BASELINES = (0.5, 1.0, 1.5, 2.0)
CLEARANCE = 0.15
"""Delta of the suites that do not vary it."""
FAMILIAR_CLEARANCES = (0.05, 0.10, 0.15, 0.20, 0.25)
MARGIN = 0.05
POINT_RADIUS = 0.025
"""Radius of the dead-zone figure's point obstacle: the smallest that was trained."""

_ASIDE = 0.4
_SEMI_AXES = (0.025, 0.25)
_SMALL_SEMI_AXES = (0.025, 0.10)


@dataclass(frozen=True)
class Case:
    """One way in which every scene of a suite is run.

    Attributes:
        label: its name, in the paper's notation.
        setting: what the method is told.
        clearance: Delta asked in every scene; None: as the scenes have it.
    """

    label: str
    setting: Setting
    clearance: float | None = None

    def of(self, scenes: Scenes) -> Scenes:
        """The scenes as this case asks for them."""
        if self.clearance is None:
            return scenes
        return replace(scenes, clearance=np.full(len(scenes), self.clearance))


@dataclass(frozen=True)
class Suite:
    """A family of scenes.

    Attributes:
        sample: (generator, count) -> scenes.
        count: how many by default.
        cases: how each scene is run.
        methods: the methods compared by default.
    """

    sample: Callable[[np.random.Generator, int], Scenes]
    count: int
    cases: tuple[Case, ...] = (Case("RC(lambda',Delta)", Setting()),)
    methods: tuple[str, ...] = ("paper", "verified")


def draw_scenes(name: str, count: int | None = None, seed: int = 0) -> Scenes:
    """Scenes of a suite.

    Args:
        name: a key of `SUITES` or `FIGURES`.
        count: how many, at least 1; None: the suite's default.
        seed: of the generator, at least 0.

    Raises:
        ValueError: for an unknown name, a count or a seed out of range, and for
            `familiar` a count that is not a square.
    """
    suite = find_suite(name)
    count = suite.count if count is None else count
    if count < 1:
        raise ValueError(f"the number of scenes must be at least 1, not {count}")
    if seed < 0:
        raise ValueError(f"the seed must be at least 0, not {seed}")
    return suite.sample(np.random.default_rng(seed), count)


def find_suite(name: str) -> Suite:
    """The suite of a name.

    Raises:
        ValueError: for an unknown name.
    """
    known = SUITES | _OF_FIGURES
    if name not in known:
        raise ValueError(f"unknown suite {name!r}; valid: {', '.join(SUITES)}")
    return known[name]


def _familiar(_: np.random.Generator, count: int) -> Scenes:
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
    return single_obstacle(1.0, center, np.column_stack([first, second, second]))


def _boxed(
    rng: np.random.Generator,
    count: int,
    baseline: float,
    posed: bool = False,
    own_extent: bool = True,
) -> Scenes:
    """Proposals in the paper's box; NaN centres where the obstacle is too long for it.

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
    return single_obstacle(baseline, center, a, R=R, clearance=CLEARANCE)


def _single(rng: np.random.Generator, count: int, limit: float, **box: Any) -> Scenes:
    """Draws scenes of the paper's box whose straight line comes nearer than a limit.

    They are spread over the baselines; box: see `_boxed`.
    """
    parts, places = [], []
    for k, baseline in enumerate(BASELINES):
        rows = np.arange(k, count, len(BASELINES))
        if len(rows):
            draw = partial(_boxed, baseline=baseline, **box)
            parts.append(
                accepted(rng, len(rows), draw, lambda scenes: line_distance(scenes)[:, 0] < limit)
            )
            places.append(rows)
    return Scenes.joined(parts).rows(np.argsort(np.concatenate(places)))


def _clutter(rng: np.random.Generator, count: int) -> Scenes:
    """Six ellipsoids on a 1 m baseline, at least one of them in its way.

    Semi-axes of 2.5-10 cm, random poses, centres uniform over 0 <= x <= 1, |y|, |z| <= 0.4;
    start and goal at least 5 cm from each. They may overlap each other.
    """
    number = 6

    def one(rng: np.random.Generator, n: int) -> Scenes:
        center = rng.uniform((0.0, -_ASIDE, -_ASIDE), (1.0, _ASIDE, _ASIDE), (n, 3))
        a = rng.uniform(*_SMALL_SEMI_AXES, (n, 3))
        return single_obstacle(1.0, center, a, R=random_rotations(rng, n), clearance=CLEARANCE)

    def ends_free(scenes: Scenes) -> BoolArray:
        now = np.zeros(len(scenes))
        start = scene_distance(scenes, np.zeros((len(scenes), 3)), now)
        return np.minimum(start, scene_distance(scenes, scenes.goal, now)) >= MARGIN

    def six(rng: np.random.Generator, n: int) -> Scenes:
        # Batches of many scenes would take memory in proportion.
        n = min(n, 20_000)
        flat = accepted(rng, number * n, one, ends_free)
        grouped = (n, number)
        return Scenes(
            baseline=np.ones(n),
            center=flat.center.reshape(*grouped, 3),
            semi_axes=flat.semi_axes.reshape(*grouped, 3),
            R=flat.R.reshape(*grouped, 3, 3),
            velocity=flat.velocity.reshape(*grouped, 3),
            clearance=np.full(n, CLEARANCE),
        )

    return accepted(rng, count, six, lambda scenes: np.asarray(line_hits(scenes).any(axis=1)))


def _end_distance(scenes: Scenes, x: float, begin: float, end: float) -> FloatArray:
    """Distance (N,) of (x, 0, 0) to the one obstacle while it moves from `begin` to `end` [s]."""
    p = np.tile((x, 0.0, 0.0), (len(scenes), 1))
    v = scenes.velocity[:, 0]
    return segment_distance(
        p - begin * v, p - end * v, scenes.center[:, 0], scenes.R[:, 0], scenes.semi_axes[:, 0]
    )


def _moving(rng: np.random.Generator, count: int) -> Scenes:
    """One ellipsoid on a 1 m baseline that moves into the unmodulated robot.

    Semi-axes of 2.5-10 cm, random pose, speed uniform in 0.1-0.4 m/s, direction uniform over
    the sphere. It meets the unmodulated minimum-jerk motion (T = 3 s) at a time uniform in
    0.3-0.7 T (16-84 % of the way): the robot is then at a point uniform in its volume. Kept
    where it stays 5 cm or more from the goal over 3T/4 <= t <= 2T (any motion of tau <= 2 can
    end), and, over 0 <= t <= T/4 (the robot has gone a tenth of the way then), 5 cm or more
    from the start and no nearer to it than min(Delta, its distance at t = 0): what sweeps
    over a robot that is only setting out leaves it no clearance to keep.
    """

    def draw(rng: np.random.Generator, n: int) -> Scenes:
        a = rng.uniform(*_SMALL_SEMI_AXES, (n, 3))
        R = random_rotations(rng, n)
        direction = rng.standard_normal((n, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        velocity = rng.uniform(0.1, 0.4, (n, 1)) * direction
        s = rng.uniform(0.3, 0.7, n)
        inside = rng.standard_normal((n, 3))
        inside *= np.cbrt(rng.random((n, 1))) / np.linalg.norm(inside, axis=1, keepdims=True)
        met = np.zeros((n, 3))
        met[:, 0] = minimum_jerk_share(s)
        center = met + np.einsum("nij,nj->ni", R, a * inside) - (DURATION * s)[:, None] * velocity
        return single_obstacle(1.0, center, a, R=R, velocity=velocity, clearance=CLEARANCE)

    def ends_free(scenes: Scenes) -> BoolArray:
        start = _end_distance(scenes, 0.0, 0.0, 0.25 * DURATION)
        goal = _end_distance(scenes, 1.0, 0.75 * DURATION, 2.0 * DURATION)
        asked = np.minimum(CLEARANCE, _end_distance(scenes, 0.0, 0.0, 0.0))
        return (np.minimum(start, goal) >= MARGIN) & (start >= asked - 1e-9)

    return accepted(rng, count, draw, ends_free)


def _dead_zone(_: np.random.Generator, count: int) -> Scenes:
    """A point obstacle midway on a 1 m baseline, on it and then beside it.

    The point has the size of the smallest obstacle trained (a sphere of 2.5 cm), as it
    has one in the paper's figure. It is exactly on the line in the first scene, and off it by
    10 um to 10 cm in equal ratios in the others; 5 cm are asked for.
    """
    center = np.tile((0.5, 0.0, 0.0), (count, 1))
    center[1:, 1] = np.geomspace(1e-5, 0.1, count - 1)
    return single_obstacle(1.0, center, np.full((count, 3), POINT_RADIUS), clearance=0.05)


def familiar_cases() -> tuple[Case, ...]:
    """The paper's 12 settings: six models, with the duration scaled and not.

    RC(lambda') asks for no clearance: its scenes have Delta = 0.
    """
    models = [("RC(lambda')", False, 0.0)]
    models += [(f"RC(lambda',{delta:g})", True, delta) for delta in FAMILIAR_CLEARANCES]
    return tuple(
        Case(f"{label}, tau {'scaled' if scaled else '= 1'}", Setting(constrained, scaled), delta)
        for scaled in (True, False)
        for label, constrained, delta in models
    )


SUITES: dict[str, Suite] = {
    "novel": Suite(partial(_single, limit=CLEARANCE), 4000),
    "hit": Suite(partial(_single, limit=0.0, posed=True), 1000),
    "clutter": Suite(_clutter, 1000),
    "moving": Suite(_moving, 1000),
}
"""Name of a suite -> the suite; `drake-oa evaluate --help` tells what each is."""

FIGURES = {"familiar": "figure_familiar", "dead-zone": "figure_dead_zone"}
"""Suites of the paper's figures, and their commands."""
_OF_FIGURES = {
    "familiar": Suite(_familiar, 100, familiar_cases(), methods=("paper",)),
    "dead-zone": Suite(_dead_zone, 41, methods=("original", "paper")),
    # Of Table II: obstacles are 5 cm from both ends to the extent of the longest one.
    "demo": Suite(partial(_single, limit=CLEARANCE, own_extent=False), 4000, methods=("paper",)),
}
