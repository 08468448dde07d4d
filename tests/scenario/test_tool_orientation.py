"""How a scenario's tool is held: fields, demonstrations, and what is made of them."""

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
from drake_oa.scenario.end_poses import (
    end_rotations,
    held_robots,
    tool_orientation,
)
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.scenario import Scenario

DOWN = [np.pi, 0.0, np.pi / 2.0]
S = np.linspace(0.0, 1.0, 51)


def scenario(*overrides: str, name: str = "tabletop_box") -> Scenario:
    return load_scenario(name, ["perception=!GroundTruth {}", *overrides])


def matrix(rpy: list[float]) -> FloatArray:
    return np.array(RollPitchYaw(rpy).ToRotationMatrix().matrix())


def path() -> FloatArray:
    share = S**3 * (10.0 - 15.0 * S + 6.0 * S**2)
    return np.column_stack([0.1 * np.sin(np.pi * share), share, np.zeros(51)])


def rotations() -> FloatArray:
    """(51, 3, 3) that tilt by 0.5 rad and yaw by 0.3 rad, from tool down."""
    return np.array([matrix([np.pi - 0.5 * x, 0.0, 0.5 + 0.3 * x]) for x in path()[:, 1]])


def shown(folder: Path, **arrays: FloatArray) -> str:
    file = folder / "shown.npz"
    np.savez(file, **({"path": path()} | arrays))
    return f"task.demonstration={file}"


def test_the_orientation_stays_where_nothing_else_is_asked_for(tmp_path: Path) -> None:
    for plain in (scenario(), scenario(shown(tmp_path))):
        assert demonstrated_orientation(plain) is None
        assert tool_orientation(plain) is None
        assert held_robots(plain) == [plain.robot]
    assert held_robots(load_scenario("free_space")) == []


@pytest.mark.parametrize(
    ("override", "start", "goal"),
    [
        ("seed=0", DOWN, DOWN),
        ("task.rpy_start=[2.9, 0.1, 1.0]", [2.9, 0.1, 1.0], DOWN),
        ("task.rpy_goal=[2.9, 0.1, 1.0]", DOWN, [2.9, 0.1, 1.0]),
    ],
)
def test_start_and_goal_are_asked_for_each_by_itself(
    override: str, start: list[float], goal: list[float]
) -> None:
    for found, rpy in zip(end_rotations(scenario(override)), (start, goal), strict=True):
        np.testing.assert_allclose(found.matrix(), matrix(rpy), atol=1e-12)


@pytest.mark.parametrize("kind", ["quaternion", "R"])
def test_a_demonstration_tells_start_goal_and_way(kind: str, tmp_path: Path) -> None:
    R = rotations()
    signs = np.where(np.arange(51) % 3, 1.0, -1.0)[:, None]
    q = signs * [RotationMatrix(m).ToQuaternion().wxyz() for m in R]
    taught = scenario(shown(tmp_path, **{kind: q if kind == "quaternion" else R}))
    held = tool_orientation(taught)
    assert held is not None
    way = orientation_along(held.primitive, held.R_WS, held.R_WG, S)
    assert max(np.linalg.norm(goal_vector(a, b)) for a, b in zip(way, R, strict=True)) < 5e-3
    # And between other ends, what the scenario asks for.
    other = tool_orientation(scenario(shown(tmp_path, R=R), "task.rpy_goal=[3.0, 0.0, 0.5]"))
    assert other is not None
    np.testing.assert_allclose(other.R_WS, R[0], atol=1e-5)
    np.testing.assert_allclose(other.R_WG, matrix([3.0, 0.0, 0.5]), atol=1e-12)


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"path": np.zeros((51, 2))}, ["its path is (51, 2)", "`path` (T, 3)"]),
        ({"R": rotations()[:9]}, ["51 positions and 9 orientations", "`quaternion` (T, 4)"]),
        ({"R": rotations(), "quaternion": np.ones((51, 4))}, ["both `quaternion` and `R`"]),
        ({"R": np.zeros((51, 3, 3))}, ["sample 0 is no rotation matrix"]),
    ],
)
def test_a_bad_demonstration_is_named_with_what_is_wrong(
    arrays: dict[str, FloatArray], words: list[str], tmp_path: Path
) -> None:
    bad = scenario(shown(tmp_path, **arrays))

    def teach() -> None:
        make_dmp(bad)
        tool_orientation(bad)

    with pytest.raises(ScenarioError) as error:
        teach()
    for word in ("task.demonstration", "shown.npz", *words):
        assert word in str(error.value)


def test_what_does_not_go_together_is_refused() -> None:
    half = scenario("task.rpy_goal=[3.141592653589793, 0.0, -1.5707963267948966]")
    with pytest.raises(ScenarioError, match=r"task\.rpy_goal: .*half a turn apart"):
        tool_orientation(half)
    with pytest.raises(ScenarioError, match=r"task\.rpy_start: needs a robot"):
        tool_orientation(load_scenario("free_space", ["task.rpy_start=[0, 0, 0]"]))


def test_obstacles_are_dilated_by_the_tool_in_every_orientation_of_the_way() -> None:
    turning = scenario(name="tilted_goal")
    assert turning.robot is not None
    robots = held_robots(turning)
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
