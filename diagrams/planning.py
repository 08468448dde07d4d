"""Planning: the motion of the whole arm, chosen among the true shapes of things."""

from __future__ import annotations

import logging
from collections.abc import Mapping

import numpy as np
from pydrake.geometry import Role

from drake_oa.common.config import ScenarioError
from drake_oa.common.wires import Wires
from drake_oa.diagrams.arm import make_posture_guide
from drake_oa.diagrams.policy import make_dmp
from drake_oa.diagrams.station import Cell
from drake_oa.planning.arm_world import make_chain
from drake_oa.planning.motion_search import MotionSearch
from drake_oa.planning.motion_selector import MotionSelector
from drake_oa.planning.sides import Sides
from drake_oa.regulation.config import Verified
from drake_oa.regulation.proposals import Proposer
from drake_oa.robot.spheres import ArmSpheres
from drake_oa.route.cost_rings import Ring
from drake_oa.scenario.perception import GivenEllipsoids
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.sources import perception_period
from drake_oa.scenario.tool_orientation import end_rotations, tool_orientation

Rings = Mapping[str, Ring] | None
"""Costs of sides of one's own, by name; None: there are none."""

_logger = logging.getLogger("drake_oa")

_TOUCHING = 1e-3
"""So deep in each other links are in contact for sure [m]."""
_LEAST_STEPS, _MOST_STEPS = 250, 1000
"""Steps of a roll-out a unit of normalised time."""


def add_motion_selector(
    wires: Wires, scenario: Scenario, cell: Cell | None, proposer: Proposer, rings: Rings = None
) -> None:
    """Adds motion_selector: solids_W, policy_state, goal, robot_state -> motion, demonstration
    and coupling_parameters; rings are costs of sides by name.

    Raises:
        ScenarioError: without a robot, or where nothing tells the shapes of things.
    """
    if cell is None:
        raise ScenarioError("regulation: !Verified needs a robot; this scenario has null")
    if isinstance(scenario.perception, GivenEllipsoids):
        raise ScenarioError(
            "regulation: !Verified needs obstacles that are seen; !GivenEllipsoids has the "
            "ellipsoids of obstacles that are dilated by the tool"
        )
    wires.add(
        "motion_selector",
        make_motion_selector(scenario, cell, proposer, rings),
        offers={"decision": "decision_regulation", "sides": "shown_route"},
    )
    wires.log("shortfall", "lowered", "decision_regulation")


def make_motion_selector(
    scenario: Scenario, cell: Cell, proposer: Proposer, rings: Rings = None
) -> MotionSelector:
    """What chooses the motion of the whole arm."""
    robot, regulation, policy, task = (
        scenario.robot,
        scenario.regulation,
        scenario.policy,
        scenario.task,
    )
    if robot is None or not isinstance(regulation, Verified):
        raise ScenarioError("regulation: is not !Verified, or there is no robot")
    arm = cell.arm
    spheres = cell.spheres.arrays
    _refuse_start(cell, cell.spheres)
    _tell_of_bare_links(cell, cell.spheres)
    dmp = make_dmp(scenario)
    steps = min(max(round(dmp.duration / policy.period), _LEAST_STEPS), _MOST_STEPS)
    held, R_WE = tool_orientation(scenario), end_rotations(scenario)[0].matrix()
    guide = make_posture_guide(scenario, arm.posture)
    q_rest = np.array(arm.posture)
    search = MotionSearch(
        Sides(proposer, rings or {}, regulation.ring_price),
        dmp,
        task.clearance,
        make_chain(arm, spheres),
        spheres,
        parameters=regulation,
        steps=steps,
        fade=policy.fade,
        orientation=(lambda s: np.tile(R_WE, (len(s), 1, 1))) if held is None else held.along,
        posture=(lambda s: np.tile(q_rest, (len(s), 1))) if guide is None else guide,
        overshoot=cell.spheres.overshoot,
        q_goal=None if task.q_goal is None else np.asarray(task.q_goal, dtype=float),
    )
    return MotionSelector(
        search,
        tuple(arm.index.tolist()),
        cell.robot_plant.plant.num_multibody_states(),
        period=perception_period(scenario),
        thinking=scenario.thinking,
        step=policy.period,
    )


def _refuse_start(cell: Cell, arm: ArmSpheres) -> None:
    """Refuses an arm that begins in itself.

    Raises:
        ScenarioError: naming its links.
    """
    robot = cell.robot_plant
    context = robot.diagram.CreateDefaultContext()
    robot.plant.SetPositions(robot.plant.GetMyMutableContextFromRoot(context), cell.q_start)
    query = robot.scene_graph.get_query_output_port().Eval(
        robot.scene_graph.GetMyContextFromRoot(context)
    )
    kept_apart = {frozenset((arm.bodies[a], arm.bodies[b])) for a, b in arm.arrays.pairs}
    inspector = robot.scene_graph.model_inspector()
    for hit in query.ComputePointPairPenetration():
        one, other = (
            robot.plant.GetBodyFromFrameId(inspector.GetFrameId(geometry)).name()
            for geometry in (hit.id_A, hit.id_B)
        )
        if frozenset((one, other)) in kept_apart and hit.depth > _TOUCHING:
            raise ScenarioError(
                f"task.start: with the arm there, {one} is {1e3 * hit.depth:.0f} mm inside "
                f"{other}; another task.start, or task.q_start or robot.q_seed where it is clear "
                "of itself"
            )


def _tell_of_bare_links(cell: Cell, arm: ArmSpheres) -> None:
    """Says which links are to be seen, but have no shape that could be kept clear."""
    plant, inspector = cell.robot_plant.plant, cell.robot_plant.scene_graph.model_inspector()
    bare = [
        body.name()
        for body in map(plant.get_body, plant.GetBodyIndices(cell.robot_plant.instance))
        if body.name() not in arm.bodies
        and inspector.NumGeometriesForFrameWithRole(
            plant.GetBodyFrameIdOrThrow(body.index()), Role.kPerception
        )
    ]
    if bare:
        _logger.warning(
            "robot.model: %s: no collision geometry, so nothing keeps it clear", ", ".join(bare)
        )
