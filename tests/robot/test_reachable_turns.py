"""Turns of the tool that the arm can hold along a path."""

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from drake_oa.geometry.rotation import turned_about
from drake_oa.robot.config import Robot
from drake_oa.robot.inverse_kinematics import solve_tool_pose
from drake_oa.robot.plant import RobotPlant, home_positions
from drake_oa.robot.reachable_turns import reachable_turns

ROBOT = Robot()
R_WE = RollPitchYaw(ROBOT.rpy_WE).ToRotationMatrix().matrix()
UP = np.array([0.0, 0.0, 1.0])


def asked(panda: RobotPlant, path: list[list[float]], turns: list[float], **more: object) -> list:
    frame = panda.tool_frame.name()
    q = home_positions(panda, ROBOT)
    axis = more.pop("axis", UP)
    return reachable_turns(panda.plant, frame, R_WE, np.array(path), q, axis, turns, **more)


def test_the_last_joint_says_which_way(panda: RobotPlant) -> None:
    # At the right the last joint is at -1.6 rad or so, and must not go beyond -2.9.
    right, left = [0.4, -0.5, 0.25], [0.4, 0.5, 0.25]
    turns = [0.0, 0.8, -0.8, 1.57, -1.57]
    assert asked(panda, [right, left], turns) == [0.0, 0.8, -0.8, -1.57]
    assert asked(panda, [left], turns) == turns
    # Each that it names has a posture.
    for turn in (0.8, -1.57):
        X_WE = RigidTransform(RotationMatrix(turned_about(R_WE.T, UP, turn).T), right)
        solve_tool_pose(panda.plant, panda.tool_frame.name(), X_WE, home_positions(panda, ROBOT))


def test_more_margin_leaves_less(panda: RobotPlant) -> None:
    path, turns = [[0.4, -0.5, 0.25]], [0.0, 0.4, 0.8, 1.2, 1.6, 2.0]
    few = asked(panda, path, turns, margin=0.5)
    many = asked(panda, path, turns, margin=0.0)
    assert set(few) < set(many) <= set(turns)


def test_about_another_axis_inverse_kinematics_is_asked(
    panda: RobotPlant, monkeypatch: pytest.MonkeyPatch
) -> None:
    sideways = np.array([0.0, 1.0, 0.0])
    place, turns = [0.45, 0.0, 0.3], [0.0, 0.2, -0.4]
    assert asked(panda, [place], turns, axis=sideways) == turns

    def stiff(
        plant: object, frame: str, X_WE: RigidTransform, q: np.ndarray, *, thorough: bool
    ) -> np.ndarray:
        if not np.isclose(X_WE.rotation().matrix()[2, 2], -1.0, atol=0.05):
            raise ValueError("out of reach")
        return solve_tool_pose(panda.plant, frame, X_WE, q, thorough=thorough)

    monkeypatch.setattr("drake_oa.robot.reachable_turns.solve_tool_pose", stiff)
    assert asked(panda, [place], turns, axis=sideways) == [0.0, 0.2]


def test_no_turn_is_always_there_and_places_out_of_reach_say_nothing(panda: RobotPlant) -> None:
    assert asked(panda, [[5.0, 0.0, 0.0]], [0.0, 0.5]) == [0.0, 0.5]
    assert asked(panda, [[0.4, -0.5, 0.25]], [0.0, 9.0]) == [0.0]
