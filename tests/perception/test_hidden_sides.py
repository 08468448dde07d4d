"""Far sides of what a camera sees from one side only."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform

from drake_oa.common.messages import ObstacleClouds
from drake_oa.geometry.voxels import VOXEL
from drake_oa.perception.hidden_sides import (
    HiddenSides,
    deepened,
    names_moved,
    solid,
    with_hidden_sides,
)

CAMERA = np.array([1.2, 0.0, 1.0])


def face(width: float = 0.06) -> np.ndarray:
    """The front of a box that stands at x = 0.4, as a camera ahead sees it."""
    y, z = np.meshgrid(np.linspace(0.0, width, 13), np.linspace(0.0, 0.2, 21))
    return np.stack([np.full(y.size, 0.4), y.ravel(), z.ravel()], axis=1)


def seen(*v_WO: tuple[float, float, float]) -> ObstacleClouds:
    return ObstacleClouds(
        stamp=1.0,
        clouds_W=tuple(face() for _ in v_WO),
        ids=np.arange(len(v_WO)),
        v_WO=np.array(v_WO).reshape(-1, 3),
    )


def test_what_rests_is_left_as_it_is() -> None:
    resting = seen((0.0, 0.0, 0.0))
    assert with_hidden_sides(resting, CAMERA) is resting


def test_what_moves_is_as_deep_as_broad() -> None:
    one, other = with_hidden_sides(seen((0.0, 0.0, 0.0), (-0.2, 0.0, 0.0)), CAMERA).clouds_W
    np.testing.assert_array_equal(one, face())
    np.testing.assert_array_equal(other[: len(face())], face())
    assert np.ptp(other[:, 0]) == pytest.approx(0.06, abs=0.005)
    assert other[:, 0].max() == pytest.approx(0.4)
    np.testing.assert_allclose(np.ptp(other[:, 2]), 0.2)


def test_what_has_moved_keeps_its_far_side() -> None:
    moving, resting = seen((-0.2, 0.0, 0.0), (0.0, 0.0, 0.0)), seen((0.0,) * 3, (0.0,) * 3)
    moved = names_moved(moving, frozenset())
    assert moved == {0}
    assert names_moved(resting, moved) == {0}
    one, other = with_hidden_sides(resting, CAMERA, moved).clouds_W
    assert np.ptp(one[:, 0]) == pytest.approx(0.06, abs=0.005)
    np.testing.assert_array_equal(other, face())
    # Its name may be given again.
    assert names_moved(seen(), moved) == frozenset()


@settings(max_examples=30, deadline=None)
@given(angle=st.floats(-3.0, 3.0), width=st.floats(0.03, 0.3))
def test_depth_turns_with_the_scene_and_is_bounded(angle: float, width: float) -> None:
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    cloud = face(width)
    plain, turned = deepened(cloud, CAMERA), deepened(cloud @ R.T, R @ CAMERA)
    away = cloud.mean(axis=0)[:2] - CAMERA[:2]
    away /= np.linalg.norm(away)
    depth = float(np.ptp(plain[:, :2] @ away))
    assert depth <= 0.08 + 0.02 * abs(away[1]) + 1e-9 or depth <= np.ptp(cloud[:, :2] @ away) + 1e-9
    assert np.ptp(turned[:, :2] @ (R[:2, :2] @ away)) == pytest.approx(depth, abs=0.02)


def test_below_a_top_it_is_solid() -> None:
    x, y = (a.ravel() for a in np.meshgrid(np.arange(0.0, 0.1, 0.01), np.arange(0.0, 0.1, 0.01)))
    top = np.stack([x, y, np.full(x.size, 0.3)], axis=1)
    side = face(0.1) + [-0.4, 0.0, 0.1]
    whole = solid(np.concatenate([top, side]))
    inside = np.random.default_rng(0).uniform([0.0, 0.0, 0.1], [0.09, 0.09, 0.3], (200, 3))
    nearest = np.linalg.norm(whole - inside[:, None], axis=2).min(axis=1)
    assert nearest.max() < 1.2 * VOXEL
    assert whole[:, 2].min() >= 0.1 - 1e-9
    assert solid(np.zeros((0, 3))).shape == (0, 3)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("axis", [0, 2])
def test_what_is_not_finite_is_handed_on_for_others_to_see(value: float, axis: int) -> None:
    bad = face()
    bad[3, axis] = value
    moving = replace(seen((0.0, 0.3, 0.0)), clouds_W=(bad,))
    assert with_hidden_sides(moving, CAMERA).clouds_W[0] is bad
    lost = seen((np.nan, 0.0, 0.0))
    assert names_moved(lost, frozenset()) == frozenset()
    assert with_hidden_sides(lost, CAMERA) is lost
    empty = replace(seen((0.0, 0.3, 0.0)), clouds_W=(np.zeros((0, 3)),))
    assert len(with_hidden_sides(empty, CAMERA).clouds_W[0]) == 0


def test_the_system_alone() -> None:
    system = HiddenSides(period=0.1)
    context = system.CreateDefaultContext()
    moving = seen((0.0, 0.3, 0.0))
    system.GetInputPort("obstacles_W").FixValue(context, AbstractValue.Make(moving))
    pose = RigidTransform(CAMERA)
    system.GetInputPort("camera_pose").FixValue(context, AbstractValue.Make(pose))
    system.ExecuteInitializationEvents(context)
    shown = system.get_output_port().Eval(context)
    expected = with_hidden_sides(moving, CAMERA)
    np.testing.assert_array_equal(shown.clouds_W[0], expected.clouds_W[0])
    assert shown.stamp == moving.stamp
    rests = AbstractValue.Make(seen((0.0, 0.0, 0.0)))
    system.GetInputPort("obstacles_W").FixValue(context, rests)
    shown = system.get_output_port().Eval(context)
    np.testing.assert_array_equal(shown.clouds_W[0], expected.clouds_W[0])
    with pytest.raises(ValueError, match="period"):
        HiddenSides(period=0.0)
