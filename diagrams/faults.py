"""What goes wrong, and what moves the obstacles: the simulated world's part."""

from __future__ import annotations

import numpy as np

from drake_oa.common.config import ScenarioError
from drake_oa.common.wires import Wires
from drake_oa.diagrams.station import Cell
from drake_oa.perception.config import CameraSource
from drake_oa.scenario.faults import CameraDropout, Push, TorqueSaturation
from drake_oa.scenario.obstacles import OBSTACLE_PREFIX
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.sources import perception_period
from drake_oa.world.faults import CameraFaults, ExternalPush, WeakActuators
from drake_oa.world.obstacles import ObstacleMover
from drake_oa.world.station import Station


def add_faults(wires: Wires, scenario: Scenario, cell: Cell | None) -> None:
    """Puts what goes wrong between the signals that it befalls, and drives the obstacles."""
    if cell is None:
        return
    source = scenario.perception
    if isinstance(source, CameraSource) and cell.cameras:
        for name in source.names:
            faults = make_camera_faults(scenario, cell, name)
            if faults is None:
                continue
            own = ("depth_image", "image_stamp")
            names: dict[str, str | None] = {port: source.signal(port, name) for port in own}
            names["robot_state"] = source.signal("robot_state_at_image", name)
            wires.interpose(
                [source.signal(port, name) for port in ("depth_image", "robot_state_at_image")],
                source.signal("camera_faults", name),
                faults,
                reads=names,
                offers=names,
            )
    weak = make_weak_actuators(scenario, cell)
    if weak is not None:
        wires.interpose("actuation", "weak_actuators", weak)
    add_drivers(wires, scenario, cell)


def add_drivers(wires: Wires, scenario: Scenario, station: Station) -> None:
    """Adds push and mover_<model instance>; where these drive obstacles, the world is logged."""
    plant = station.plant
    push = make_push(scenario, station)
    if push is not None:
        wires.add("push", push)
        wires.take("spatial_forces", plant.get_applied_spatial_force_input_port())
    movers = make_obstacle_movers(scenario, station)
    for name, mover in movers.items():
        instance = plant.GetModelInstanceByName(name)
        wires.offer(f"{name}_state", plant.get_state_output_port(instance))
        wires.add(
            f"mover_{name}",
            mover,
            reads={"obstacle_state": f"{name}_state"},
            offers={"force": f"{name}_force"},
        )
        wires.take(f"{name}_force", plant.get_actuation_input_port(instance))
    if movers:
        wires.log("plant_state")


def make_camera_faults(scenario: Scenario, station: Station, name: str) -> CameraFaults | None:
    """What is wrong with a camera that perception sees by; None: nothing."""
    faults = [
        fault
        for fault in scenario.faults
        if isinstance(fault, CameraDropout) and fault.camera in ("", name)
    ]
    if not faults:
        return None
    return CameraFaults(
        faults,
        station.cameras[name].intrinsics,
        num_states=station.plant.num_multibody_states(station.robot),
        period=perception_period(scenario),
    )


def make_weak_actuators(scenario: Scenario, station: Station) -> WeakActuators | None:
    """What is wrong with the robot's actuators; None: nothing."""
    faults = [fault for fault in scenario.faults if isinstance(fault, TorqueSaturation)]
    if not faults:
        return None
    plant = station.plant
    actuators = map(plant.get_joint_actuator, plant.GetJointActuatorIndices(station.robot))
    return WeakActuators(faults, np.array([item.effort_limit() for item in actuators]))


def make_obstacle_movers(scenario: Scenario, station: Station) -> dict[str, ObstacleMover]:
    """Model instance -> what drives it, of every obstacle that moves, appears or vanishes."""
    movers = {}
    for obstacle in scenario.obstacles:
        if obstacle.driven:
            name = f"{OBSTACLE_PREFIX}_{obstacle.name}"
            body = station.plant.GetBodyByName("body", station.plant.GetModelInstanceByName(name))
            movers[name] = ObstacleMover(
                np.array(obstacle.waypoints, dtype=float).reshape(-1, 4),
                mass=body.default_mass(),
                step=scenario.plant_step,
                present=obstacle.present,
            )
    return movers


def make_push(scenario: Scenario, station: Station) -> ExternalPush | None:
    """What pushes the robot; None: nothing does.

    Raises:
        ScenarioError: naming the push of a link that the robot does not have.
    """
    plant, pushes = station.plant, []
    for number, fault in enumerate(scenario.faults):
        if not isinstance(fault, Push):
            continue
        link = fault.body or (scenario.robot.hand_link if scenario.robot else "")
        if not plant.HasBodyNamed(link, station.robot):
            names = [plant.get_body(i).name() for i in plant.GetBodyIndices(station.robot)]
            raise ScenarioError(
                f"faults[{number}].body: the robot has no link '{link}'; it has {', '.join(names)}"
            )
        pushes.append((fault, plant.GetBodyByName(link, station.robot).index()))
    return ExternalPush(pushes) if pushes else None
