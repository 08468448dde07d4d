"""Faults among moving obstacles: no link moves into one, and the arm arrives or rests."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import yaml

from drake_oa.geometry.shapes import Box, Sphere
from drake_oa.robot.plant import make_robot_plant
from drake_oa.runs.metrics import robot_judge
from drake_oa.runs.motion_log import MotionEnd, MotionLog
from drake_oa.runs.report import motion_report
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.faults import ModelError
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.obstacles import Obstacle
from drake_oa.scenario.scenario import Scenario
from tests.diagrams.fault_systems import (
    Customize,
    late_observations,
    nan_clouds,
    nan_solids,
    raised_table,
)

GROUND_TRUTH = "perception=!GroundTruth {}"
AT_REST, APPROACH = 0.05, 0.02
"""Joint speed of an arm at rest [rad/s], and speed at which a link moves into an obstacle [m/s]."""
LATENCY = 0.033
"""Simulated decision latency of the guard that 99 % of the decisions keep [s]."""
SAFE = (MotionEnd.STOPPED, MotionEnd.HELD)


@dataclass(frozen=True)
class Case:
    """A fault by overrides or a system, how its motion may end, and part of the log."""

    overrides: tuple[str, ...] = (GROUND_TRUTH,)
    customize: Customize | None = None
    ends: tuple[MotionEnd, ...] = (MotionEnd.GOAL,)
    told: str = "evades obstacle"


def dropouts(*starts: float, duration: float) -> str:
    faults = ", ".join(f"!CameraDropout {{start: {t}, duration: {duration}}}" for t in starts)
    return f"faults=[{faults}]"


UNSEEN = "obstacles not seen"
CASES = {
    "dropped frames": Case(
        (dropouts(*np.arange(0.4, 8.0, 0.4).round(1), duration=0.2),), told="no new image"
    ),
    "a camera that dies": Case((dropouts(1.0, duration=1000.0),), None, SAFE, UNSEEN),
    "late images": Case(customize=late_observations(0.2), told=UNSEEN),
    "a step in the table's height": Case(
        customize=raised_table(1.5, 0.3), ends=SAFE, told="brakes for an obstacle"
    ),
    "obstacle data with NaN": Case((), nan_clouds(1.0, 1.0), told="obstacles_W holds what is not"),
}


def approach_at_contacts(scenario: Scenario, log: MotionLog) -> list[float]:
    """Returns the speeds [m/s] at which the robot moves towards what comes to touch it.

    They are the decrease of the least distance by the robot's own motion, the obstacles being
    where they were, in the log's interval before each contact.
    """
    judge = robot_judge(scenario)
    distance = judge.metrics(log.q, log.q_world).robot_clearance
    rows = np.flatnonzero((distance[1:] <= 0.0) & (distance[:-1] > 0.0))
    moved = judge.metrics(log.q[rows + 1], log.q_world[rows]).robot_clearance
    return ((distance[rows] - moved) / (log.t[rows + 1] - log.t[rows])).tolist()


def assert_safe(
    scenario: Scenario, log: MotionLog, case: Case, warnings: str = ""
) -> dict[str, object]:
    """The claims of all cases; returns the report."""
    report = motion_report(scenario, log)
    for name in ("q", "v", "torque", "desired_position", "desired_velocity"):
        assert np.isfinite(getattr(log, name)).all(), name
    assert max(approach_at_contacts(scenario, log), default=0.0) <= APPROACH
    assert case.told in "; ".join((*log.supervision_reason, *log.event, warnings))
    assert report["ended"] in case.ends, report["stop_reason"]
    if report["ended"] == MotionEnd.GOAL:
        assert report["goal_error"] <= 1e-3
    assert np.abs(log.v[-1]).max() <= AT_REST
    return report


def run(case: Case, obstacles: tuple[Obstacle, ...] = ()) -> tuple[Scenario, MotionLog]:
    """Simulates `moving_obstacle` with a fault and more obstacles."""
    scenario = load_scenario("moving_obstacle", list(case.overrides))
    scenario.obstacles += obstacles
    return scenario, simulate(scenario, customize=case.customize)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_no_link_moves_into_a_moving_obstacle(name: str, caplog: pytest.LogCaptureFixture) -> None:
    scenario, log = run(CASES[name])
    assert_safe(scenario, log, CASES[name], caplog.text)


@pytest.mark.slow
def test_solids_whose_poses_are_nan_are_no_free_space() -> None:
    case = Case(customize=nan_solids(1.0, 1.0), told="the solids are not finite")
    scenario, log = run(case)
    assert_safe(scenario, log, case)


@pytest.mark.slow
def test_an_obstacle_in_contact_at_the_start() -> None:
    plate = Obstacle(
        name="plate",
        shapes=[Box(size=[0.05, 0.006, 0.03])],
        stiffness=1000.0,
        translation=[0.45, -0.4845, 0.37015],
    )
    case = Case()
    scenario, log = run(case, (plate,))
    report = assert_safe(scenario, log, case)
    assert report["initial_contacts"]
    assert report["made_contacts"] == []


@pytest.mark.slow
def test_thirty_moving_obstacles_are_decided_on_in_time() -> None:
    rng = np.random.default_rng(0)
    crowd = []
    for row in range(28):
        p = rng.uniform([0.7, -0.8, 0.15], [1.1, 0.8, 0.9])
        way = rng.uniform(-0.3, 0.3, (5, 3))
        waypoints = np.column_stack([np.linspace(0.0, 10.0, 5), way * [0.3, 1.0, 0.3]])
        size = rng.uniform(0.05, 0.15, 3).round(3).tolist()
        shape = Box(size=size) if row % 2 else Sphere(radius=0.5 * size[0])
        crowd.append(
            Obstacle(
                name=f"{row}", shapes=[shape], translation=p.tolist(), waypoints=waypoints.tolist()
            )
        )
    case = Case(ends=(MotionEnd.GOAL, *SAFE))
    scenario, log = run(case, tuple(crowd))
    report = assert_safe(scenario, log, case)
    assert report["made_contacts"] == []
    assert report["guard_cost"]["p99"] <= LATENCY


@pytest.mark.slow
def test_a_model_error_of_30_percent(tmp_path: Path) -> None:
    scenario = load_scenario("moving_obstacle")
    plant = make_robot_plant(scenario.robot).plant
    context, inertias = plant.CreateDefaultContext(), {}
    for row in range(8):
        body = plant.GetBodyByName(f"panda_link{row}")
        M = body.CalcSpatialInertiaInBodyFrame(context)
        about = M.Shift(M.get_com()).CalcRotationalInertia()
        inertia = [*about.get_moments(), *about.get_products()]
        inertias[body.name()] = {
            "mass": 1.3 * M.get_mass(),
            "com": M.get_com().tolist(),
            "inertia": [1.3 * float(value) for value in inertia],
        }
    file = tmp_path / "inertias.yaml"
    file.write_text(yaml.safe_dump(inertias))
    case = Case((GROUND_TRUTH, f"faults=[!ModelError {{inertias: {file}}}]"))
    scenario, log = run(case)
    assert scenario.faults == [ModelError(inertias=str(file))]
    assert_safe(scenario, log, case)
