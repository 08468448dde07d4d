"""Drake's Meshcat as the commands use it: started, recorded, kept open."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path

from pydrake.geometry import Meshcat, MeshcatParams

from drake_oa.common.files import replace_text

RECORDING_RATE = 15.0
"""Frames of a recording a second."""


def start_viewer(*, announce: bool) -> Meshcat:
    """A viewer for this machine only; `announce` says on stderr where it is."""
    # Drake's default host is every interface.
    meshcat = Meshcat(MeshcatParams(host="localhost"))
    if announce:
        print(f"viewer: {meshcat.web_url()}", file=sys.stderr)
    return meshcat


@contextlib.contextmanager
def recording(meshcat: Meshcat | None, html: Path | None) -> Iterator[None]:
    """Records what is shown, also when it is cut short, and writes the page.

    Args:
        meshcat: the viewer; None: nothing is recorded.
        html: the page to write, or None.
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
        if html is not None:
            replace_text(html, meshcat.StaticHtml())


def wait_for_viewer() -> None:
    """Keeps the viewer until Enter is pressed, where somebody can press it."""
    if sys.stdin.isatty():
        with contextlib.suppress(EOFError, KeyboardInterrupt):
            input("press Enter to close the viewer ")
