"""The complete diagram: a robot that perceives obstacles and avoids them.

Each layer adds its systems by one function, and ports are connected by the names of their signals
(`drake_oa.common.signal_builder`). Another function can replace that of a layer:

    build_avoidance(scenario, layers=replace(Layers(), perception=my_source))

where `my_source(signals, scenario, station)` adds systems with the outputs that `Layers` lists for
this layer. `customize` adds, replaces or interposes single systems before the ports are connected:

    build_avoidance(scenario, customize=lambda s: s.interpose("obstacles_W", "filter", system))

`drake-oa graph SCENARIO` draws the layers, `drake-oa graph SCENARIO --signals` lists all signals.
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
"""Function that adds the systems of a layer; without a robot the station is None."""


def no_op(signals: SignalBuilder, scenario: Scenario, station: StationModel | None) -> None:
    """Adds no system, in place of a layer."""


@dataclass(frozen=True)
class Layers:
    """Functions that add the layers, in the order of construction and of the data flow.

    A function sees the signals of the layers before it (`"motion" in signals`), so the order of the
    fields matters. A function adds no system where the scenario does not need its layer.

    ================= ============================================ ================================
    layer             inputs                                       outputs
    ================= ============================================ ================================
    perception        depth_image, camera_pose, image_stamp,       obstacles_W, cloud, views
                      robot_state_at_image
    collision_scene   obstacles_W                                  collision_scene_W
    descriptor        obstacles_W                                  ellipsoids_W
    inference         ellipsoids_W, policy_state                   proposed_parameters
    route             ellipsoids_W, policy_state, goal             proposed_route
    verification      proposed_parameters, proposed_route,         coupling_parameters, route,
                      ellipsoids_W, collision_scene_W,             motion, demonstration
                      path_state, policy_state, goal
    policy            ellipsoids_W, coupling_parameters, route,    goal, policy_state, phase,
                      speed_scale, evasion_velocity                desired_position, _velocity,
                                                                   _acceleration
    posture           motion, policy_state                         desired_posture
    safety            collision_scene_W, robot_state, motion,      desired_joint_state,
                      policy_state, desired_posture,               desired_joint_acceleration,
                      desired motion of the tool                   path_state, speed_scale,
                                                                   evasion_velocity
    control           robot_state, desired motion of the joints    actuation, torque_saturation,
                      or of the tool                               tracking_error
    ================= ============================================ ================================

    Ground truth as the source of perception outputs collision_scene_W, too; given ellipsoids output
    ellipsoids_W. With `inference: !Paper` the layers verification and safety are empty, and
    inference and route output coupling_parameters and route.
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
    """Returns layers of the nominal motion: without perception, decisions and safety."""
    removed = (
        "perception",
        "collision_scene",
        "descriptor",
        "inference",
        "route",
        "verification",
        "safety",
    )
    return replace(layers, **dict.fromkeys(removed, no_op))


def build_avoidance(
    scenario: Scenario,
    *,
    avoid_obstacles: bool = True,
    layers: Layers | None = None,
    customize: Callable[[SignalBuilder], None] | None = None,
    meshcat: Meshcat | None = None,
    add_station: Callable[..., StationModel | None] = add_station,
) -> Diagram:
    """Builds the diagram of a scenario.

    It exports the outputs desired_position, phase and policy_state.

    Args:
        scenario: configuration of all systems.
        avoid_obstacles: whether obstacles are avoided; False: `without_avoidance`.
        layers: functions that add the layers; None: `Layers()`.
        customize: function that changes the signals before they are connected.
        meshcat: viewer, or None.
        add_station: function with the parameters of `drake_oa.diagrams.station.add_station` that
            adds robot and cameras, for example those of real hardware.

    Raises:
        ScenarioError: naming the wrong field.
        ValueError: if two systems output the same signal, or a system is interposed behind a
            signal without a source.
    """
    layers = layers or Layers()
    if not avoid_obstacles:
        layers = without_avoidance(layers)
    signals = SignalBuilder(DiagramBuilder())
    station = add_station(signals, scenario, avoid_obstacles=avoid_obstacles)
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
