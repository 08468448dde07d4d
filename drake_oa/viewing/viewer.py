"""Drake's Meshcat as the commands use it: started, recorded, kept open."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator

from pydrake.geometry import Meshcat, MeshcatParams

RECORDING_RATE = 15.0
"""Frames of a recording a second."""


def start_viewer(*, announce: bool) -> Meshcat:
    """Starts a viewer for this machine only.

    Args:
        announce: print the viewer's address on stderr, at one of Meshcat's usual ports; without
            it the viewer has any free port.

    Raises:
        ValueError: if no port is free.
    """
    # Drake's default host is every interface.
    params = MeshcatParams(host="localhost", port=None if announce else 0)
    try:
        meshcat = Meshcat(params)
    except RuntimeError as error:
        raise ValueError(f"viewer: {str(error).rstrip('.')}; close another viewer") from None
    if announce:
        print(f"viewer: {meshcat.web_url()}", file=sys.stderr)
    return meshcat


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
