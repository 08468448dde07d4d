"""EllipsoidDescriptor alone, and the pure function behind it."""

import numpy as np
import pytest
from pydrake.common.value import Value

from drake_oa.common.messages import EllipsoidSet, ObstacleClouds, TablePlane
from drake_oa.descriptor import descriptor, ellipsoid_descriptor
from drake_oa.descriptor.ellipsoid_descriptor import EllipsoidDescriptor
from drake_oa.geometry.ellipsoid import signed_distance

TOOL_W = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.03, 0.03) for z in (-0.01, 0.15)])


def evaluate(system: EllipsoidDescriptor, obstacles: object) -> EllipsoidSet:
    context = system.CreateDefaultContext()
    system.GetInputPort("obstacles_W").FixValue(context, Value(obstacles))
    return system.GetOutputPort("ellipsoids_W").Eval(context)


def clouds(*arrays: np.ndarray, **kwargs: object) -> ObstacleClouds:
    return ObstacleClouds(clouds_W=arrays, ids=np.arange(10, 10 + len(arrays)), **kwargs)


@pytest.fixture
def cloud() -> np.ndarray:
    rng = np.random.default_rng(3)
    return rng.uniform([0.45, 0.05, 0.15], [0.55, 0.15, 0.25], (300, 3))


def test_hands_through_stamp_ids_table_and_note(cloud):
    table = TablePlane(offset=0.1)
    found = evaluate(
        EllipsoidDescriptor(TOOL_W),
        clouds(cloud, cloud + 1.0, stamp=1.5, table=table, note="few pixels"),
    )
    assert found.stamp == 1.5
    assert found.table is table
    assert found.note == "few pixels"
    np.testing.assert_array_equal(found.ids, [10, 11])
    np.testing.assert_array_equal(found.v_WO, np.zeros((2, 3)))


@pytest.mark.parametrize("method", ["enclosing", "least_squares"])
def test_accepts_empty_sets_points_lines_and_planes(method, cloud):
    system = EllipsoidDescriptor(TOOL_W, method=method)
    empty = evaluate(system, ObstacleClouds(stamp=2.0))
    assert len(empty) == 0
    assert empty.R_WO.shape == (0, 3, 3)
    assert empty.stamp == 2.0
    line = np.linspace([0.0, 0.0, 0.0], [0.3, 0.2, 0.1], 20)
    plane = cloud * [1.0, 1.0, 0.0]
    for tool in (TOOL_W, np.zeros((1, 3))):
        found = evaluate(
            EllipsoidDescriptor(tool, method=method), clouds(cloud[:1], line, plane, cloud)
        )
        assert len(found) == 4
        assert (found.semi_axes >= 1e-3).all()
        np.testing.assert_allclose(np.linalg.det(found.R_WO), 1.0)


def test_least_squares_is_smaller_and_leaves_points_outside(cloud):
    close = evaluate(EllipsoidDescriptor(TOOL_W, method="least_squares"), clouds(cloud))
    round_it = evaluate(EllipsoidDescriptor(TOOL_W), clouds(cloud))
    assert np.prod(close.semi_axes) < np.prod(round_it.semi_axes)
    dilated = (cloud[:, None] - TOOL_W).reshape(-1, 3)
    shape = close.p_WO[0], close.R_WO[0], close.semi_axes[0]
    assert signed_distance(dilated, *shape).max() > 0.0
    assert (np.diff(close.semi_axes[0]) <= 0.0).all()


def test_exponents_are_those_of_the_paper_or_as_fitted(cloud):
    enclosing = evaluate(EllipsoidDescriptor(TOOL_W), clouds(cloud))
    assert enclosing.exponents.shape == (0, 2)
    printed = evaluate(EllipsoidDescriptor(TOOL_W, method="least_squares"), clouds(cloud, cloud))
    np.testing.assert_array_equal(printed.exponents, np.ones((2, 2)))
    fitted = EllipsoidDescriptor(TOOL_W, method="least_squares", exponent_prior=0.0)
    found = evaluate(fitted, clouds(cloud))
    assert (found.exponents != 1.0).any()
    assert ((found.exponents >= 0.1) & (found.exponents <= 2.0)).all()


