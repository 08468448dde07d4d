"""Fixtures shared by all tests."""

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

from drake_oa.robot.config import Robot
from drake_oa.robot.plant import RobotLimits, RobotPlant, make_robot_plant
from drake_oa.runs.motion_log import MotionLog
from drake_oa.scenario.loading import load_scenario, scenario_text
from tests.builders import cubes_on_table

# Torch for CUDA imports triton at its first differentiation. Triton and Mesa both contain LLVM, and
# together crash a process that renders. No test requires triton, so its import is made to fail.
sys.modules["triton"] = None  # type: ignore[assignment]

# On a busy computer the time of an example is no error, so there is no deadline.
settings.register_profile("drake_oa", deadline=None, derandomize=True)
settings.load_profile("drake_oa")

_SHARED = Path(__file__).resolve().parents[2] / "shared"
"""Folder of reference data and depth scans beside the checkout."""


@pytest.fixture(scope="session")
def reference() -> Callable[[str], Path]:
    """Function that returns the path of a reference file by name, or skips the test without it."""

    def find(name: str) -> Path:
        path = _SHARED / "reference" / name
        if not path.is_file():
            pytest.skip(f"reference file {path} does not exist")
        return path

    return find


@pytest.fixture(scope="session")
def scan_files() -> list[Path]:
    """Files of the real depth scans; skips the test without them."""
    files = sorted((_SHARED / "scans").glob("*.npz"))
    if not files:
        pytest.skip(f"folder {_SHARED / 'scans'} has no depth scans")
    return files


@pytest.fixture(scope="session")
def panda() -> RobotPlant:
    """Plant of the Panda without a world, shared by all tests: it must not be modified."""
    return make_robot_plant(Robot())


@pytest.fixture(scope="session")
def recording_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with one recorded cloud of a box on a table, in the world frame."""
    folder = tmp_path_factory.mktemp("recording")
    points = cubes_on_table((0.0, 0.0)) + [0.45, 0.0, 0.0]
    np.savez(folder / "cloud_0.000.npz", points=points, X_WC=np.eye(4), stamp=0.0)
    return folder


@pytest.fixture(scope="session")
def straight_log() -> Callable[..., MotionLog]:
    """Function that creates the log of a straight motion without a robot, with steps of 0.1 s.

    Its arguments are the number of instants, and attributes of the log to replace.
    """
    scenario = scenario_text(load_scenario("free_space"))

    def make(count: int = 51, **changes: object) -> MotionLog:
        path = np.linspace([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], count)
        none = np.zeros((count, 0))
        log = MotionLog(
            t=0.1 * np.arange(count),
            q=none,
            v=none,
            torque=none,
            saturated=np.zeros(count),
            p_WE=path,
            desired_position=path,
            desired_velocity=np.tile([0.2, 0.0, 0.0], (count, 1)),
            desired_acceleration=np.zeros((count, 3)),
            phase=np.linspace(1.0, 0.01, count),
            speed_scale=np.ones(count),
            tracking_error=np.full(count, np.nan),
            q_world=none,
            goal=np.tile([1.0, 0.0, 0.0], (count, 1)),
            inference="Verified",
            shortfall=np.zeros(count),
            **vars(RobotLimits()),
            stop_reason="goal",
            ended="goal",
            wall_time=1.0,
            avoid_obstacles=True,
            scenario=scenario,
            seed=0,
            versions=("drake_oa 0.1.0",),
        )
        return replace(log, **changes)

    return make
