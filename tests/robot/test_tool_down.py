"""Where the tool point is in reach about the base, the tool pointing down."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from drake_oa.diagrams.motion import robot_annulus, robot_reachability
from drake_oa.geometry.annulus import Annulus, annulus_margin
from drake_oa.robot.config import BasePose, Robot
from drake_oa.robot.inverse_kinematics import solve_tool_pose
from drake_oa.robot.plant import home_positions, make_robot_plant
from drake_oa.robot.tool_down import found_annulus, given_annulus, is_tool_down

ROBOT = Robot()
PLACE = BasePose(translation=[0.4, -1.0, 0.7], rpy=[0.0, 0.0, 2.0])


def given(robot: Robot = ROBOT) -> Annulus:
    annulus = given_annulus(robot)
    assert annulus is not None
    return annulus


@pytest.mark.parametrize("height", [-0.15, 0.1, 0.3, 0.6])
@pytest.mark.parametrize("base", [BasePose(), PLACE])
def test_the_inside_is_in_reach_and_well_outside_is_not(height: float, base: BasePose) -> None:
    robot = replace(ROBOT, X_WB=base)
    arm = make_robot_plant(robot)
    X_WB = RigidTransform(RollPitchYaw(base.rpy), base.translation)

    def solve(p_BE: np.ndarray, azimuth: float, thorough: bool = True) -> None:
        # The tool may turn about the vertical: here it turns with the arm.
        R_BE = RotationMatrix.MakeZRotation(azimuth) @ RollPitchYaw(np.pi, 0, 0).ToRotationMatrix()
        pose, seed = X_WB @ RigidTransform(R_BE, p_BE), home_positions(robot)
        solve_tool_pose(arm.plant, arm.tool_frame.name(), pose, seed, thorough=thorough)

    annulus = given(robot)
    heights, least, most = annulus.radii
    z = height + base.translation[2]
    inner, outer = np.interp(z, heights, least), np.interp(z, heights, most)
    for radius in (inner + 0.005, 0.5 * (inner + outer), outer - 0.005):
        for azimuth in (-1.0, 0.6):
            p_BE = np.array([radius * math.cos(azimuth), radius * math.sin(azimuth), height])
            assert annulus_margin(X_WB @ p_BE, annulus) > 0.0
            solve(p_BE, azimuth)
    beyond = np.array([outer + 0.05, 0.0, height])
    assert annulus_margin(X_WB @ beyond, annulus) < 0.0
    with pytest.raises(ValueError, match="out of reach"):
        solve(beyond, 0.0, thorough=False)


def test_what_is_found_is_about_what_was_fitted() -> None:
    reach = robot_reachability(ROBOT)
    assert reach is not None
    fitted, found = given().radii, found_annulus(reach, ROBOT).radii
    shared = (found[0] > -0.25) & (found[0] < 0.75)
    assert shared.sum() == 10
    for row in np.flatnonzero(shared):
        at = found[0, row]
        assert found[2, row] == pytest.approx(np.interp(at, fitted[0], fitted[2]), abs=0.015)
        assert 0.15 <= found[1, row] < np.interp(at, fitted[0], fitted[1]) + 0.03


def test_what_is_found_stands_where_the_base_does() -> None:
    there = replace(ROBOT, X_WB=PLACE, rpy_WE=[math.pi, 0.0, math.pi / 2.0 + PLACE.rpy[2]])
    found = []
    for robot in (ROBOT, there):
        reach = robot_reachability(robot)
        assert reach is not None
        found.append(found_annulus(reach, robot))
    here, away = found
    np.testing.assert_allclose(away.axis, PLACE.translation[:2], atol=1e-12)
    rows = slice(2, -2)
    apart = away.radii[:, rows] - here.radii[:, rows] - [[0.7], [0.0], [0.0]]
    assert np.abs(apart).max() < 0.021


@pytest.mark.parametrize(
    ("changes", "known"),
    [
        ({}, True),
        ({"rpy_WE": [2.95, 0.0, 0.0]}, True),
        ({"rpy_WE": [2.8, 0.0, 0.0]}, False),
        ({"X_WB": BasePose(rpy=[0.0, 0.0, 1.0])}, True),
        ({"X_WB": BasePose(rpy=[0.1, 0.0, 0.0])}, False),
    ],
)
def test_it_is_known_of_an_upright_base_and_a_tool_that_points_down(
    changes: dict[str, object], known: bool
) -> None:
    robot = replace(ROBOT, **changes)
    assert is_tool_down(robot) == known
    assert (robot_annulus(robot) is not None) == known


def test_the_default_is_not_taken_for_another_arm() -> None:
    for changes in ({"annulus": None}, {"p_HE": [0.0, 0.0, 0.2]}, {"model": "other.urdf"}):
        assert given_annulus(replace(ROBOT, **changes)) is None
    own = replace(ROBOT, model="other.urdf", annulus=replace(ROBOT.annulus, outer=[0.9] * 11))
    np.testing.assert_array_equal(given(own).radii[2], np.full(11, 0.9))
    longer = robot_annulus(replace(ROBOT, p_HE=[0.0, 0.0, 0.2034]))
    assert longer is not None
    # The tool is longer by 10 cm, and reaches as far 10 cm below.
    usual = found_annulus(robot_reachability(ROBOT), ROBOT)  # type: ignore[arg-type]
    at = np.arange(-0.2, 0.7, 0.1)
    np.testing.assert_allclose(
        np.interp(at - 0.1, longer.radii[0], longer.radii[2]),
        np.interp(at, usual.radii[0], usual.radii[2]),
        atol=0.021,
    )
