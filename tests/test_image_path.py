"""Modules between depth image and torque, compared with the list in docs/architecture.md."""

import re
import sys
from pathlib import Path
from types import FrameType

from pydrake.systems.analysis import Simulator

from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.scenario.loading import load_scenario

PAGE = Path(__file__).parents[1] / "docs/architecture.md"
MAX_COUNT = 40
"""Maximum number of modules between depth image and torque."""
BEFORE_PERCEPTION = {"drake_oa.world.cameras", "drake_oa.world.delayed_camera"}
"""Modules that create the depth image."""


def test_documented_modules_run_between_image_and_torque() -> None:
    simulator = Simulator(build_avoidance(load_scenario("tabletop_box")))
    simulator.Initialize()
    run: set[str] = set()

    def record(frame: FrameType, event: str, argument: object) -> None:
        name = frame.f_globals.get("__name__", "")
        if event == "call" and name.startswith("drake_oa."):
            run.add(name)

    sys.setprofile(record)
    try:
        simulator.AdvanceTo(0.2)
    finally:
        sys.setprofile(None)
    run -= BEFORE_PERCEPTION
    section = PAGE.read_text().partition("## The path of a depth image")[2]
    listed = {f"drake_oa.{name}" for name in re.findall(r"`(\w+\.\w+)`", section)}
    assert run == listed
    assert len(run) <= MAX_COUNT
