"""Safety: what slows, holds or stops the motion, and gets the arm out of the way."""

from __future__ import annotations

from drake_oa.common.config import ScenarioError
from drake_oa.common.wires import Wires
from drake_oa.diagrams.policy import make_dmp
from drake_oa.diagrams.route import held_annulus
from drake_oa.diagrams.station import Cell
from drake_oa.perception.config import GroundTruth
from drake_oa.safety.guarded_arm import GuardedArm
from drake_oa.safety.obstacle_evasion import ObstacleEvasion
from drake_oa.safety.supervisor import Supervisor
from drake_oa.scenario.perception import GivenEllipsoids
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.sources import padding, perception_period


def add_safety(wires: Wires, scenario: Scenario, cell: Cell | None) -> None:
    """Adds supervisor and evasion.

    They read solids_W, robot_state, policy_state, motion and what the controller says of
    itself; they offer speed_scale, evasion and evading.
    """
    if cell is None or scenario.supervisor is None:
        return
    wires.add("supervisor", make_supervisor(scenario, cell.guarded_arm))
    if "obstacles_W" in wires and scenario.evasion is not None:
        # Who follows a motion's posture turns the arm as well.
        turns = "motion" in wires and "desired_posture" in wires
        wires.add(
            "evasion",
            make_evasion(scenario, cell.guarded_arm, turns=turns),
            offers={"decision": "decision_evasion"},
        )
    wires.log("speed_scale", "evasion", "decision_evasion")


def make_supervisor(scenario: Scenario, arm: GuardedArm) -> Supervisor:
    """What watches the motion; it decides as often as the policy steps.

    Raises:
        ScenarioError: if the scenario has no supervisor.
    """
    given, policy = scenario.supervisor, scenario.policy
    if given is None:
        raise ScenarioError("supervisor: this scenario has null")
    return Supervisor(
        arm,
        make_dmp(scenario).duration,
        period=policy.period,
        parameters=given,
        padding=_padding(scenario),
        hold_time=policy.hold_time,
        frame_period=perception_period(scenario),
        max_age=policy.max_observation_age,
    )


def _padding(scenario: Scenario) -> float:
    """How much nearer what moves may be than it is seen [m]."""
    exact = isinstance(scenario.perception, (GroundTruth, GivenEllipsoids))
    return 0.0 if exact else padding(scenario.perception)


def make_evasion(scenario: Scenario, arm: GuardedArm, *, turns: bool = True) -> ObstacleEvasion:
    """What gets the arm out of the way of what moves; it decides with every observation.

    Args:
        scenario: of the robot.
        arm: of it.
        turns: whether there is a posture follower, which turns the arm.

    Raises:
        ScenarioError: if the scenario has none.
    """
    given, policy = scenario.evasion, scenario.policy
    if given is None:
        raise ScenarioError("evasion: this scenario has null")
    return ObstacleEvasion(
        arm,
        make_dmp(scenario),
        period=perception_period(scenario),
        step=policy.period,
        max_age=policy.max_observation_age,
        parameters=given,
        padding=_padding(scenario),
        hold_time=policy.hold_time,
        turns=turns,
        table_height=policy.table_height,
        annulus=held_annulus(scenario),
        thinking=scenario.thinking,
    )
