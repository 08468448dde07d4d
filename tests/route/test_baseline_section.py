"""The half ellipse by which a motion meets an obstacle on the chosen side."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import EllipsoidSet, FloatArray
from drake_oa.geometry.ellipsoid import shape_matrix, signed_distance
from drake_oa.route.baseline_section import Passing, passing

START, GOAL = np.zeros(3), np.array([1.0, 0.0, 0.0])
DELTA = 0.15
UP = np.array([0.0, 0.0, 1.0])

unit = st.floats(-1.0, 1.0)
vectors = st.tuples(unit, unit, unit)
axes = st.tuples(*[st.floats(0.02, 0.25)] * 3)
angles = st.floats(0.0, 6.28)
centers = st.tuples(st.floats(0.1, 0.9), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))


def obstacles(*items: tuple[object, object, object]) -> EllipsoidSet:
    """From centre, semi-axes and rotation vector of each."""
    return EllipsoidSet(
        stamp=0.0,
        p_WO=np.array([item[0] for item in items], dtype=float),
        R_WO=Rotation.from_rotvec(np.array([item[2] for item in items], dtype=float)).as_matrix(),
        semi_axes=np.array([item[1] for item in items], dtype=float),
        v_WO=np.zeros((len(items), 3)),
        ids=np.arange(len(items)),
    )


def ball(x: float, height: float, radius: float) -> tuple[object, object, object]:
    return (x, 0.0, height), (radius,) * 3, (0.0, 0.0, 0.0)


def met(
    ellipsoids: EllipsoidSet,
    direction: FloatArray = UP,
    groups: FloatArray | None = None,
    delta: float = DELTA,
) -> Passing:
    count = len(ellipsoids)
    return passing(
        START,
        GOAL,
        np.eye(3),
        ellipsoids,
        np.tile(direction, (count, 1)),
        np.zeros(count, dtype=int) if groups is None else np.asarray(groups, dtype=int),
        delta,
    )


def side(angle: float) -> FloatArray:
    return np.array([0.0, np.cos(angle), np.sin(angle)])


def shadow(ellipsoids: EllipsoidSet, direction: FloatArray) -> FloatArray:
    """Outline (T, 2) of the first obstacle's shadow, along the baseline and the direction."""
    U = np.stack([GOAL, direction], axis=1)
    B = shape_matrix(ellipsoids.R_WO, ellipsoids.semi_axes)[0]
    t = np.linspace(0.0, 2.0 * np.pi, 721)
    circle = np.stack([np.cos(t), np.sin(t)], axis=1)
    return circle @ np.linalg.cholesky(U.T @ B @ U).T + (ellipsoids.p_WO[0] - START) @ U


@given(center=centers, semi_axes=axes, turn=vectors, angle=angles)
def test_it_encloses_what_rises_above_the_baseline(
    center: object, semi_axes: object, turn: object, angle: float
) -> None:
    ellipsoids = obstacles((center, semi_axes, turn))
    found = met(ellipsoids, side(angle))
    middle, (along, across) = found.center_W[0] @ GOAL, found.extents[0]
    # Beyond the ends of the baseline the centre is held back.
    assume(0.0 < middle < 1.0)
    outline = shadow(ellipsoids, side(angle))
    above = outline[outline[:, 1] > 0.0]
    gauge = ((above[:, 0] - middle) / along) ** 2 + (above[:, 1] / across) ** 2
    # The enclosing factor is sampled.
    assert (gauge <= 1.0 + 5e-3).all()


@given(center=centers, semi_axes=axes, turn=vectors, angle=angles)
def test_it_reaches_the_highest_point_from_the_baseline(
    center: object, semi_axes: object, turn: object, angle: float
) -> None:
    ellipsoids = obstacles((center, semi_axes, turn))
    found = met(ellipsoids, side(angle))
    np.testing.assert_allclose(found.center_W[0, 1:], 0.0, atol=1e-15)
    highest = shadow(ellipsoids, side(angle))[:, 1].max()
    # An oblique shadow takes a taller half ellipse.
    assert found.extents[0, 1] >= max(highest, 0.02) - 1e-4
    assert found.extents[0, 1] <= max(1.5 * highest, 0.02)


@given(center=centers, semi_axes=axes, turn=vectors, angle=angles)
def test_clearance_is_asked_where_the_baseline_does_not_keep_what_can_be_kept(
    center: object, semi_axes: object, turn: object, angle: float
) -> None:
    ellipsoids = obstacles((center, semi_axes, turn))
    line = np.linspace(0.0, 1.0, 2001)[:, None] * GOAL
    distance = signed_distance(
        line, ellipsoids.p_WO[0], ellipsoids.R_WO[0], ellipsoids.semi_axes[0]
    )
    feasible = min(DELTA, distance[0], distance[-1])
    asked = met(ellipsoids, side(angle)).remaining_clearance[0]
    if distance.min() >= feasible:
        assert asked == 0.0
    elif distance.min() < feasible - 0.03:
        assert asked > 0.0
    assert 0.0 <= asked <= DELTA


