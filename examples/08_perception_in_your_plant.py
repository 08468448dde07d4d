"""Perception in your own plant: obstacles from the images of an RgbdSensor, without the robot."""

import numpy as np
import pydrake.geometry as geometry
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import CameraInfo, RgbdSensor

from drake_oa.geometry.collision_scene import robot_geometries
from drake_oa.perception.depth_perception import DepthPerception
from drake_oa.robot.plant import make_parser

ARM = "package://drake_oa/panda/panda_arm_hand.urdf"
BOXES = {"table": ([2.0, 2.0, 0.1], [0.6, 0.0, -0.05]), "box": ([0.1, 0.1, 0.3], [0.7, 0.3, 0.15])}
# Pose of the camera: x to the right of the image, y down, z forward.
X_WC = RigidTransform(RollPitchYaw(np.radians([-130.0, 0.0, 90.0])), [1.6, 0.0, 1.0])


def main() -> None:
    """Prints the extent of each obstacle, with and without the self filter."""
    for self_filter in (True, False):
        builder = DiagramBuilder()
        plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.001)
        (arm,) = make_parser(plant).AddModelsFromUrl(ARM)  # A pydrake Parser that finds ARM.
        plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("panda_link0"))
        plant.set_gravity_enabled(arm, False)  # The arm rests without a controller.
        for name, (size, p_WB) in BOXES.items():
            pose, shape = RigidTransform(p_WB), geometry.Box(*size)
            plant.RegisterVisualGeometry(plant.world_body(), pose, shape, name, [0.5, 0.5, 0.5, 1])
        plant.Finalize()
        parameters = geometry.RenderEngineVtkParams()
        scene_graph.AddRenderer("vtk", geometry.MakeRenderEngineVtk(parameters))
        info, clipping = CameraInfo(320, 240, np.pi / 3.0), geometry.ClippingRange(0.1, 5.0)
        core = geometry.RenderCameraCore("vtk", info, clipping, RigidTransform())
        depth_camera = geometry.DepthRenderCamera(core, geometry.DepthRange(0.2, 3.0))
        world = scene_graph.world_frame_id()
        camera = builder.AddSystem(RgbdSensor(world, X_WC, depth_camera))
        builder.Connect(scene_graph.get_query_output_port(), camera.query_object_input_port())

        robot = robot_geometries(plant, scene_graph.model_inspector(), arm) if self_filter else None
        # RenderEngineVtk places the center of the first pixel at 0.5, real cameras at 0.
        perception = builder.AddSystem(DepthPerception(info, robot=robot, pixel_center=0.5))
        image, pose = camera.depth_image_32F_output_port(), camera.body_pose_in_world_output_port()
        builder.Connect(image, perception.GetInputPort("depth_image"))
        builder.Connect(pose, perception.GetInputPort("camera_pose"))
        if self_filter:
            state = plant.get_state_output_port(arm)
            builder.Connect(state, perception.GetInputPort("robot_state"))
        simulator = Simulator(builder.Build())
        simulator.AdvanceTo(0.2)
        context = perception.GetMyContextFromRoot(simulator.get_context())
        for cloud_W in perception.GetOutputPort("obstacles_W").Eval(context).clouds_W:
            low, high = cloud_W.min(axis=0).round(2), cloud_W.max(axis=0).round(2)
            print(f"self filter {self_filter}: obstacle from {low} to {high} m")


if __name__ == "__main__":
    main()
