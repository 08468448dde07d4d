"""Which turns of its tool an arm can hold along a path."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame
from pydrake.systems.framework import Context

from drake_oa.common.messages import FloatArray
from drake_oa.geometry.rotation import turned_about, unit_axis
from drake_oa.robot.inverse_kinematics import solve_tool_pose

_SAME = 1e-4
"""Poses whose matrices, and places [m], differ by less are the same."""

_STEP, _JUMP = 0.25, 0.75
"""Part of a turn that a posture is sought for at a time, and what a joint may move in it [rad]."""


def reachable_turns(
    plant: MultibodyPlant,
    tool_frame: str,
    R_WE: FloatArray,
    path: FloatArray,
    q_seed: FloatArray,
    axis: FloatArray,
    turns: Sequence[float],
    *,
    margin: float = 0.15,
) -> list[float]:
    """Those of some turns that the arm can hold at each point of a path.

    From point to point the arm goes as it would unturned. Where the axis is that of the last
    joint, that joint alone turns the tool; otherwise inverse kinematics has to find a posture.

    Args:
        plant: finalized plant of the robot alone.
        tool_frame: name of the frame E.
        R_WE: (3, 3) orientation of the tool at turn 0.
        path: (P, 3) tool points; those that are out of reach say nothing [m].
        q_seed: (n,) positions at the beginning, or near them [rad, m].
        axis: (3,) of the turn, in W.
        turns: which are asked about [rad].
        margin: from the limits of the joints that the tool's pose needs [rad].

    Returns:
        The turns, in their order; 0 is always among them if it was asked about.
    """
    axis = unit_axis(axis)
    frame, context = plant.GetFrameByName(tool_frame), plant.CreateDefaultContext()
    joint = _last_joint(plant, frame)
    left, q = list(turns), np.array(q_seed, dtype=float)
    for place in path:
        try:
            q = solve_tool_pose(plant, tool_frame, _pose(R_WE, place), q, thorough=False)
        except ValueError:
            continue
        left = [
            turn
            for turn in left
            if turn == 0.0
            or _can_hold(context, plant, frame, joint, R_WE, place, q, axis, turn, margin)
        ]
    return left


def _pose(R_WE: FloatArray, place: FloatArray) -> RigidTransform:
    return RigidTransform(RotationMatrix(R_WE), np.asarray(place))


def _can_hold(
    context: Context,
    plant: MultibodyPlant,
    frame: Frame,
    joint: int,
    R_WE: FloatArray,
    place: FloatArray,
    q: FloatArray,
    axis: FloatArray,
    turn: float,
    margin: float,
) -> bool:
    turned = turned_about(np.asarray(R_WE).T, axis, turn).T
    low, high = plant.GetPositionLowerLimits()[joint], plant.GetPositionUpperLimits()[joint]
    for sign in (1.0, -1.0):
        trial = q.copy()
        trial[joint] += sign * turn
        plant.SetPositions(context, trial)
        X_WE = frame.CalcPoseInWorld(context)
        same = np.abs(X_WE.rotation().matrix() - turned).max() < _SAME
        if same and np.linalg.norm(X_WE.translation() - place) < _SAME:
            return bool(low + margin <= trial[joint] <= high - margin)
    for part in np.linspace(0.0, turn, max(math.ceil(abs(turn) / _STEP), 1) + 1)[1:]:
        before = q
        try:
            pose = _pose(turned_about(np.asarray(R_WE).T, axis, float(part)).T, place)
            q = solve_tool_pose(plant, frame.name(), pose, before, thorough=False)
        except ValueError:
            return False
        if np.abs(q - before).max() > _JUMP:
            return False
    return True


def _last_joint(plant: MultibodyPlant, frame: Frame) -> int:
    """Position of the joint of one degree of freedom that moves the tool, and least else."""
    tool = frame.body().index()
    last, fewest = 0, plant.num_bodies() + 1
    for joint in map(plant.get_joint, plant.GetJointIndices()):
        if joint.num_velocities() != 1:
            continue
        moved = plant.GetBodiesKinematicallyAffectedBy([joint.index()])
        if tool in moved and len(moved) < fewest:
            last, fewest = joint.position_start(), len(moved)
    return last
