"""Faults that a scenario asks for, in the whole diagram: what happens, and what is touched."""

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram

from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.robot.inertias import read_inertias
from drake_oa.runs.motion_log import MotionLog
from drake_oa.runs.report import motion_metrics
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.faults import ModelError
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.shipped import package_file
from drake_oa.studies.panda.faults import CASES, main, markdown_table, run_case, what_it_did

GROUND_TRUTH = "perception=!GroundTruth {}"
QUICK = "regulation=!Paper {}"  # Nothing is searched for.
ALL = (
    "[!CameraDropout {start: 0.2, duration: 0.3}, !NanFrames {}, !FrameBurst {}, "
    "!TableMissing {}, !GoalBlocked {}, !TorqueSaturation {}, !ModelError {}, !StartInContact {}]"
)


def run(fault: str, duration: float, *overrides: str) -> tuple[Scenario, MotionLog]:
    scenario = load_scenario("tabletop_box", [f"faults=[{fault}]", *overrides])
    return scenario, simulate(scenario, duration=duration)


def frame_period(scenario: Scenario) -> float:
    return 1.0 / scenario.cameras[0].fps


@pytest.fixture(scope="module")
def everything() -> Diagram:
    """A diagram with every fault."""
    return build_avoidance(load_scenario("tabletop_box", [f"faults={ALL}"]))


def test_the_systems_that_inject_faults_document_their_ports(everything: Diagram) -> None:
    file = Path(__file__).parents[1] / "test_port_lists.py"
    spec = importlib.util.spec_from_file_location("port_lists", file)
    assert spec is not None
    assert spec.loader is not None
    port_lists: Any = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(port_lists)
    for name in ("camera_faults", "weak_actuators", "mover_obstacle_fault4"):
        system = everything.GetSubsystemByName(name)
        listed = port_lists.documented_ports(type(system))
        assert listed["input_ports"] == [
            system.get_input_port(i).get_name() for i in range(system.num_input_ports())
        ]
        assert listed["output_ports"] == [
            system.get_output_port(i).get_name() for i in range(system.num_output_ports())
        ]


def test_only_the_controllers_model_is_wrong() -> None:
    diagram = build_avoidance(
        load_scenario("tabletop_box", [GROUND_TRUTH, "faults=[!ModelError {}]"])
    )
    plant: Any = diagram.GetSubsystemByName("plant")
    controller: Any = diagram.GetSubsystemByName("controller")
    mass = read_inertias(package_file(ModelError().inertias))["panda_link1"].mass
    assert controller._plant.GetBodyByName("panda_link1").default_mass() == mass
    assert plant.GetBodyByName("panda_link1").default_mass() > 1.5 * mass
    assert plant.num_positions(ModelInstanceIndex(2)) == controller._plant.num_positions()


def test_a_camera_that_stops_leaves_the_stamp_where_it_was() -> None:
    scenario, log = run("!CameraDropout {start: 0.2, duration: 0.3}", 0.6, QUICK)
    gap = np.diff(log.observation_stamp)
    assert (gap > 0.0).all()
    period = frame_period(scenario)
    (row,) = np.flatnonzero(gap > 1.5 * period)
    assert log.observation_stamp[row] < 0.2 <= log.observation_stamp[row] + period + 1e-9
    assert 0.5 - 1e-9 <= log.observation_stamp[row + 1] < 0.5 + period
    # What is seen again is what was seen before.
    np.testing.assert_array_equal(log.obstacle_id[row + 1], log.obstacle_id[row])


