"""Tests of the motion search for a point: clearance of the result, computed independently."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from drake_oa.common.messages import FloatArray
from drake_oa.geometry.ellipsoid import signed_distance
from drake_oa.inference.config import Verified
from drake_oa.planning.point_search import PointSearch
from drake_oa.planning.search import ALPHA, Ranking
from drake_oa.policy.config import Policy
from drake_oa.policy.dmp import imitate, minimum_jerk
from drake_oa.policy.rollout import Scene
from tests.builders import balls

DURATION = 3.0
START, GOAL = np.zeros(3), np.array([1.0, 0.0, 0.0])
DMP = imitate(*minimum_jerk(START, GOAL, duration=DURATION))
QUICK = Verified(candidates=64, generations=20, refinement_generations=6, slack=2e-4)


def scene_of(
    center: list[list[float]],
    semi_axes: Sequence[float] | float = 0.08,
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Scene:
    """Returns a motion of 1 m along x with axis-aligned ellipsoids, and a clearance of 0.1 m."""
    ellipsoids = balls(*center, radius=semi_axes, v_WO=velocity)
    return Scene(START, np.zeros(3), GOAL, np.eye(3), 1.0, ellipsoids, np.full(len(center), 0.1))


def search_motion(scene: Scene) -> tuple[Ranking, FloatArray, FloatArray]:
    """Searches, and returns the best candidate, its path (n, 3) [m] and times (n,) [s]."""
    policy = Policy(period=DURATION / 500)
    search = PointSearch(scene, dmp=DMP, policy=policy, parameters=QUICK)
    best = search.run()
    tool = search.tool_paths(best.params)
    path = tool.path[0, : int(tool.steps[0]) + 1]
    return best, path, np.arange(len(path)) * tool.ds * DURATION


def min_distance(scene: Scene, path: FloatArray, stamps: FloatArray) -> float:
    some = scene.ellipsoids
    then = path[:, None] - stamps[:, None, None] * some.v_WO
    return float(signed_distance(then, some.p_WO, some.R_WO, some.semi_axes).min())


@settings(max_examples=12)
@given(
    place=st.floats(0.2, 0.8),
    aside=st.tuples(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05)),
    semi_axes=st.tuples(*3 * [st.floats(0.05, 0.12)]),
)
def test_the_requested_clearance_is_achieved_and_not_much_more(
    place: float, aside: tuple[float, float], semi_axes: tuple[float, float, float]
) -> None:
    scene = scene_of([[place, *aside]], semi_axes)
    best, path, stamps = search_motion(scene)
    assert best.is_feasible
    end_distance = min(min_distance(scene, end[None], np.zeros(1)) for end in (START, GOAL))
    assert min(0.0995, end_distance - 5e-4) <= min_distance(scene, path, stamps) <= 0.12
    assert np.linalg.norm(path[-1] - GOAL) <= 7e-4


def test_a_moving_obstacle_is_avoided_at_its_predicted_position() -> None:
    # The obstacle crosses the middle of the baseline at t = 1.5 s, and is far away at t = 0.
    scene = scene_of([[0.5, 0.45, 0.0]], velocity=(0.0, -0.3, 0.0))
    best, path, stamps = search_motion(scene)
    assert best.is_feasible
    assert best.params[0, ALPHA] > -np.inf
    assert min_distance(scene, path, stamps) >= 0.0995
    # The same from the middle of the motion.
    search = PointSearch(scene, dmp=DMP, policy=Policy(period=DURATION / 500), parameters=QUICK)
    tool = search.tool_paths(best.params)
    half = replace(scene, p_WE=tool.path[0, 100], z_W=tool.velocity[0, 100], s=0.2)
    assert search_motion(half)[0].is_feasible


def test_a_clearance_that_cannot_be_achieved_is_maximized() -> None:
    # A gap of 0.12 m between two walls, with a requested clearance of 0.1 m.
    scene = scene_of([[0.5, 3.06, 0.0], [0.5, -3.06, 0.0]], [0.2, 3.0, 50.0])
    best, path, stamps = search_motion(scene)
    assert not best.is_feasible
    assert 0.04 < min_distance(scene, path, stamps) < 0.07
