"""Functions that start, set up, record and keep open Drake's Meshcat for the commands."""

from __future__ import annotations

import contextlib
import math
import sys
from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike
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
"""Time between two updates of the robot and the environment in the viewer [s]."""
RECORDING_RATE = 15.0
"""Frame rate of a recording [1/s]."""
_EYE_F, _TARGET_F = (2.45, -1.75, 1.30), (0.43, 0.0, 0.33)
"""Position of the viewer's camera, and the point that it looks at, in the floor frame F [m]."""


def start_viewer(*, browser: bool) -> Meshcat:
    """Starts Meshcat for this computer only.

    Args:
        browser: whether a browser will connect, so that one of Meshcat's usual ports is required;
            otherwise any free port is used.

    Raises:
        ValueError: if no port is free.
    """
    # By default Drake's Meshcat would be reachable on all network interfaces.
    params = MeshcatParams(host="localhost", port=None if browser else 0)
    try:
        return Meshcat(params)
    except RuntimeError as error:
        raise ValueError(f"viewer: {str(error).rstrip('.')}; close another viewer") from None


def look_at_pose(
    X_WF: RigidTransform, p_FC: ArrayLike = _EYE_F, p_FT: ArrayLike = _TARGET_F
) -> RigidTransform:
    """Returns the pose X_WC of a camera C whose z axis points at T, with x to the image's right.

    Args:
        X_WF: frame of the two points.
        p_FC: (3,) position of the camera [m].
        p_FT: (3,) position of the target T [m].
    """
    p_WC = X_WF @ np.asarray(p_FC)
    ahead = X_WF @ np.asarray(p_FT) - p_WC
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    axes = np.column_stack([right, np.cross(ahead, right), ahead])
    return RigidTransform(RotationMatrix(axes / np.linalg.norm(axes, axis=0)), p_WC)


def set_scene_style(meshcat: Meshcat, X_WB: RigidTransform, floor: float) -> None:
    """Sets background and camera of the viewer, and hides grid and axes.

    The user can change all of these settings in the browser.

    Args:
        meshcat: Meshcat instance.
        X_WB: pose of the robot's base.
        floor: height of the floor frame F, whose x axis has the heading of the base [m].
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
    """Adds Drake's Meshcat visualizer of a scene graph to a builder."""
    params = MeshcatVisualizerParams(
        role=Role.kIllustration, prefix="illustration", publish_period=FRAME_PERIOD
    )
    MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat, params)


def open_page(meshcat: Meshcat, title: str, description: str) -> LivePage:
    """Serves Meshcat's page with the panel, and prints its address."""
    page = LivePage(meshcat, title, description)
    print(f"viewer: {page.url}", file=sys.stderr)
    return page


@contextlib.contextmanager
def recording(meshcat: Meshcat | None) -> Iterator[None]:
    """Records Meshcat within the block, and publishes the recording even after an exception.

    Without Meshcat (None) nothing is recorded.
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
    """Waits until Enter is pressed, if the standard input is a terminal."""
    if sys.stdin.isatty():
        with contextlib.suppress(EOFError, KeyboardInterrupt):
            input("press Enter to close the viewer ")
