"""Tests of faults among moving obstacles: claim (A) holds, and no link moves into an obstacle."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import yaml

from drake_oa.evaluation.panda.claims import run_violations
from drake_oa.evaluation.panda.true_world import make_true_world
from drake_oa.geometry.shapes import Box, Sphere
from drake_oa.robot.plant import make_robot_plant
from drake_oa.runs.metrics import clearance_evaluator
from drake_oa.runs.motion_log import MotionEnd, MotionLog
from drake_oa.runs.report import motion_report
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.obstacles import Obstacle
from drake_oa.scenario.scenario import Scenario
from tests.diagrams.fault_systems import (
    Customize,
    delayed_observations,
    nan_clouds,
    nan_geometries,
    raised_table,
)
from tests.diagrams.test_faults import PLATE

GROUND_TRUTH = "perception=!GroundTruth {}"
AT_REST = 0.05
"""Maximum joint speed of an arm at rest [rad/s]."""
APPROACH = 0.02
"""Maximum speed of a link toward an obstacle at a contact [m/s]."""
LATENCY = 0.033
"""Bound of the simulated latency of 99 % of the motion guard's decisions [s]."""
SAFE = (MotionEnd.STOPPED, MotionEnd.HELD)
"""Ends of a motion that a fault prevents from reaching the goal."""


@dataclass(frozen=True)
class Case:
    """Fault by overrides or an inserted system, accepted ends, and expected part of the log."""

    overrides: tuple[str, ...] = (GROUND_TRUTH,)
    customize: Customize | None = None
    ends: tuple[MotionEnd, ...] = (MotionEnd.GOAL,)
    logs: str = "evades obstacle"


def dropouts(*starts: float, duration: float) -> str:
    """Returns an override with camera dropouts at start times [s]."""
    faults = ", ".join(f"!CameraDropout {{start: {t}, duration: {duration}}}" for t in starts)
    return f"faults=[{faults}]"


UNSEEN = "obstacles not seen"
CASES = {
    "dropped frames": Case(
        (dropouts(*np.arange(0.4, 8.0, 0.4).round(1), duration=0.2),), logs="no new image"
    ),
    "a camera stops for good": Case((dropouts(1.0, duration=1000.0),), None, SAFE, UNSEEN),
    "delayed observations": Case(customize=delayed_observations(0.2), logs=UNSEEN),
    "a raised table": Case(customize=raised_table(1.5, 0.3), ends=SAFE, logs="contact with table"),
    "collision scene with NaN": Case(
        customize=nan_geometries(1.0, 2.0), logs="the collision scene is not finite"
    ),
    "obstacle data with NaN": Case((), nan_clouds(1.0, 2.0), logs="obstacles_W is not finite"),
}


def approach_at_contacts(scenario: Scenario, log: MotionLog) -> list[float]:
    """Computes the robot's speeds toward obstacles at the beginning of contacts [m/s].

    A speed is the decrease of the minimum distance in the logged interval before the contact, due
    to the robot's motion alone: with the obstacles at their previous positions.
    """
    evaluator = clearance_evaluator(scenario)
    distance = evaluator.metrics(log.q, log.q_world).robot_clearance
    rows = np.flatnonzero((distance[1:] <= 0.0) & (distance[:-1] > 0.0))
    moved = evaluator.metrics(log.q[rows + 1], log.q_world[rows]).robot_clearance
    return ((distance[rows] - moved) / (log.t[rows + 1] - log.t[rows])).tolist()


def assert_safe(
    case: Case, caplog: pytest.LogCaptureFixture, obstacles: tuple[Obstacle, ...] = ()
) -> dict:
    """Simulates `moving_obstacle` with a fault and more obstacles, checks the motion, and returns
    its report.
    """
    scenario = load_scenario("moving_obstacle", list(case.overrides))
    scenario.obstacles += obstacles
    log = simulate(scenario, customize=case.customize)
    report = motion_report(scenario, log)
    for key in ("q", "v", "torque", "desired_position", "desired_velocity"):
        assert np.isfinite(getattr(log, key)).all(), key
    assert max(approach_at_contacts(scenario, log), default=0.0) <= APPROACH
    violations = run_violations(scenario, log, make_true_world(scenario))
    assert not violations["A"].any()
    assert case.logs in "; ".join((*log.supervision_reason, *log.event, caplog.text))
    assert report["ended"] in case.ends, report["stop_reason"]
    if report["ended"] == MotionEnd.GOAL:
        assert report["goal_error"] <= 1e-3
    assert np.abs(log.v[-1]).max() <= AT_REST
    return report


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_no_link_moves_into_a_moving_obstacle(name: str, caplog: pytest.LogCaptureFixture) -> None:
    assert_safe(CASES[name], caplog)


@pytest.mark.slow
def test_an_obstacle_touches_the_hand_at_the_start(caplog: pytest.LogCaptureFixture) -> None:
    plate = load_scenario("tabletop_box", [PLATE]).obstacles
    # The guard evades the plate, so that the motion does not reach the goal.
    report = assert_safe(Case(ends=SAFE), caplog, tuple(plate))
    assert report["initial_contacts"]
    assert report["new_contacts"] == []


@pytest.mark.slow
def test_decisions_among_thirty_moving_obstacles_are_in_time(
    caplog: pytest.LogCaptureFixture,
) -> None:
    rng, obstacles = np.random.default_rng(0), []
    for row in range(28):
        size, waypoints = rng.uniform(0.05, 0.15, 3).tolist(), np.zeros((5, 4))
        waypoints[:, 0] = np.linspace(0.0, 10.0, 5)
        waypoints[:, 1:] = rng.uniform(-1.0, 1.0, (5, 3)) * [0.09, 0.3, 0.09]
        obstacles.append(
            Obstacle(
                name=f"crowd{row}",
                shapes=[Box(size=size) if row % 2 else Sphere(radius=0.5 * size[0])],
                translation=rng.uniform([0.7, -0.8, 0.15], [1.1, 0.8, 0.9]).tolist(),
                waypoints=waypoints.tolist(),
            )
        )
    report = assert_safe(Case(ends=(MotionEnd.GOAL, *SAFE)), caplog, tuple(obstacles))
    assert report["new_contacts"] == []
    assert report["guard_latency"]["p99"] <= LATENCY


@pytest.mark.slow
def test_inertial_parameters_of_the_controller_are_thirty_percent_too_large(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    plant = make_robot_plant(load_scenario("moving_obstacle").robot).plant
    context, links, file = plant.CreateDefaultContext(), {}, tmp_path / "inertias.yaml"
    for name in (f"panda_link{row}" for row in range(8)):
        M = plant.GetBodyByName(name).CalcSpatialInertiaInBodyFrame(context)
        about_com = M.Shift(M.get_com()).CalcRotationalInertia()
        inertia = 1.3 * np.concatenate([about_com.get_moments(), about_com.get_products()])
        mass, com = 1.3 * M.get_mass(), M.get_com().tolist()
        links[name] = {"mass": mass, "com": com, "inertia": inertia.tolist()}
    file.write_text(yaml.safe_dump(links))
    assert_safe(Case((GROUND_TRUTH, f"faults=[!ModelError {{inertias: {file}}}]")), caplog)
