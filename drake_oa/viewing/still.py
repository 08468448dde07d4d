"""Drawing of a scenario before its run: an image of the station (simulated robot and its world),
and the depth images of its cameras.
"""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    GeometryInstance,
    MakeRenderEngineVtk,
    PerceptionProperties,
    RenderCameraCore,
    RenderEngineVtkParams,
    Rgba,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import CameraInfo

from drake_oa.common.files import saved_figure
from drake_oa.geometry.pinhole import look_at_pose
from drake_oa.robot.plant import base_pose
from drake_oa.scenario.end_poses import start_positions
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.sources import with_simulated_cameras
from drake_oa.world.cameras import add_mesh_normals
from drake_oa.world.station import make_station

_WIDTH, _HEIGHT, _FOV = 960, 720, 0.52
"""Width and height of the drawn image of the station [pixel], and vertical field of view of its
virtual camera [rad]."""
_EYE_B, _AT_B = (2.3, -1.8, 1.4), (0.4, 0.0, 0.3)
"""Position of the virtual camera that views the station, and the point at which it looks, in the
frame of the robot's base B [m]."""
_MARK, _GREEN, _RED = 0.02, Rgba(0.1, 0.6, 0.2), Rgba(0.8, 0.1, 0.1)
"""Radius of the spheres that mark start and goal in the drawn image [m], color of the start sphere,
and color of the goal sphere."""
_RENDERER = "still"
"""Name of the render engine that draws the image of the station, in the station's scene graph."""


def draw_scenario(scenario: Scenario, file: Path) -> None:
    """Draws an image of the simulated station with the arm at the start, beside the depth images of
    all its cameras, into a file.

    Args:
        scenario: scenario with a robot.
        file: image file to be written; the suffix selects a format of matplotlib.

    Raises:
        ScenarioError: naming the invalid field of the scenario.
    """
    scenario = with_simulated_cameras(copy.deepcopy(scenario))
    for config in scenario.cameras:
        config.output_delay = 0.0
    builder = DiagramBuilder()
    station = make_station(builder, scenario)
    graph = station.scene_graph
    source = station.plant.get_source_id()
    for name, position, color in (
        ("start", scenario.task.start, _GREEN),
        ("goal", scenario.task.goal, _RED),
    ):
        ball = GeometryInstance(RigidTransform(position), Sphere(_MARK), name)
        properties = PerceptionProperties()
        properties.AddProperty("phong", "diffuse", color)
        ball.set_perception_properties(properties)
        graph.RegisterAnchoredGeometry(source, ball)
    params = RenderEngineVtkParams(default_clear_color=[0.93, 0.95, 0.97])
    add_mesh_normals(graph, source)
    graph.AddRenderer(_RENDERER, MakeRenderEngineVtk(params))
    station.plant.SetDefaultPositions(station.robot, start_positions(scenario))
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    core = RenderCameraCore(
        _RENDERER, CameraInfo(_WIDTH, _HEIGHT, _FOV), ClippingRange(0.05, 20.0), RigidTransform()
    )
    query = graph.get_query_output_port().Eval(graph.GetMyContextFromRoot(context))
    X_WC = look_at_pose(base_pose(scenario.robot), _EYE_B, _AT_B)
    picture = query.RenderColorImage(ColorRenderCamera(core), graph.world_frame_id(), X_WC)
    panels = 1 + len(station.cameras)
    with saved_figure(file, 6.4 * panels, 4.8) as figure:
        axes = figure.subplots(1, panels, squeeze=False)[0]
        axes[0].imshow(picture.data[..., :3])
        axes[0].set_title("at the start; green: start, red: goal")
        for axis, (name, camera) in zip(axes[1:], station.cameras.items(), strict=True):
            port = camera.depth_image
            depth = port.Eval(port.get_system().GetMyContextFromRoot(context)).data[..., 0]
            plot = axis.imshow(np.where(np.isfinite(depth) & (depth > 0.0), depth, np.nan))
            figure.colorbar(plot, ax=axis, label="depth [m]", shrink=0.8)
            axis.set_title(f"camera '{name}', without noise")
        for axis in axes:
            axis.set_axis_off()
