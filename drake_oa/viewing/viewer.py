"""Drake's Meshcat as the commands use it: started, recorded, kept open."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator

from pydrake.geometry import Meshcat, MeshcatParams

from drake_oa.viewing.panel import LivePage

RECORDING_RATE = 15.0
"""Frames of a recording a second."""


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
