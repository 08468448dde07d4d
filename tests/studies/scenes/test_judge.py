"""The judge against dense sampling with a distance and an interpolation of other making."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from drake_oa.studies.scenes.judge import judge
from drake_oa.studies.scenes.methods import Motions
from drake_oa.studies.scenes.scenes import Scenes, scene_distance, single_obstacle
from drake_oa.studies.scenes.suites import random_rotations

Array = NDArray[np.float64]


def dense_distance(p: Array, center: Array, R: Array, semi_axes: Array) -> Array:
    """Signed distance (K,) of points (K, 3) by bisection of the Lagrange multiplier."""
    y = np.abs((p - center) @ R)
    low = np.full(len(p), -(semi_axes.min() ** 2) * (1.0 - 1e-15))
    high = np.full(len(p), 10.0)
    for _ in range(200):
        t = 0.5 * (low + high)
        outside = ((semi_axes * y / (semi_axes**2 + t[:, None])) ** 2).sum(axis=1) > 1.0
        low, high = np.where(outside, t, low), np.where(outside, high, t)
    foot = semi_axes**2 * y / (semi_axes**2 + low[:, None])
    inside = ((y / semi_axes) ** 2).sum(axis=1) < 1.0
    return np.where(inside, -1.0, 1.0) * np.linalg.norm(y - foot, axis=1)


def least_distance(distance: Callable[[Array], Array], end: float) -> float:
    """Least of a function over [0, end], sampled twice: inside an ellipsoid it has kinks."""
    t = np.linspace(0.0, end, 1501)
    k = int(np.argmin(distance(t)))
    return float(distance(np.linspace(t[max(k - 1, 0)], t[min(k + 1, 1500)], 501)).min())


def random_case(seed: int, scenes: int, obstacles: int, steps: int) -> tuple[Scenes, Motions]:
    """Wandering motions among moving ellipsoids, some absent."""
    rng = np.random.default_rng(seed)
    shape = (scenes, obstacles)
    center = rng.uniform((0.0, -0.3, -0.3), (1.0, 0.3, 0.3), (*shape, 3))
    center[0, -1] = np.nan
    case = Scenes(
        np.ones(scenes),
        center,
        rng.uniform(0.02, 0.2, (*shape, 3)),
        random_rotations(rng, scenes * obstacles).reshape(*shape, 3, 3),
        rng.uniform(-0.1, 0.1, (*shape, 3)),
        np.full(scenes, 0.1),
    )
    duration = rng.uniform(2.0, 4.0, scenes)
    s = np.linspace(0.0, 1.0, steps + 1)
    waves, phase = rng.uniform(1.0, 9.0, (scenes, 1, 3)), rng.uniform(0.0, 6.0, (scenes, 1, 3))
    size = rng.uniform(0.0, 0.2, (scenes, 1, 3))
    path = size * np.sin(waves * s[:, None] + phase)
    velocity = size * waves * np.cos(waves * s[:, None] + phase)
    path[..., 0] += s
    velocity[..., 0] += 1.0
    return case, Motions(path, velocity / duration[:, None, None], duration, 0.0)


@pytest.mark.parametrize("seed", range(2))
def test_clearance_and_length_are_those_of_dense_sampling(seed: int) -> None:
    scenes, motions = random_case(seed, scenes=6, obstacles=3, steps=25)
    judged = judge(scenes, motions)
    for n in range(len(scenes)):
        knots = np.linspace(0.0, motions.duration[n], 26)
        curve = CubicHermiteSpline(knots, motions.path[n], motions.velocity[n])
        least = np.inf
        for m in np.flatnonzero(scenes.present[n]):

            def distance(
                t: Array, n: int = n, m: int = m, curve: CubicHermiteSpline = curve
            ) -> Array:
                moved = curve(t) - t[:, None] * scenes.velocity[n, m]
                return dense_distance(
                    moved, scenes.center[n, m], scenes.R[n, m], scenes.semi_axes[n, m]
                )

            least = min(least, least_distance(distance, motions.duration[n]))
        assert judged.kept_clearance[n] == pytest.approx(least, abs=1e-6 if least > 0.0 else 1e-4)
        p = curve(np.linspace(0.0, motions.duration[n], 2001))
        length = np.linalg.norm(np.diff(p, axis=0), axis=1).sum()
        assert judged.path_length[n] == pytest.approx(length, rel=1e-3)


def uniform_motion(steps: int, start: Array, end: Array, duration: float = 2.0) -> Motions:
    """One straight motion of constant velocity."""
    s = np.linspace(0.0, 1.0, steps + 1)[:, None]
    velocity = np.tile((end - start) / duration, (1, steps + 1, 1))
    return Motions((start + s * (end - start))[None], velocity, np.array([duration]), 0.0)


@pytest.mark.parametrize(("steps", "radius"), [(1, 0.1), (10, 1e-4), (501, 0.01)])
def test_a_contact_between_samples_is_found(steps: int, radius: float) -> None:
    center = np.array([[0.43721, 0.5 * radius, 0.0]])
    scenes = single_obstacle(1.0, center, np.full((1, 3), radius))
    judged = judge(scenes, uniform_motion(steps, np.zeros(3), np.array([1.0, 0.0, 0.0])))
    assert judged.collided.all()
    assert judged.kept_clearance[0] == pytest.approx(-0.5 * radius, abs=1e-7)


def test_feasible_clearance_follows_an_obstacle_that_comes_to_the_goal() -> None:
    center, velocity = np.array([[1.0, 1.0, 0.0]]), np.array([[0.0, -0.425, 0.0]])
    scenes = single_obstacle(1.0, center, np.full((1, 3), 0.1), velocity=velocity)
    judged = judge(scenes, uniform_motion(50, np.zeros(3), np.array([1.0, 0.0, 0.0])))
    assert judged.feasible[0] == pytest.approx(0.05)
    assert judged.kept_clearance[0] == pytest.approx(0.05)
    assert not judged.short[0]


def test_a_scene_without_obstacles_is_clear() -> None:
    nothing = np.full((1, 3), np.nan)
    scenes = single_obstacle(1.0, nothing, nothing)
    judged = judge(scenes, uniform_motion(5, np.zeros(3), np.array([1.0, 0.0, 0.0])))
    assert judged.kept_clearance.tolist() == [np.inf]
    assert judged.feasible.tolist() == [0.15]
    assert not judged.collided[0]
    assert not judged.short[0]
    assert scene_distance(scenes, np.zeros((1, 3)), np.zeros(1)).tolist() == [np.inf]


def good() -> dict[str, Array]:
    motion = uniform_motion(4, np.zeros(3), np.array([1.0, 0.0, 0.0]))
    return {"path": motion.path, "velocity": motion.velocity, "duration": motion.duration}


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"path": np.zeros((2, 5, 3))}, r"path must be \(1, S \+ 1, 3\)"),
        ({"velocity": np.zeros((1, 4, 3))}, "velocity must be"),
        ({"velocity": np.full((1, 5, 3), np.nan)}, "velocity must be finite: that of scene 0"),
        ({"duration": np.zeros(1)}, "duration must be positive"),
    ],
)
def test_motions_that_cannot_be_are_refused(change: dict[str, Array], named: str) -> None:
    scenes = single_obstacle(1.0, np.array([[0.5, 0.3, 0.0]]), np.full((1, 3), 0.1))
    with pytest.raises(ValueError, match=named):
        judge(scenes, Motions(**(good() | change), seconds=0.0))