def test_one_of_two_cameras_that_stops_ages_what_is_seen() -> None:
    fault = "!CameraDropout {start: 0.2, duration: 0.2, camera: left}"
    scenario = load_scenario("two_cameras", [f"faults=[{fault}]", QUICK])
    diagram = build_avoidance(scenario)
    assert diagram.HasSubsystemNamed("camera_faults_left")
    assert not diagram.HasSubsystemNamed("camera_faults_right")
    simulator = Simulator(diagram)
    perception = diagram.GetSubsystemByName("perception")

    def seen(time: float) -> Any:
        simulator.AdvanceTo(time)
        context = perception.GetMyContextFromRoot(simulator.get_context())
        return perception.GetOutputPort("obstacles_W").Eval(context)

    before, during, after = seen(0.19), seen(0.35), seen(0.5)
    assert before.note == after.note == ""
    assert during.note == "left: no new image"
    assert during.stamp < 0.2
    assert after.stamp > 0.45
    # What only the left one saw is kept behind what the right one sees.
    assert len(before) == len(during) == len(after)
    for one, other in zip(before.clouds_W, during.clouds_W, strict=True):
        assert np.abs(np.ptp(one, axis=0) - np.ptp(other, axis=0)).max() < 0.02


def test_torques_are_cut_off_and_logged_as_applied() -> None:
    _, log = run(
        "!TorqueSaturation {start: 0.2, duration: 0.1, scale: 0.3}", 0.4, GROUND_TRUTH, QUICK
    )
    share = (np.abs(log.torque) / log.effort_limit).max(axis=1)
    weak = (log.t >= 0.2) & (log.t < 0.3 - 1e-9)
    assert share[weak].max() == pytest.approx(0.3)
    assert share[log.t < 0.2].min() > 0.35


def test_a_contact_at_the_start_is_not_one_that_the_motion_made() -> None:
    scenario, log = run("!StartInContact {}", 0.3, GROUND_TRUTH, QUICK)
    metrics = motion_metrics(scenario, log)
    assert metrics.initial_contacts == ("panda_hand - obstacle_fault0",)
    assert metrics.made_contacts == ()
    assert "tool inside obstacle" in log.event[-1]


def make_report(**changes: Any) -> dict[str, Any]:
    return {
        "fault": "!NanFrames {}",
        "supervision": [],
        "events": [],
        "stop_reason": "goal",
        "made_contacts": [],
        "tool_clearance_min": 0.2,
        "robot_clearance_min": None,
        "goal_error": 1e-4,
        "duration": 6.0,
    } | changes


def test_a_row_says_what_was_done_and_why_once() -> None:
    report = make_report(
        supervision=[
            {"time": 1.1, "action": "slow", "reason": "obstacles not seen since t = 0.93 s"},
            {"time": 1.4, "action": "hold", "reason": "obstacles not seen since t = 0.93 s"},
            {"time": 2.0, "action": "slow", "reason": "obstacles not seen since t = 0.93 s"},
            {"time": 3.0, "action": "run", "reason": ""},
        ],
        events=[
            {
                "time": 1.4,
                "hold": "supervisor",
                "note": "supervisor: obstacles not seen since t = 0.93 s",
            },
            {
                "time": 1.5,
                "hold": "obstacles",
                "note": "obstacles not seen since t = 0.93 s (no new image)",
            },
            {"time": 2.0, "hold": "none", "note": ""},
            {"time": 4.0, "hold": "obstacles", "note": "goal inside obstacle 1"},
        ],
    )
    assert what_it_did(report) == (
        "slow at 1.10 s: obstacles not seen since t = 0.93 s; "
        "hold at 1.40 s: obstacles not seen since t = 0.93 s; "
        "hold at 4.00 s: goal inside obstacle 1"
    )
    table = markdown_table({"frames of NaN": make_report(), "none": make_report(fault="")})
    assert table.splitlines()[2] == (
        "| frames of NaN: `!NanFrames {}` | went on | goal | 0 | 0.200 | - | 0.10 | 6.00 |"
    )


def test_the_command_names_its_faults(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--fault", "earthquake"])
    assert "camera stops" in capsys.readouterr().err


def test_the_command_answers_bad_input_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--scenario", "nowhere"]) == 2
    assert "error: unknown scenario 'nowhere'" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_each_fault_ends_as_it_should_without_a_contact(name: str) -> None:
    case = CASES[name]
    report = run_case(case)
    assert report["made_contacts"] == []
    assert report["ended"] in case.ends, report["stop_reason"]
    if case.ends == ("goal",):
        assert report["goal_error"] <= 1e-3
    if "StartInContact" not in case.fault:
        assert report["contacts"] == []
