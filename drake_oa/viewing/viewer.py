"""Viewer (Meshcat) of the drake-oa commands: functions that start it, set its view, record the
scene, and keep it open.
"""

from __future__ import annotations

import contextlib
import math
import sys
from collections.abc import Iterator

import numpy as np
from pydrake.geometry import (
    Meshcat,
    MeshcatParams,
    MeshcatVisualizer,
    MeshcatVisualizerParams,
    Role,
    SceneGraph,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import DiagramBuilder

from drake_oa.viewing.panel import LivePage

FRAME_PERIOD = 1.0 / 30.0
"""Simulated time between two updates of the robot and its environment in the viewer Meshcat [s]."""
RECORDING_RATE = 15.0
"""Number of frames per second of simulated time in a recording of the viewer Meshcat [1/s]."""
_EYE_F, _TARGET_F = (2.45, -1.75, 1.30), (0.43, 0.0, 0.33)
"""Position of the viewer's camera, and the point at which it looks, in the floor frame F (origin
below the robot's base, x along the heading of the base, z up) [m]."""


def start_viewer(*, browser: bool) -> Meshcat:
    """Starts a Meshcat viewer that is reachable from this computer only.

    Args:
        browser: whether a browser will connect, so that Meshcat uses one of its usual ports;
            otherwise it uses any free port.

    Raises:
        ValueError: if no port is free.
    """
    # By default Drake's Meshcat would be reachable on all network interfaces.
    params = MeshcatParams(host="localhost", port=None if browser else 0)
    try:
        return Meshcat(params)
    except RuntimeError as error:
        raise ValueError(f"viewer: {str(error).rstrip('.')}; close another viewer") from None


def set_scene_style(meshcat: Meshcat, X_WB: RigidTransform, floor: float) -> None:
    """Sets the background and the camera of the viewer, and hides its grid and axes.

    The user can change all of these settings in the browser.

    Args:
        meshcat: Meshcat instance.
        X_WB: pose of the robot's base B in the world.
        floor: height of the floor in the world [m].
    """
    (x, y, _), ahead = X_WB.translation(), X_WB.rotation().col(0)
    R_WF = RotationMatrix.MakeZRotation(math.atan2(ahead[1], ahead[0]))
    X_WF = RigidTransform(R_WF, [x, y, floor])
    meshcat.SetProperty("/Background", "top_color", [0.80, 0.86, 0.92])
    meshcat.SetProperty("/Background", "bottom_color", [0.98, 0.98, 0.97])
    for path in ("/Grid", "/Axes"):
        meshcat.SetProperty(path, "visible", False)
    meshcat.SetCamera(Meshcat.PerspectiveCamera(fov=32.0, aspect=1.6, near=0.01, far=100.0))
    meshcat.SetCameraPose(X_WF @ np.array(_EYE_F), X_WF @ np.array(_TARGET_F))


def add_world_visualizer(
    builder: DiagramBuilder, scene_graph: SceneGraph, meshcat: Meshcat
) -> None:
    """Adds Drake's Meshcat visualizer to a builder, which displays the visual geometry of a scene
    graph in the viewer.
    """
    params = MeshcatVisualizerParams(
        role=Role.kIllustration, prefix="illustration", publish_period=FRAME_PERIOD
    )
    MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat, params)


def open_page(meshcat: Meshcat, title: str, description: str) -> LivePage:
    """Starts the server of Meshcat's live page with the panel (title, readings, legend), and prints
    the address of the page.

    Args:
        meshcat: Meshcat instance.
        title: title of the panel and of the browser window.
        description: text that follows the title in the panel.
    """
    page = LivePage(meshcat, title, description)
    print(f"viewer: {page.url}", file=sys.stderr)
    return page


@contextlib.contextmanager
def recording(meshcat: Meshcat | None) -> Iterator[None]:
    """Records Meshcat's scene in the `with` block, and makes the recording available in the browser
    at the end of the block, even after an exception.

    If `meshcat` is None, nothing is recorded.
    """
    if meshcat is None:
        yield
        return
    meshcat.DeleteRecording()
    meshcat.StartRecording(frames_per_second=RECORDING_RATE)
    try:
        yield
    finally:
        meshcat.StopRecording()
        meshcat.PublishRecording()


def wait_for_viewer() -> None:
    """Waits until the user presses Enter, so that the viewer stays open; returns immediately if the
    standard input is not a terminal.
    """
    if sys.stdin.isatty():
        with contextlib.suppress(EOFError, KeyboardInterrupt):
            input("press Enter to close the viewer ")
