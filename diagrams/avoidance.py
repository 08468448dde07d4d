"""The whole diagram: a robot that sees obstacles and goes round them.

Each layer adds its systems by a function of its own, and all are connected by the names of
their signals (`drake_oa.common.signal_builder`). A layer of one's own takes a layer's place:

    build_avoidance(scenario, layers=replace(Layers(), perception=my_source))

where `my_source(wires, scenario, station)` adds systems that offer what the layer offers, see
`Layers`. Systems are added, replaced or put between two layers by a last word of one's own:

    build_avoidance(scenario, customize=lambda w: w.interpose("obstacles_W", "mine", system))

`drake-oa graph SCENARIO` draws what comes of it, `drake-oa graph SCENARIO --signals` lists it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

from pydrake.geometry import Meshcat
from pydrake.systems.framework import Diagram, DiagramBuilder

from drake_oa.common.signal_builder import SignalBuilder
from drake_oa.diagrams.control import add_control, add_posture, add_safety
from drake_oa.diagrams.faults import add_faults
from drake_oa.diagrams.motion import add_inference, add_policy, add_route, add_verification
from drake_oa.diagrams.perception import add_collision_scene, add_descriptor, add_perception
from drake_oa.diagrams.station import StationModel, add_station
from drake_oa.diagrams.view import add_view
from drake_oa.scenario.scenario import Scenario

AddLayer = Callable[[SignalBuilder, Scenario, StationModel | None], None]
"""Adds a layer's systems to the wires; the station is None without a robot."""


def no_op(signals: SignalBuilder, scenario: Scenario, station: StationModel | None) -> None:
    """Adds nothing, in place of a layer."""


@dataclass(frozen=True)
class Layers:
    """What adds each layer, in the order data flows; each may decline.

    Attributes:
        perception: offers obstacles_W (`ObstacleClouds`, with velocities), and cloud for a viewer.
        collision_scene: obstacles_W -> collision_scene_W (`CollisionScene`), unless perception offers them.
        descriptor: obstacles_W -> ellipsoids_W (`EllipsoidSet`), unless these are given.
        inference: ellipsoids_W, policy_state, goal -> coupling_parameters, or with verification
            proposed_parameters.
        route: the same and coupling_parameters -> route, or with verification proposed_route.
        verification: proposed_parameters, proposed_route, collision_scene_W, ellipsoids_W, robot_state,
            policy_state, goal -> coupling_parameters, route, motion and demonstration; nothing
            with `!Paper`.
        policy: goal, and dmp_integrator: ellipsoids_W, coupling_parameters, route, speed_scale,
            evasion_velocity -> policy_state, phase and desired_position, _velocity, _acceleration.
        posture: motion, policy_state -> desired_posture.
        safety: collision_scene_W, robot_state, policy_state, motion, desired_posture and the desired motion
            of the tool -> desired_joint_state and _acceleration, path_state, speed_scale and
            evasion_velocity; nothing with `!Paper`.
        control: robot_state and the desired motion -> actuation, torque_saturation.
    """

    perception: AddLayer = add_perception
    collision_scene: AddLayer = add_collision_scene
    descriptor: AddLayer = add_descriptor
    inference: AddLayer = add_inference
    route: AddLayer = add_route
    verification: AddLayer = add_verification
    policy: AddLayer = add_policy
    posture: AddLayer = add_posture
    safety: AddLayer = add_safety
    control: AddLayer = add_control


def without_avoidance(layers: Layers) -> Layers:
    """The same without what bends the motion: nothing is seen, decided or held."""
    blind = (
        "perception",
        "collision_scene",
        "descriptor",
        "inference",
        "route",
        "verification",
        "safety",
    )
    return replace(layers, **dict.fromkeys(blind, no_op))


def build_avoidance(
    scenario: Scenario,
    *,
    avoid_obstacles: bool = True,
    layers: Layers | None = None,
    customize: Callable[[SignalBuilder], None] | None = None,
    meshcat: Meshcat | None = None,
    add_station_model: Callable[..., StationModel | None] = add_station,
) -> Diagram:
    """SignalBuilder a scenario.

    The diagram exports desired_position, phase and policy_state.

    Args:
        scenario: what to build.
        avoid_obstacles: whether the motion is bent round obstacles; see `without_avoidance`.
        layers: what adds each layer; None: `Layers()`.
        customize: called with the wires before they are connected.
        meshcat: viewer, or None.
        add_station_model: adds the robot and its cameras, called as `add_station`: simulated ones, or those
            that there are.

    Raises:
        ScenarioError: naming the field that does not fit.
        ValueError: from the wires, if two systems offer the same signal, or one is put behind a
            signal that nothing offers.
    """
    layers = layers or Layers()
    if not avoid_obstacles:
        layers = without_avoidance(layers)
    signals = SignalBuilder(DiagramBuilder())
    station = add_station_model(signals, scenario, avoid_obstacles=avoid_obstacles)
    for layer in fields(layers):
        getattr(layers, layer.name)(signals, scenario, station)
    add_faults(signals, scenario, station)
    if meshcat is not None:
        add_view(signals, scenario, station, meshcat)
    if customize is not None:
        customize(signals)
    signals.connect()
    diagram = signals.builder.Build()
    diagram.set_name("avoidance")
    return diagram