def test_of_a_ball_it_is_the_tightest_one() -> None:
    radius, height = 0.1, 0.05
    found = met(obstacles(ball(0.5, height, radius)))
    np.testing.assert_allclose(found.center_W, [[0.5, 0.0, 0.0]], atol=1e-12)
    # lambda2' is the top; lambda1' follows from the curvature there.
    expected = [np.sqrt(radius * (radius + height)), radius + height]
    np.testing.assert_allclose(found.extents[0], expected, rtol=1e-6)


def test_no_more_clearance_is_asked_than_the_goal_has() -> None:
    near_goal = met(obstacles(ball(0.85, 0.0, 0.1)))
    assert near_goal.remaining_clearance[0] == pytest.approx(0.05)
    over_goal = met(obstacles(ball(1.0, 0.0, 0.1)))
    assert over_goal.remaining_clearance[0] == 0.0


def test_what_stays_below_the_baseline_leaves_the_rest_of_the_clearance() -> None:
    found = met(obstacles(ball(0.5, -0.15, 0.1)))
    assert found.extents[0, 1] == pytest.approx(0.02)
    assert found.remaining_clearance[0] == pytest.approx(DELTA - 0.05, abs=1e-3)


@given(data=st.lists(st.tuples(centers, axes, vectors), min_size=2, max_size=4), angle=angles)
@settings(max_examples=60)
def test_the_envelope_of_a_group_encloses_each_member_and_the_shares_sum_to_one(
    data: list[tuple[object, object, object]], angle: float
) -> None:
    alone = [met(obstacles(item), side(angle)) for item in data]
    found = met(obstacles(*data), side(angle))
    acting = np.flatnonzero(found.remaining_clearance > 0.0)
    assert (len(acting) > 0) == any(one.remaining_clearance[0] > 0.0 for one in alone)
    if len(acting) == 0:
        return
    assert found.weight[acting].sum() == pytest.approx(1.0)
    assert np.ptp(found.extents[acting], axis=0).max() == 0.0
    assert np.ptp(found.center_W[acting], axis=0).max() == 0.0
    t = np.linspace(0.0, np.pi, 41)
    for row in acting:
        member = alone[row]
        assert found.remaining_clearance[row] >= member.remaining_clearance[0]
        x = member.center_W[0] @ GOAL + member.extents[0, 0] * np.cos(t)
        y = member.extents[0, 1] * np.sin(t)
        gauge = ((x - found.center_W[row] @ GOAL) / found.extents[row, 0]) ** 2
        gauge += (y / found.extents[row, 1]) ** 2
        assert gauge.max() <= 1.0 + 1e-9


def test_an_obstacle_that_the_way_past_another_clears_is_left_out() -> None:
    small, big = ball(0.4, 0.0, 0.03), ball(0.5, 0.0, 0.2)
    both = met(obstacles(small, big))
    alone = met(obstacles(big))
    assert both.remaining_clearance[0] == 0.0
    assert both.weight[1] == 1.0
    np.testing.assert_array_equal(both.extents[1], alone.extents[0])
    apart = met(obstacles(small, big), groups=np.array([0, 1]))
    assert (apart.remaining_clearance > 0.0).all()


def test_of_two_equal_obstacles_one_stays() -> None:
    twins = met(obstacles(ball(0.5, 0.0, 0.1), ball(0.5, 0.0, 0.1)))
    assert np.count_nonzero(twins.remaining_clearance) == 1


def test_no_obstacles_give_no_rows() -> None:
    found = passing(
        START, GOAL, np.eye(3), EllipsoidSet(), np.zeros((0, 3)), np.zeros(0, dtype=int), DELTA
    )
    shapes = {
        v.shape for v in (found.center_W, found.extents, found.remaining_clearance, found.weight)
    }
    assert shapes == {(0, 3), (0, 2), (0,)}


@given(
    data=st.lists(st.tuples(centers, axes, vectors), min_size=1, max_size=3),
    angle=angles,
    turn=vectors,
    shift=vectors,
)
@settings(max_examples=60)
def test_it_does_not_depend_on_the_world_frame(
    data: list[tuple[object, object, object]], angle: float, turn: object, shift: object
) -> None:
    here = obstacles(*data)
    R, p = Rotation.from_rotvec(np.array(turn)).as_matrix(), np.array(shift)
    there = EllipsoidSet(
        stamp=0.0,
        p_WO=here.p_WO @ R.T + p,
        R_WO=R @ here.R_WO,
        semi_axes=here.semi_axes,
        v_WO=here.v_WO,
        ids=here.ids,
    )
    first = met(here, side(angle))
    # A part that begins or ends exactly at the sampled ends may go either way.
    assume(((first.center_W @ GOAL > 1e-6) & (first.center_W @ GOAL < 1.0 - 1e-6)).all())
    second = passing(
        p,
        R @ GOAL + p,
        R,
        there,
        np.tile(R @ side(angle), (len(data), 1)),
        np.zeros(len(data), dtype=int),
        DELTA,
    )
    np.testing.assert_allclose(second.extents, first.extents, atol=1e-6)
    np.testing.assert_allclose(second.remaining_clearance, first.remaining_clearance, atol=1e-6)
    np.testing.assert_allclose(second.center_W, first.center_W @ R.T + p, atol=1e-6)
    np.testing.assert_allclose(second.weight, first.weight)
