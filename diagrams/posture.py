"""Posture: what moves the arm in the null space of the tool's task."""

from __future__ import annotations

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.primitives import (
    ConstantValueSource,
)

from drake_oa.common.messages import FloatArray, PlannedMotion
from drake_oa.common.wires import Wires
from drake_oa.diagrams.arm import make_posture_guide
from drake_oa.diagrams.station import Cell
from drake_oa.posture.posture_follower import PostureFollower
from drake_oa.scenario.scenario import (
    Scenario,
)

_GUIDE_SAMPLES = 41
"""Of a posture that is not planned, along the motion."""


def add_posture(wires: Wires, scenario: Scenario, cell: Cell | None) -> None:
    """Adds posture_follower, or posture_guide and guide_follower where no motion is planned.

    They output desired_posture, the controller's.
    """
    if cell is None:
        return
    if "motion" in wires:
        q_rest = cell.q_start[cell.arm.index]
        wires.add("posture_follower", make_posture_follower(scenario, q_rest))
    elif (made := make_guide_follower(scenario, cell.q_start)) is not None:
        follower, guide = made
        wires.add("posture_guide", guide, offers={"y0": "guided_posture"})
        wires.add("guide_follower", follower, reads={"motion": "guided_posture", "evading": None})
    wires.log("desired_posture")


def make_posture_follower(scenario: Scenario, q_rest: FloatArray) -> PostureFollower:
    """What draws the null space to the planned posture; without one to q_rest (n,) [rad]."""
    policy, evasion = scenario.policy, scenario.evasion
    turn = {} if evasion is None else {"turn_acceleration": evasion.turn_acceleration}
    return PostureFollower(q_rest, policy.alpha_k, period=policy.period, **turn)


def make_guide_follower(
    scenario: Scenario, q_start: FloatArray
) -> tuple[PostureFollower, ConstantValueSource] | None:
    """What draws the null space from the joints at the start to those at the goal, unplanned.

    Args:
        scenario: with a robot.
        q_start: (nq,) its positions at the start.

    Returns:
        The follower and its motion; None where the task does not give the joints at the goal.
    """
    robot = scenario.robot
    if (
        robot is None
        or (guide := make_posture_guide(scenario, q_start[: len(robot.q_seed)])) is None
    ):
        return None
    s = np.linspace(0.0, 1.0, _GUIDE_SAMPLES)
    motion = PlannedMotion(s, np.zeros((len(s), 3)), guide(s))
    follower = PostureFollower(motion.q[0], scenario.policy.alpha_k, period=scenario.policy.period)
    return follower, ConstantValueSource(Value(motion))