def test_drops_and_notes_what_is_not_finite(cloud):
    broken = cloud.copy()
    broken[:7, 1] = np.nan
    found = evaluate(
        EllipsoidDescriptor(TOOL_W),
        clouds(np.full((5, 3), np.nan), broken, np.zeros((0, 3)), cloud, note="dusty"),
    )
    np.testing.assert_array_equal(found.ids, [11, 13])
    assert np.isfinite(found.semi_axes).all()
    assert found.note.split("; ") == [
        "dusty",
        "obstacle 10 dropped: none of its 5 points is finite",
        "obstacle 11: 7 of 300 points are not finite",
        "obstacle 12 dropped: none of its 0 points is finite",
    ]


def test_is_computed_once_for_each_input(cloud, monkeypatch):
    calls = []

    def counted(*args, **kwargs):
        calls.append(1)
        return descriptor.describe(*args, **kwargs)

    monkeypatch.setattr(ellipsoid_descriptor, "describe", counted)
    system = EllipsoidDescriptor(TOOL_W)
    context = system.CreateDefaultContext()
    port = system.GetInputPort("obstacles_W")
    port.FixValue(context, Value(clouds(cloud)))
    for time in (0.0, 0.1, 0.2):
        context.SetTime(time)
        system.GetOutputPort("ellipsoids_W").Eval(context)
    assert len(calls) == 1
    port.FixValue(context, Value(clouds(cloud, cloud)))
    assert len(system.GetOutputPort("ellipsoids_W").Eval(context)) == 2
    assert len(calls) == 2


def test_velocities_are_handed_on_with_their_rows():
    cube = np.array([[x, y, z] for x in (0.0, 0.1) for y in (0.0, 0.1) for z in (0.0, 0.1)])
    v_WO = np.array([[0.1, 0.0, 0.0], [0.0, 0.2, 0.0], [0.0, 0.0, 0.3]])
    clouds = (cube, np.full((4, 3), np.nan), cube + 0.5)
    seen = descriptor.describe(
        ObstacleClouds(1.0, clouds, np.array([4, 7, 9]), v_WO=v_WO), np.zeros((1, 3))
    )
    np.testing.assert_array_equal(seen.ids, [4, 9])
    np.testing.assert_array_equal(seen.v_WO, v_WO[[0, 2]])
    assert not descriptor.describe(
        ObstacleClouds(1.0, clouds, np.arange(3)), np.zeros((1, 3))
    ).v_WO.any()
    with pytest.raises(ValueError, match="velocities"):
        descriptor.describe(
            ObstacleClouds(1.0, clouds, np.arange(3), v_WO=v_WO[:2]), np.zeros((1, 3))
        )


def test_a_goal_that_moves_is_known_to_be_free() -> None:
    """As a free point that was given: an obstacle that would hold it has several rows."""
    rng = np.random.default_rng(0)
    wall = rng.uniform([-0.02, -0.3, 0.0], [0.02, 0.3, 0.02], (400, 3))
    post = rng.uniform([-0.02, 0.28, 0.0], [0.02, 0.3, 0.4], (400, 3))
    seen = clouds(np.concatenate([wall, post]))
    tool = np.zeros((1, 3))
    start, goal = [1.0, 0.0, 0.2], [0.0, 0.0, 0.15]
    system = EllipsoidDescriptor(tool, free_W=[start])
    context = system.CreateDefaultContext()
    system.GetInputPort("obstacles_W").FixValue(context, Value(seen))
    port = system.GetInputPort("goal")
    for p_WG in (goal, start, goal):
        port.FixValue(context, p_WG)
        found = system.GetOutputPort("ellipsoids_W").Eval(context)
        given = evaluate(EllipsoidDescriptor(tool, free_W=[start, p_WG]), seen)
        np.testing.assert_array_equal(found.p_WO, given.p_WO)
        np.testing.assert_array_equal(found.semi_axes, given.semi_axes)
        assert (len(found) > 1) == (p_WG is goal)
