"""Builder of the complete diagram: a robot that perceives obstacles and avoids them.

One function adds the systems of each layer, and ports are connected by the names of their signals
(`drake_oa.common.signal_builder`). Another function can replace the function of a layer:

    build_avoidance(scenario, layers=replace(Layers(), perception=my_source))

where `my_source(signals, scenario, station)` adds systems with the outputs that `Layers` lists for
this layer. `customize` adds or replaces single systems, or inserts (interposes) them between the
source of a signal and its readers, before the ports are connected:

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
"""Function (signals, scenario, station) that adds the systems of a layer to a diagram.

The first argument is the `SignalBuilder` that receives the systems. The station (plant and cameras)
is None for a scenario without a robot."""


def no_op(signals: SignalBuilder, scenario: Scenario, station: StationModel | None) -> None:
    """Adds no system; used in `Layers` in place of the function of a layer that is left out."""


@dataclass(frozen=True)
class Layers:
    """Functions that add the layers to the diagram, in the order of construction and data flow.

    A function can check for the signals of the previous layers (`"motion" in signals`), so the
    order of the fields matters. A function adds no system if the scenario does not require the
    layer.

    - perception: point clouds of the obstacles.
    - collision_scene: collision geometry of the obstacles.
    - descriptor: ellipsoids around obstacles dilated by the tool.
    - inference: parameters of the coupling terms by neural networks.
    - route: side on which each obstacle is passed, by cost rings.
    - verification: search for a motion, with simulations of the whole arm.
    - policy: motion of the tool by a movement primitive with coupling terms.
    - posture: nominal posture, to which the null space of the arm is attracted.
    - safety: joint command, with speed limits and maneuvers away from moving obstacles.
    - control: joint torques.

    ================= ============================================ ================================
    layer             inputs                                       outputs
    ================= ============================================ ================================
    perception        depth_image, camera_pose, image_stamp,       obstacles_W, free_space_W, cloud
                      plant_state_at_image
    collision_scene   obstacles_W, camera_pose, free_space_W       collision_scene_W
    descriptor        obstacles_W, goal if it moves                ellipsoids_W
    inference         ellipsoids_W, policy_state                   proposed_parameters
    route             ellipsoids_W, policy_state, goal             proposed_route
    verification      proposed_parameters, proposed_route,         coupling_parameters, route,
                      ellipsoids_W, collision_scene_W,             motion, demonstration
                      path_state, policy_state, goal
    policy            ellipsoids_W, coupling_parameters, route,    goal, policy_state, phase,
                      speed_scale, evasion_velocity,               desired_position, _velocity,
                      demonstration                                _acceleration, and if the tool
                                                                   rotates desired_orientation,
                                                                   desired_angular_velocity,
                                                                   desired_angular_acceleration
    posture           motion, policy_state                         desired_posture
    safety            collision_scene_W, free_space_W,             desired_joint_state,
                      robot_state, motion, demonstration,          desired_joint_acceleration,
                      policy_state, desired_posture,               path_state, speed_scale,
                      torque_saturation, stopping, desired         evasion_velocity,
                      motion of the tool                           tracking_error
    control           robot_state, desired motion of the joints,   actuation, torque_saturation,
                      or without the safety layer that of the      stopping; without the safety
                      tool and desired_posture                     layer tracking_error
    ================= ============================================ ================================

    cloud is the point cloud that the viewer draws, and free_space_W the space that the cameras
    observed to be free. path_state is the state that the robot has on the verified motion at the
    present phase; the predictions of the verification layer start from it. evasion_velocity is the
    velocity that moves the desired position to the tool if a maneuver has made no progress toward
    the verified motion for 1 s. stopping is 1 while the controller brakes the joints because an
    input is not finite.

    With `perception: !GroundTruth` (exact obstacles of the simulated world), the perception layer
    reads query_object, and with `inference: !Verified` also outputs collision_scene_W. With
    `!GivenEllipsoids` (ellipsoids in the scenario), it outputs ellipsoids_W only. With
    `inference: !Paper` (motions are not verified by roll-outs, which are simulations of the whole
    arm), the layers collision_scene, verification and safety add no system; inference and route
    output coupling_parameters and route.
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
    """Returns the layers of a diagram for the nominal motion, which does not avoid obstacles.

    The nominal motion is the demonstrated one, or a straight minimum-jerk motion. The layers
    perception, collision_scene, descriptor, inference, route, verification and safety add nothing.

    Args:
        layers: functions that add the layers.
    """
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
    """Builds the diagram of a scenario: station, all layers from cameras to torques, and loggers.

    The diagram has the output ports desired_position ((3,), tool point in the world [m]), phase
    ((1,), of the movement primitive, 1 at the start and decaying to 0) and policy_state
    (`PolicyState`).

    Args:
        scenario: configuration of all systems.
        avoid_obstacles: whether obstacles are avoided; False: the layers are reduced by
            `without_avoidance` to those of the nominal motion.
        layers: functions that add the layers; None: `Layers()`.
        customize: function that adds, replaces or interposes systems of the `SignalBuilder` before
            the ports are connected; None: no change.
        meshcat: viewer of the motion; None: no viewer.
        add_station: function with the parameters of `drake_oa.diagrams.station.add_station` that
            adds robot and cameras, for example those of real hardware.

    Raises:
        ScenarioError: if the scenario is invalid; names the field.
        ValueError: if two systems output the same signal, or a system is interposed on a signal
            without a source.
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
