"""The desired heading past an obstacle."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from drake_oa.ellipsoid import signed_distance
from drake_oa.heading import desired_headings, feasible_clearance, passing_normals
from drake_oa.values import EllipsoidSet, PolicyState

UP = np.array([[0.0, 0.0, 1.0]])
DELTA = np.array([0.1])


def one(center: tuple[float, float, float], axes: tuple[float, float, float]) -> EllipsoidSet:
    return EllipsoidSet(
        stamp=0.0,
        p_WO=np.array([center]),
        R_WO=np.eye(3)[None],
        semi_axes=np.array([axes]),
        v_WO=np.zeros((1, 3)),
        ids=np.array([0]),
    )


def policy(p: tuple[float, float, float], z: tuple[float, float, float]) -> PolicyState:
    return PolicyState(
        p_WE=np.array(p), z_W=np.array(z), p_WS=np.zeros(3), p_WG=np.array([1.0, 0.0, 0.0])
    )


def test_a_motion_that_would_hit_is_led_past_on_the_chosen_side() -> None:
    heading = desired_headings(
        policy((0, 0, 0), (1, 0, 0)), one((0.5, 0, 0), (0.1, 0.2, 0.15)), UP, DELTA
    )[0]
    assert heading[2] > 0.0
    assert abs(heading[1]) < 1e-12


def test_a_motion_at_rest_is_led_from_the_baseline() -> None:
    ellipsoids = one((0.5, 0, 0), (0.1, 0.2, 0.15))
    at_rest = desired_headings(policy((0, 0, 0), (0, 0, 0)), ellipsoids, UP, DELTA)
    moving = desired_headings(policy((0, 0, 0), (1, 0, 0)), ellipsoids, UP, DELTA)
    np.testing.assert_allclose(at_rest, moving)


def test_no_guidance_when_the_way_is_clear_or_the_goal_comes_first() -> None:
    beside = one((0.5, 0.6, 0), (0.1, 0.1, 0.1))
    behind = one((-0.5, 0, 0), (0.1, 0.1, 0.1))
    beyond = one((1.5, 0, 0), (0.1, 0.1, 0.1))
    for ellipsoids in (beside, behind, beyond, EllipsoidSet()):
        count = len(ellipsoids)
        heading = desired_headings(
            policy((0, 0, 0), (1, 0, 0)), ellipsoids, UP[:count], DELTA[:count]
        )
        assert not heading.any()


def test_feasible_clearance_shrinks_toward_an_obstacle_near_the_goal() -> None:
    ellipsoids = one((0.85, 0, 0), (0.1, 0.1, 0.1))
    np.testing.assert_allclose(
        feasible_clearance(np.array([1.0, 0, 0]), ellipsoids, 0.15), [0.05], atol=1e-9
    )
    covered = one((1.0, 0, 0), (0.1, 0.1, 0.1))
    assert feasible_clearance(np.array([1.0, 0, 0]), covered, 0.15)[0] == 0.0


@given(
    offset=st.tuples(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1)),
    axes=st.tuples(st.floats(0.03, 0.2), st.floats(0.03, 0.2), st.floats(0.03, 0.2)),
    angle=st.floats(0.0, 6.28),
)
def test_following_the_heading_keeps_the_clearance(
    offset: tuple[float, float], axes: tuple[float, float, float], angle: float
) -> None:
    ellipsoids = one((0.6, *offset), axes)
    direction = np.array([[0.0, np.cos(angle), np.sin(angle)]])
    heading = desired_headings(policy((0, 0, 0), (1, 0, 0)), ellipsoids, direction, DELTA)[0]
    if heading.any():
        way = np.linspace(0.0, 2.0, 400)[:, None] * heading
        kept = signed_distance(way, ellipsoids.p_WO[0], ellipsoids.R_WO[0], ellipsoids.semi_axes[0])
        assert kept.min() >= 0.1 - 1e-9


@given(
    p=st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1, 1)), angle=st.floats(0.0, 6.28)
)
def test_passing_normals_are_unit_and_turn_toward_the_chosen_side(
    p: tuple[float, float, float], angle: float
) -> None:
    direction = np.array([[0.0, np.cos(angle), np.sin(angle)]])
    center = np.array([[0.5, 0.0, 0.0]])
    normal = passing_normals(np.array(p), center, direction, np.eye(3))
    np.testing.assert_allclose(np.linalg.norm(normal), 1.0)
    ahead = (center - p)[0]
    side = direction[0] - ahead * (direction[0] @ ahead) / max(ahead @ ahead, 1e-300)
    if np.linalg.norm(side) > 1e-3 and np.linalg.norm(ahead) > 1e-3:
        assert np.cross(normal[0], ahead) @ side > 0.0
