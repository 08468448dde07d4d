"""Route selection by cost rings."""

from functools import partial

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from drake_oa.common.messages import EllipsoidSet, TablePlane
from drake_oa.route.cost_rings import (
    JointMargins,
    RingScene,
    length_ring,
    overlap_groups,
    path_length,
    remaining_clearance,
    ring_scene,
    select_directions,
    table_ring,
)
from tests.builders import balls

START, GOAL = np.array([0.0, 0.0, 0.3]), np.array([1.0, 0.0, 0.3])
TABLE = TablePlane()
RINGS = {"table": partial(table_ring, height=0.05), "length": length_ring}


def scene_of(ellipsoids: EllipsoidSet, table: TablePlane | None = TABLE) -> RingScene:
    return ring_scene(START, GOAL, np.eye(3), ellipsoids, table, asked_clearance=0.15)


def chosen(scene: RingScene, row: int = 0, **rings: object) -> np.ndarray:
    return scene.directions_W[select_directions(scene, RINGS | rings).index[row]]


def test_the_table_forbids_the_way_below() -> None:
    tall = scene_of(balls((0.5, 0.0, 0.32), radius=0.2))
    index = select_directions(tall, RINGS).index
    assert tall.p_WP[0, index[0], 2] >= 0.05
    free = scene_of(balls((0.5, 0.0, 0.32), radius=0.2), table=None)
    np.testing.assert_allclose(chosen(free), [0, 0, -1], atol=1e-12)


def test_clearance_is_to_be_led_at_where_the_baseline_does_not_keep_it() -> None:
    places = [(0.5, 0.2, 0.3), (0.5, 0.3, 0.3), (0.1, 0.0, 0.5), (-0.2, 0.0, 0.3)]
    # In the way, far enough, as near to the start as start leaves it, and behind.
    kept = remaining_clearance(scene_of(balls(*places)))
    np.testing.assert_allclose(kept, [0.15, 0.0, np.hypot(0.1, 0.2) - 0.1, 0.0])
    assert remaining_clearance(scene_of(EllipsoidSet())).shape == (0,)


def test_obstacles_that_leave_no_way_between_them_are_passed_on_one_side() -> None:
    near = balls((0.45, 0.06, 0.3), (0.55, -0.05, 0.3))
    assert len(set(overlap_groups(near, 0.15))) == 1
    index = select_directions(scene_of(near), RINGS).index
    assert index[0] == index[1]
    far = balls((0.2, 0.0, 0.3), (0.8, 0.0, 0.3), radius=0.05)
    assert len(set(overlap_groups(far, 0.15))) == 2


@given(y=st.floats(-0.006, 0.006), z=st.floats(-0.006, 0.006), side=st.integers(0, 35))
def test_an_obstacle_on_the_baseline_keeps_its_side_whatever_the_noise(
    y: float, z: float, side: int
) -> None:
    scene = scene_of(balls((0.5, y, 0.3 + z)), table=None)
    assert select_directions(scene, RINGS, previous=np.array([side])).index[0] == side


@given(
    center=st.tuples(st.floats(0.2, 0.8), st.floats(-0.3, 0.3), st.floats(0.0, 0.6)),
    radius=st.floats(0.02, 0.3),
)
def test_passing_points_keep_the_clearance_and_rings_stay_in_their_range(
    center: tuple[float, float, float], radius: float
) -> None:
    scene = scene_of(balls(center, radius=radius))
    distance = np.linalg.norm(scene.p_WP[0] - np.array(center), axis=1) - radius
    assert distance.min() >= 0.15 - 1e-9
    for ring in RINGS.values():
        cost = ring(scene)
        assert ((cost >= 0.0) & (cost <= 1.0)).all()
    index = select_directions(scene, RINGS).index
    assert path_length(scene, index) >= 1.0 - 1e-12


def cut_at(corner: int) -> JointMargins:
    """Margins of an arm that does not reach a corner where it is on the right."""

    def margins(ways: np.ndarray) -> np.ndarray:
        found = np.ones(ways.shape[:2])
        if corner < ways.shape[1]:
            found[ways[:, corner, 1] < -1e-9, corner:] = -np.inf
        return found

    return margins


def test_a_side_that_the_arm_does_not_follow_to_is_given_up() -> None:
    scene = scene_of(balls((0.5, 0.05, 0.3)))
    found = select_directions(scene, RINGS, joint_margins=cut_at(1))
    assert not found.blocked.any()
    assert scene.directions_W[found.index[0], 1] >= -1e-9
    assert found.costs["joint_limits"].max() == 1.0
    assert found.costs["joint_limits"][0, found.index[0]] == 0.0
    nowhere = select_directions(
        scene, RINGS, joint_margins=lambda ways: np.full(ways.shape[:2], -np.inf)
    )
    assert nowhere.blocked.all()


def test_the_side_at_which_a_way_ends_is_given_up() -> None:
    far = balls((0.2, 0.02, 0.3), (0.8, 0.02, 0.3), radius=0.05)
    scene = scene_of(far)
    found = select_directions(scene, RINGS, joint_margins=cut_at(2))
    assert not found.blocked.any()
    assert scene.directions_W[found.index[1], 1] >= -1e-9
