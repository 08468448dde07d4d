"""The desired heading past an obstacle."""

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st

from drake_oa.common.messages import EllipsoidSet, FloatArray, PolicyState
from drake_oa.geometry.ellipsoid import signed_distance
from drake_oa.policy.action import desired_headings
from drake_oa.policy.dmp import local_frame
from drake_oa.route.cost_rings import passing_normals
from tests.builders import balls

UP = np.array([[0.0, 0.0, 1.0]])
Triple = tuple[float, float, float]


def policy(p: Triple, z: Triple) -> PolicyState:
    return PolicyState(
        p_WE=np.array(p), z_W=np.array(z), p_WS=np.zeros(3), p_WG=np.array([1.0, 0.0, 0.0])
    )


def headings(state: PolicyState, ellipsoids: EllipsoidSet, direction: FloatArray) -> FloatArray:
    """As the CostRingSelector asks for them."""
    normal = passing_normals(direction, state.R_WL)
    delta = np.full(len(ellipsoids), 0.1)
    return desired_headings(state, ellipsoids, direction, normal, delta)


BLOCK = balls((0.5, 0, 0), radius=(0.1, 0.2, 0.15))


def test_a_motion_that_would_pass_below_is_led_over_the_top() -> None:
    for state in (policy((0, 0, -0.01), (1, 0, 0)), policy((0, 0, 0), (1, 0, -0.1))):
        heading = headings(state, BLOCK, UP)[0]
        assert heading[2] > 0.1
        assert abs(heading[1]) < 1e-12
        assert abs(np.linalg.norm(heading) - 1.0) < 1e-12


def test_a_motion_that_turns_to_the_chosen_side_by_itself_needs_no_guidance() -> None:
    for height in (0.0, 0.01):
        assert not headings(policy((0, 0, height), (1, 0, 0)), BLOCK, UP).any()


def test_a_motion_at_rest_is_led_from_the_baseline() -> None:
    at_rest = headings(policy((0, 0, -0.01), (0, 0, 0)), BLOCK, UP)
    moving = headings(policy((0, 0, -0.01), (1, 0, 0)), BLOCK, UP)
    assert at_rest.any()
    np.testing.assert_allclose(at_rest, moving)


def test_no_guidance_when_the_way_is_clear_or_the_goal_comes_first() -> None:
    beside = balls((0.5, 0.6, 0), radius=(0.1, 0.1, 0.1))
    behind = balls((-0.5, 0, 0), radius=(0.1, 0.1, 0.1))
    beyond = balls((1.5, 0, 0), radius=(0.1, 0.1, 0.1))
    for ellipsoids in (beside, behind, beyond, EllipsoidSet()):
        heading = headings(policy((0, 0, -0.01), (1, 0, 0)), ellipsoids, UP[: len(ellipsoids)])
        assert heading.shape == (len(ellipsoids), 3)
        assert not heading.any()


@given(
    offset=st.tuples(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1)),
    axes=st.tuples(st.floats(0.03, 0.2), st.floats(0.03, 0.2), st.floats(0.03, 0.2)),
    angle=st.floats(0.0, 6.28),
)
def test_a_heading_on_the_wrong_side_becomes_one_that_keeps_the_clearance(
    offset: tuple[float, float], axes: Triple, angle: float
) -> None:
    direction = np.array([[0.0, np.cos(angle), np.sin(angle)]])
    # E lies within 60 degrees of the side opposite to the chosen one: guidance acts in full.
    assume(np.hypot(*offset) > 1e-3)
    assume(direction[0, 1:] @ offset < -0.51 * np.hypot(*offset))
    ellipsoids = balls((0.6, 0.0, 0.0), radius=axes)
    p_WE = (0.0, *offset)
    heading = headings(policy(p_WE, (1, 0, 0)), ellipsoids, direction)[0]
    way = p_WE + np.linspace(0.0, 2.0, 400)[:, None] * heading
    kept = signed_distance(way, ellipsoids.p_WO[0], ellipsoids.R_WO[0], ellipsoids.semi_axes[0])
    assert kept.min() >= 0.1 - 1e-9 or not heading.any()


@given(angle=st.floats(0.0, 6.28), goal=st.tuples(*[st.floats(-1, 1)] * 3))
def test_passing_normals_are_unit_and_turn_from_the_baseline_to_the_chosen_side(
    angle: float, goal: Triple
) -> None:
    assume(np.linalg.norm(goal) > 1e-3)
    R_WL = local_frame(np.zeros(3), np.array(goal))
    direction = np.array([[0.0, np.cos(angle), np.sin(angle)]]) @ R_WL.T
    normal = passing_normals(direction, R_WL)
    np.testing.assert_allclose(np.linalg.norm(normal), 1.0)
    np.testing.assert_allclose(np.cross(normal[0], R_WL[:, 0]), direction[0], atol=1e-12)


def test_straight_at_the_centre_no_heading_is_needed_whatever_the_rounding() -> None:
    """The P-plane's normal is rounding there; the passing plane's decides the side."""
    for scale in (1.0, 3.0, 10.0):
        for tilt in (0.0, 1e-13, -1e-13):
            heading = desired_headings(
                PolicyState(p_WG=np.array([scale, 0.0, 0.0])),
                balls((0.5 * scale, 0.0, tilt * scale), radius=0.1 * scale),
                np.array([[0.0, 0.0, 1.0]]),
                np.array([[0.0, -1.0, 0.0]]),
                np.array([0.1 * scale]),
            )
            np.testing.assert_array_equal(heading, 0.0)
