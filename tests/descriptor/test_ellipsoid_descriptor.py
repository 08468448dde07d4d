"""Tests of `EllipsoidDescriptor` without a diagram."""

import numpy as np
import pytest
from pydrake.common.value import Value

from drake_oa.common.messages import EllipsoidSet, ObstacleClouds, TablePlane
from drake_oa.descriptor import ellipsoid_descriptor
from drake_oa.geometry.ellipsoid import signed_distance

TOOL_W = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.03, 0.03) for z in (-0.01, 0.15)])
CLOUD = np.random.default_rng(3).uniform([0.45, 0.05, 0.15], [0.55, 0.15, 0.25], (300, 3))


def clouds(*arrays: np.ndarray, **kwargs: object) -> ObstacleClouds:
    return ObstacleClouds(clouds_W=arrays, ids=np.arange(10, 10 + len(arrays)), **kwargs)


def evaluate(obstacles: object, tool: np.ndarray = TOOL_W, **options: object) -> EllipsoidSet:
    system = ellipsoid_descriptor.EllipsoidDescriptor(tool, **options)
    context = system.CreateDefaultContext()
    system.GetInputPort("obstacles_W").FixValue(context, Value(obstacles))
    return system.GetOutputPort("ellipsoids_W").Eval(context)


@pytest.mark.parametrize("method", ["enclosing", "least_squares"])
def test_accepts_empty_sets_points_lines_and_planes(method):
    empty = evaluate(ObstacleClouds(stamp=2.0), method=method)
    assert empty.R_WO.shape == (0, 3, 3)
    line = np.linspace([0.0, 0.0, 0.0], [0.3, 0.2, 0.1], 20)
    shapes = clouds(CLOUD[:1], line, CLOUD * [1.0, 1.0, 0.0], CLOUD)
    for tool in (TOOL_W, np.zeros((1, 3))):
        ellipsoids = evaluate(shapes, tool, method=method)
        assert len(ellipsoids) == 4
        assert (ellipsoids.semi_axes >= 1e-3).all()
        np.testing.assert_allclose(np.linalg.det(ellipsoids.R_WO), 1.0)


def test_errors_of_invalid_clouds_name_the_field_and_its_shape():
    with pytest.raises(ValueError, match=r"clouds_W: .* \(N, 3\) .* \(3, 300\)"):
        clouds(CLOUD.T)
    for ids in ([], [4, 4], [[1], [2]]):
        with pytest.raises(ValueError, match=r"ids, .* arrays \(2,\) of distinct"):
            ObstacleClouds(clouds_W=(CLOUD, CLOUD), ids=np.array(ids))


def test_least_squares_is_smaller_and_leaves_points_outside():
    close, enclosing = (evaluate(clouds(CLOUD), method=m) for m in ("least_squares", "enclosing"))
    assert np.prod(close.semi_axes) < np.prod(enclosing.semi_axes)
    dilated = (CLOUD[:, None] - TOOL_W).reshape(-1, 3)
    shape = close.p_WO[0], close.R_WO[0], close.semi_axes[0]
    assert signed_distance(dilated, *shape).max() > 0.0


def test_output_has_ids_and_velocities_of_the_clouds_and_notes_clouds_without_finite_points():
    broken, table = CLOUD.copy(), TablePlane(offset=0.1)
    broken[:7, 1] = np.nan
    v_WO = np.arange(9.0).reshape(3, 3)
    none = np.full((5, 3), np.nan)
    output = evaluate(clouds(none, broken, CLOUD, v_WO=v_WO, stamp=1.5, table=table, note="dusty"))
    np.testing.assert_array_equal(output.ids, [11, 12])
    np.testing.assert_array_equal(output.v_WO, v_WO[1:])
    assert (output.stamp, output.table) == (1.5, table)
    assert output.note == "dusty; obstacle 10 omitted: none of its 5 points is finite"
    assert np.isfinite(output.semi_axes).all()


def test_output_is_computed_once_for_each_input_with_the_goal_as_free_point(monkeypatch):
    calls, real = [], ellipsoid_descriptor.describe

    def counted(*args, **kwargs):
        calls.append(kwargs["free_W"].tolist())
        return real(*args, **kwargs)

    monkeypatch.setattr(ellipsoid_descriptor, "describe", counted)
    system = ellipsoid_descriptor.EllipsoidDescriptor(TOOL_W, free_W=[[1.0, 0.0, 0.2]])
    context = system.CreateDefaultContext()
    system.GetInputPort("obstacles_W").FixValue(context, Value(clouds(CLOUD)))
    for time in (0.0, 0.1, 0.2):
        context.SetTime(time)
        system.GetOutputPort("ellipsoids_W").Eval(context)
    system.GetInputPort("goal").FixValue(context, [0.0, 0.0, 0.15])
    system.GetOutputPort("ellipsoids_W").Eval(context)
    assert calls == [[[1.0, 0.0, 0.2]], [[1.0, 0.0, 0.2], [0.0, 0.0, 0.15]]]
