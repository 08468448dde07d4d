"""The diagram that shows a log: the logged positions pose the world, nothing is simulated.

    log_player -> geometry_poses -> scene_graph -> illustration (Meshcat)
    log_player -> overlay

Without a robot there is the overlay alone.
"""

from __future__ import annotations

import numpy as np
from pydrake.geometry import (
    Meshcat,
    MeshcatVisualizer,
    MeshcatVisualizerParams,
    Role,
    SceneGraph,
)
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.rendering import MultibodyPositionToGeometryPose

from drake_oa.common.messages import FloatArray
from drake_oa.runs.log_player import LogPlayer
from drake_oa.runs.motion_log import MotionLog
from drake_oa.runs.replay import LoggedMotion, world_positions
from drake_oa.scenario.scenario import Scenario
from drake_oa.viewing.meshcat_overlay import MeshcatOverlay, dress_scene
from drake_oa.world.world_model import add_world

FRAME_PERIOD = 1.0 / 30.0


def build_replay(
    scenario: Scenario,
    log: MotionLog,
    meshcat: Meshcat,
    *,
    planned_W: FloatArray | None = None,
    speed: float = 1.0,
) -> Diagram:
    """Wires a log to the viewer.

    Args:
        scenario: the log's scenario.
        log: the motion.
        meshcat: the viewer.
        planned_W: (N, 3) the planned path [m]; None: the line from start to goal.
        speed: logged seconds that pass in one simulated second.

    Raises:
        ScenarioError: if the world cannot be built.
        ValueError: if the log is empty or not of this world.
    """
    builder = DiagramBuilder()
    dress_scene(meshcat)
    motion = LoggedMotion(scenario, log)
    positions = np.zeros((len(log.t), 0))
    if scenario.robot is None:
        player = builder.AddNamedSystem("log_player", LogPlayer(motion, positions, speed=speed))
    else:
        scene_graph = builder.AddNamedSystem("scene_graph", SceneGraph())
        plant = MultibodyPlant(time_step=scenario.plant_step)
        source = plant.RegisterAsSourceForSceneGraph(scene_graph)
        robot = add_world(plant, scenario)
        plant.Finalize()
        positions = world_positions(plant, robot, log)
        player = builder.AddNamedSystem("log_player", LogPlayer(motion, positions, speed=speed))
        poses = builder.AddNamedSystem("geometry_poses", MultibodyPositionToGeometryPose(plant))
        builder.Connect(player.GetOutputPort("positions"), poses.get_input_port())
        builder.Connect(poses.get_output_port(), scene_graph.get_source_pose_port(source))
        # The same path in the viewer's tree as that of a run.
        shown = MeshcatVisualizerParams(
            role=Role.kIllustration, prefix="illustration", publish_period=FRAME_PERIOD
        )
        MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat, shown)
    overlay = builder.AddNamedSystem(
        "overlay", MeshcatOverlay(meshcat, planned_W=planned_W, body_index=BodyIndex(0))
    )
    for name in ("ellipsoids_W", "policy_state", "body_poses"):
        builder.Connect(player.GetOutputPort(name), overlay.GetInputPort(name))
    diagram = builder.Build()
    diagram.set_name("replay")
    return diagram
