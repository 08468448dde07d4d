"""Functions that add fault models, and systems that drive obstacles, to a scenario's diagram."""

from __future__ import annotations

import numpy as np

from drake_oa.common.config import ScenarioError
from drake_oa.common.signal_builder import SignalBuilder
from drake_oa.diagrams.station import StationModel
from drake_oa.scenario.faults import Push, TorqueSaturation
from drake_oa.scenario.obstacles import OBSTACLE_PREFIX
from drake_oa.scenario.scenario import Scenario, robot_of
from drake_oa.world.faults import ExternalPush, WeakActuators
from drake_oa.world.obstacles import ObstacleMover
from drake_oa.world.station import Station


def add_faults(signals: SignalBuilder, scenario: Scenario, station: StationModel | None) -> None:
    """Adds the fault models of a scenario, and the systems that drive moving obstacles.

    For faults `!TorqueSaturation`, the system weak_actuators limits the torques, and for faults
    `!Push`, the system push applies external wrenches to links. For each driven obstacle (which
    moves, appears or vanishes), a system mover_<model instance> is added, and plant_state is
    logged.

    Raises:
        ScenarioError: for a push on a link that the robot does not have; names the field.
    """
    if station is None:
        return
    plant = station.plant
    weak = [fault for fault in scenario.faults if isinstance(fault, TorqueSaturation)]
    if weak:
        actuators = map(plant.get_joint_actuator, plant.GetJointActuatorIndices(station.robot))
        limits = np.array([item.effort_limit() for item in actuators])
        signals.interpose("actuation", "weak_actuators", WeakActuators(weak, limits))
    pushes = []
    for number, fault in enumerate(scenario.faults):
        if not isinstance(fault, Push):
            continue
        link = fault.body or robot_of(scenario).hand_link
        if not plant.HasBodyNamed(link, station.robot):
            links = [plant.get_body(i).name() for i in plant.GetBodyIndices(station.robot)]
            raise ScenarioError(
                f"faults[{number}].body: the robot has no link '{link}'; valid: {', '.join(links)}"
            )
        pushes.append((fault, plant.GetBodyByName(link, station.robot).index()))
    if pushes:
        signals.add("push", ExternalPush(pushes))
        signals.add_sink("spatial_forces", plant.get_applied_spatial_force_input_port())
    movers = make_obstacle_movers(scenario, station)
    for name, mover in movers.items():
        instance = plant.GetModelInstanceByName(name)
        signals.add_source(f"{name}_state", plant.get_state_output_port(instance))
        signals.add(
            f"mover_{name}",
            mover,
            inputs={"obstacle_state": f"{name}_state"},
            outputs={"force": f"{name}_force"},
        )
        signals.add_sink(f"{name}_force", plant.get_actuation_input_port(instance))
    if movers:
        signals.log("plant_state")


def make_obstacle_movers(scenario: Scenario, station: Station) -> dict[str, ObstacleMover]:
    """Creates a system ObstacleMover for each obstacle that moves, appears or vanishes.

    Args:
        scenario: configuration of the obstacles.
        station: station whose plant contains the obstacles.

    Returns:
        Systems by the name of the obstacle's model instance.
    """
    movers = {}
    for obstacle in scenario.obstacles:
        if obstacle.is_driven:
            name = f"{OBSTACLE_PREFIX}_{obstacle.name}"
            body = station.plant.GetBodyByName("body", station.plant.GetModelInstanceByName(name))
            movers[name] = ObstacleMover(
                obstacle, mass=body.default_mass(), step=scenario.plant_step
            )
    return movers
