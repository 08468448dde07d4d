"""Tool orientation of a scenario: from fields and demonstrations, and along the motion."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RollPitchYaw, RotationMatrix

from drake_oa.common.config import ScenarioError
from drake_oa.common.messages import FloatArray
from drake_oa.diagrams.motion import make_dmp
from drake_oa.diagrams.perception import make_ellipsoid_descriptor
from drake_oa.policy.dmp import goal_vector, orientation_along
from drake_oa.robot.plant import tool_link_corners
from drake_oa.scenario.demonstration import demonstrated_orientation
from drake_oa.scenario.end_poses import end_rotations, robots_along_motion, tool_orientation
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.scenario import Scenario

DOWN = [np.pi, 0.0, np.pi / 2.0]
S = np.linspace(0.0, 1.0, 51)


def scenario(*overrides: str, name: str = "tabletop_box") -> Scenario:
    """Loads a shipped scenario with ground-truth perception."""
    return load_scenario(name, ["perception=!GroundTruth {}", *overrides])


def matrix(rpy: list[float]) -> FloatArray:
    """Returns the rotation matrix (3, 3) of roll, pitch and yaw [rad]."""
    return np.array(RollPitchYaw(rpy).ToRotationMatrix().matrix())


def path() -> FloatArray:
    """Returns positions (51, 3) of a minimum-jerk arc of 1 m along y [m]."""
    share = S**3 * (10.0 - 15.0 * S + 6.0 * S**2)
    return np.column_stack([0.1 * np.sin(np.pi * share), share, np.zeros(51)])


def rotations() -> FloatArray:
    """Returns orientations (51, 3, 3) that tilt by 0.5 rad and yaw by 0.3 rad, from tool down."""
    return np.array([matrix([np.pi - 0.5 * x, 0.0, 0.5 + 0.3 * x]) for x in path()[:, 1]])


def write_demonstration(folder: Path, **arrays: FloatArray) -> str:
    """Writes a demonstration of `path` and the given arrays; returns the override that uses it."""
    file = folder / "demo.npz"
    np.savez(file, **({"path": path()} | arrays))
    return f"task.demonstration={file}"


def test_orientation_is_constant_by_default(tmp_path: Path) -> None:
    for plain in (scenario(), scenario(write_demonstration(tmp_path))):
        assert demonstrated_orientation(plain) is None
        assert tool_orientation(plain) is None
        assert robots_along_motion(plain) == [plain.robot]
    assert robots_along_motion(load_scenario("free_space")) == []


@pytest.mark.parametrize(
    ("override", "start", "goal"),
    [
        ("seed=0", DOWN, DOWN),
        ("task.rpy_start=[2.9, 0.1, 1.0]", [2.9, 0.1, 1.0], DOWN),
        ("task.rpy_goal=[2.9, 0.1, 1.0]", DOWN, [2.9, 0.1, 1.0]),
    ],
)
def test_orientations_at_start_and_goal_are_set_separately(
    override: str, start: list[float], goal: list[float]
) -> None:
    for found, rpy in zip(end_rotations(scenario(override)), (start, goal), strict=True):
        np.testing.assert_allclose(found.matrix(), matrix(rpy), atol=1e-12)


@pytest.mark.parametrize("kind", ["quaternion", "R"])
def test_demonstration_gives_orientations_at_start_goal_and_in_between(
    kind: str, tmp_path: Path
) -> None:
    R = rotations()
    signs = np.where(np.arange(51) % 3, 1.0, -1.0)[:, None]
    q = signs * [RotationMatrix(m).ToQuaternion().wxyz() for m in R]
    demonstrated = scenario(
        write_demonstration(tmp_path, **{kind: q if kind == "quaternion" else R})
    )
    orientation = tool_orientation(demonstrated)
    way = orientation_along(orientation.primitive, orientation.R_WS, orientation.R_WG, S)
    assert max(np.linalg.norm(goal_vector(a, b)) for a, b in zip(way, R, strict=True)) < 5e-3
    # Fields of the scenario replace the demonstrated orientations at the ends.
    other = tool_orientation(
        scenario(write_demonstration(tmp_path, R=R), "task.rpy_goal=[3.0, 0.0, 0.5]")
    )
    np.testing.assert_allclose(other.R_WS, R[0], atol=1e-5)
    np.testing.assert_allclose(other.R_WG, matrix([3.0, 0.0, 0.5]), atol=1e-12)


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"path": np.zeros((51, 2))}, ["its path has shape (51, 2)", "`path` (T, 3)"]),
        ({"R": rotations()[:9]}, ["51 positions and 9 orientations", "`quaternion` (T, 4)"]),
        ({"R": rotations(), "quaternion": np.ones((51, 4))}, ["both `quaternion` and `R`"]),
        ({"R": np.zeros((51, 3, 3))}, ["sample 0 is no rotation matrix"]),
    ],
)
def test_error_of_an_invalid_demonstration_names_file_and_problem(
    arrays: dict[str, FloatArray], words: list[str], tmp_path: Path
) -> None:
    bad = scenario(write_demonstration(tmp_path, **arrays))

    def teach() -> None:
        """Fits the primitives of position and orientation."""
        make_dmp(bad)
        tool_orientation(bad)

    with pytest.raises(ScenarioError) as error:
        teach()
    for word in ("task.demonstration", "demo.npz", *words):
        assert word in str(error.value)


def test_inconsistent_orientations_are_rejected() -> None:
    half = scenario("task.rpy_goal=[3.141592653589793, 0.0, -1.5707963267948966]")
    with pytest.raises(ScenarioError, match=r"task\.rpy_goal: .*differ by 180 degrees"):
        tool_orientation(half)
    with pytest.raises(ScenarioError, match=r"task\.rpy_start: requires a robot"):
        tool_orientation(load_scenario("free_space", ["task.rpy_start=[0, 0, 0]"]))


def test_obstacles_are_dilated_by_the_tool_in_each_orientation_of_the_motion() -> None:
    turning = scenario(name="tilted_goal")
    robots = robots_along_motion(turning)
    assert len(robots) >= 5
    ends = [matrix(robot.rpy_WE) for robot in (robots[0], robots[-1])]
    np.testing.assert_allclose(ends, [e.matrix() for e in end_rotations(turning)], atol=1e-4)
    steps = [
        np.linalg.norm(goal_vector(matrix(a.rpy_WE), matrix(b.rpy_WE))) for a, b in pairwise(robots)
    ]
    assert max(steps) < np.radians(12.0)
    descriptor = make_ellipsoid_descriptor(turning)
    one = np.concatenate(tool_link_corners(turning.robot))
    assert len(descriptor._describe.keywords["tool_W"]) == len(robots) * len(one)
