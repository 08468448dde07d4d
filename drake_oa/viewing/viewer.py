"""Drake's Meshcat as the commands use it: started, dressed, recorded, kept open."""

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
"""Time between two pictures of the world [s]."""
RECORDING_RATE = 15.0
"""Frames of a recording a second."""
_EYE_F, _TARGET_F = (2.45, -1.75, 1.30), (0.43, 0.0, 0.33)
"""Position of the viewer's camera, and the point that it looks at, in the floor's frame F [m]."""


def start_viewer(*, browser: bool) -> Meshcat:
    """Starts a viewer for this machine only.

    Args:
        browser: take one of Meshcat's usual ports, as a browser connects to it; without it the
            viewer has any free port.

    Raises:
        ValueError: if no port is free.
    """
    # Drake's default host is every interface.
    params = MeshcatParams(host="localhost", port=None if browser else 0)
    try:
        return Meshcat(params)
    except RuntimeError as error:
        raise ValueError(f"viewer: {str(error).rstrip('.')}; close another viewer") from None


def looking_pose(
    X_WF: RigidTransform, p_FC: ArrayLike = _EYE_F, p_FT: ArrayLike = _TARGET_F
) -> RigidTransform:
    """Returns X_WC of a camera C that looks along its z axis at T, x to the right of the image.

    Args:
        X_WF: frame of the two points.
        p_FC: (3,) position of the camera [m].
        p_FT: (3,) the point that it looks at [m].
    """
    p_WC = X_WF @ np.asarray(p_FC)
    ahead = X_WF @ np.asarray(p_FT) - p_WC
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    axes = np.column_stack([right, np.cross(ahead, right), ahead])
    return RigidTransform(RotationMatrix(axes / np.linalg.norm(axes, axis=0)), p_WC)


def dress_scene(meshcat: Meshcat, X_WB: RigidTransform, floor: float) -> None:
    """Prepares the view for presentation: background and camera.

    Hides grid and axes. All of it can be changed in the browser.

    Args:
        meshcat: the viewer.
        X_WB: pose of the robot's base.
        floor: height of the floor's frame F, which has the base's heading [m].
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


def show_world(builder: DiagramBuilder, scene_graph: SceneGraph, meshcat: Meshcat) -> None:
    """Adds Drake's visualizer of a scene graph to a builder."""
    params = MeshcatVisualizerParams(
        role=Role.kIllustration, prefix="illustration", publish_period=FRAME_PERIOD
    )
    MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat, params)


def open_page(meshcat: Meshcat, title: str, description: str) -> LivePage:
    """Serves the viewer's page with the panel, and prints its address."""
    page = LivePage(meshcat, title, description)
    print(f"viewer: {page.url}", file=sys.stderr)
    return page


@contextlib.contextmanager
def recording(meshcat: Meshcat | None) -> Iterator[None]:
    """Records the scene of a viewer, also when it is cut short; None: nothing is recorded."""
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
    """Keeps the viewer until Enter is pressed, where somebody can press it."""
    if sys.stdin.isatty():
        with contextlib.suppress(EOFError, KeyboardInterrupt):
            input("press Enter to close the viewer ")
