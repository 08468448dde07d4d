"""Claims of passive motion safety, on motions made by hand."""

import numpy as np
import pytest

from drake_oa.evaluation.panda.claims import claim_violations
from drake_oa.evaluation.panda.evaluation import run_and_evaluate
from drake_oa.evaluation.panda.scenes import draw_panda_scene
from drake_oa.evaluation.panda.true_world import make_true_world
from drake_oa.perception.coverage import ViewVolume
from drake_oa.robot.spheres import sphere_centers
from drake_oa.scenario.loading import load_scenario

_Q = np.array([0.0, -0.3, 0.0, -2.0, 0.0, 1.7, 0.8])
_DT = 0.004


_RISING = "[[0, 0, 0, 0], [5, 0, 0, 0.15]]"


def _world(at, waypoints=_RISING):
    ball = "{name: ball, shapes: [!Sphere {radius: 0.05}], translation: "
    ball += f"{[round(float(value), 4) for value in at]}"
    ball += f", waypoints: {waypoints}}}" if waypoints else "}"
    return make_true_world(
        load_scenario(
            "tabletop_box", ["cameras=[]", "perception=!GroundTruth {}", f"obstacles=[{ball}]"]
        )
    )


@pytest.fixture(scope="module")
def ahead():
    """A function of a way [m]: the place that far ahead of the hand as joint 1 turns."""
    world = _world([2.0, 0.0, 0.5])
    centers = sphere_centers(world.arm.chain, world.arm.spheres, _Q[None])[0]
    hand = centers[np.argmax(np.hypot(*centers[:, :2].T))]
    along = np.array([-hand[1], hand[0], 0.0]) / np.hypot(*hand[:2])
    return lambda way: hand + way * along


def _turning(rate, count=30):
    """Joint 1 turns, the hand 0.5 to 0.6 m from its axis."""
    q = np.tile(_Q, (count, 1))
    q[:, 0] += rate * _DT * np.arange(count)
    return 1.0 + _DT * np.arange(count), q


@pytest.mark.parametrize(
    ("side", "away", "age", "violated"),
    [
        (1.0, 0.10, 0.2, True),
        (1.0, 0.10, 0.0, False),
        (-1.0, 0.10, 0.2, False),
        (1.0, 0.60, 0.2, False),
    ],
    ids=["near, approached", "seen just now", "left behind", "far"],
)
def test_a_point_that_can_be_reached_does_not_approach(ahead, side, away, age, violated):
    world, (t, q) = _world(ahead(side * (0.15 + away))), _turning(1.0)
    found = claim_violations(world, t, q, t - age)
    assert found["A"].any() == violated
    assert not found["A"][-1]
    assert not found["B"].any()


@pytest.mark.parametrize(
    ("rate", "waypoints", "violated"),
    [
        (1.0, _RISING, True),
        (0.0, _RISING, False),
        (1.0, "", False),
        # The stamps are from 0.5 to 0.62 s.
        (1.0, "[[0, 0, 0, 0], [0.3, 0, 0, 0.1]]", False),
        (1.0, "[[0.7, 0, 0, 0], [3, 0, 0, 1.0]]", False),
        (1.0, "[[0, 0, 0, 0], [3, 0, 0, 0.04]]", False),
    ],
    ids=["moves", "resting arm", "never moves", "has come to rest", "moves later", "creeps"],
)
def test_a_resting_arm_and_obstacles_at_rest_violate_nothing(ahead, rate, waypoints, violated):
    world, (t, q) = _world(ahead(0.25), waypoints), _turning(rate)
    assert claim_violations(world, t, q, t - 0.5)["A"].any() == violated


_NO_DEPTH_AHEAD = np.where(np.arange(120)[:, None] < 52, 0.0, np.inf)


def _overhead(value):
    """A camera 2.5 m over the base that looks down, its upper rows to +y, and its depth."""
    X_WC = np.diag([1.0, -1.0, -1.0, 1.0])
    X_WC[:3, 3] = [0.3, 0.0, 2.5]
    image = np.full((120, 120), value, dtype=np.float32)
    return image, ViewVolume(X_WC, np.array([60.0, 60.0, 59.5, 59.5]), image.shape, 0.5, 5.0)


@pytest.mark.parametrize(
    ("rate", "sights", "violated"),
    [
        (1.5, [np.inf], False),
        (1.5, [0.0], True),
        (1.5, [0.0, np.inf], False),
        (1.5, [1.0], True),
        (0.2, [0.0], False),
        (1.5, [_NO_DEPTH_AHEAD], True),
        (1.5, [_NO_DEPTH_AHEAD[::-1]], False),
    ],
    ids=["free", "no depth", "other camera", "behind something", "slow", "ahead", "left behind"],
)
def test_the_arm_is_slow_toward_where_sight_is_lacking(rate, sights, violated):
    world, (t, q) = _world([2.0, 0.0, 0.5]), _turning(rate)
    requested = []

    def images(time):
        requested.append(time)
        return [_overhead(value) for value in sights]

    found = claim_violations(world, t, q, np.zeros(len(t)), images)
    assert found["B"].any() == violated
    assert not found["A"].any()
    # A slow arm asks for no image, and a fast one once for each stamp.
    assert requested == ([] if rate < 0.5 else [0.0])


def test_without_an_observation_sight_is_lacking():
    world, (t, q) = _world([2.0, 0.0, 0.5]), _turning(1.5)
    found = claim_violations(world, t, q, np.full(len(t), -np.inf))
    assert found["B"][:-1].all()
    assert not claim_violations(world, t, q, t)["B"].any()


@pytest.mark.slow
@pytest.mark.parametrize("index", range(20))
def test_no_motion_violates_a_claim_in_hard_scenes_from_ground_truth(index):
    scene = draw_panda_scene(0, index, kind="moving_hard")
    found = run_and_evaluate(scene, "verified", "truth")["claim_violations"]
    assert found["instants"] > 1000
    assert found["A"] == found["B"] == 0
