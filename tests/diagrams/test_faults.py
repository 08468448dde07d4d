"""Faults: a motion that goes on, or is brought to rest and says why; bad input: a clear error.

Observations are switched by small source systems and frames by those of `fault_systems`;
everything behind them is real.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, LeafSystem, State

from drake_oa.common.files import package_file
from drake_oa.common.messages import (
    DECIDING,
    EllipsoidSet,
    FloatArray,
    ObstacleClouds,
    TablePlane,
)
from drake_oa.diagrams.avoidance import Layers, build_avoidance
from drake_oa.robot.inertias import read_inertias
from drake_oa.runs.motion_log import MotionEnd, MotionLog
from drake_oa.runs.report import motion_report
from drake_oa.runs.simulation import MotionInterruptedError, simulate
from drake_oa.scenario.faults import ModelError
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.scenario import Scenario
from tests.builders import balls
from tests.diagrams.fault_systems import Customize, missing_table, nan_frames

GROUND_TRUTH = "perception=!GroundTruth {}"
QUICK = "regulation=!Paper {}"  # Nothing is searched for.
FRAME = 1.0 / 15.0
AGE, HOLD = 0.5, 0.25
POLICY_STEP = 0.008

# Whole runs of `tabletop_box`, each with one fault.

UNSEEN = "obstacles not seen"
PLATE = (
    "obstacles=[{name: plate, shapes: [!Box {size: [0.05, 0.006, 0.03]}], stiffness: 1000, "
    "translation: [0.45, -0.4845, 0.37015]}]"
)
"""A thin soft plate that touches the hand, where it starts, from behind by 0.5 mm."""


def blocked_goal(start: float) -> str:
    """A ball that comes from beyond the goal, stays over it for 2 s and leaves again."""
    course = [(-0.4, 1.2), (0.0, 0.0), (2.0, 0.0), (2.4, 1.2)]
    waypoints = [[start + t, 0.0, y, 0.0] for t, y in course]
    return (
        "obstacles=[{name: ball, shapes: [!Sphere {radius: 0.06}], "
        f"translation: [0.45, 0.45, 0.3], waypoints: {waypoints}}}]"
    )


@dataclass(frozen=True)
class Case:
    """A fault by overrides or a system, and part of the log."""

    overrides: tuple[str, ...] = ()
    customize: Callable[[Scenario], Customize] | None = None
    told: str = ""


CASES = {
    "camera stops": Case(("faults=[!CameraDropout {start: 1, duration: 1}]",), told=UNSEEN),
    "frames of NaN": Case(customize=lambda _: nan_frames(1.0, 1.0), told=UNSEEN),
    "a frame without table": Case(customize=lambda s: missing_table(s.cameras[0], 1.0, 0.03)),
    "a second without table": Case(
        customize=lambda s: missing_table(s.cameras[0], 1.0, 1.0), told=UNSEEN
    ),
    "goal blocked": Case((blocked_goal(1.0),), told="at its goal the arm would touch"),
    "goal blocked, near it": Case((blocked_goal(3.5),), told="at its goal the arm would touch"),
    "start in contact": Case((PLATE,)),
    "start in contact, seen": Case((PLATE, GROUND_TRUTH), told="the arm touches obstacle"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_each_fault_ends_as_it_should_without_a_contact(
    name: str, caplog: pytest.LogCaptureFixture
) -> None:
    case = CASES[name]
    scenario = load_scenario("tabletop_box", list(case.overrides))
    if case.customize is not None:
        # Only of frames that come as they are taken is the time known at which they change.
        scenario.cameras[0].output_delay = 0.0
    customize = case.customize(scenario) if case.customize else None
    log = simulate(scenario, customize=customize)
    report = motion_report(scenario, log)
    assert report["made_contacts"] == []
    assert report["ended"] == MotionEnd.GOAL, report["stop_reason"]
    assert report["goal_error"] <= 1e-3
    if PLATE not in case.overrides:
        assert report["contacts"] == []
    assert case.told in "; ".join((*log.supervision_reason, *log.event, caplog.text))


@pytest.mark.slow
def test_an_arm_too_weak_to_carry_itself_gives_way_and_returns() -> None:
    fault = "faults=[!TorqueSaturation {start: 1, duration: 1, scale: 0.4}]"
    scenario = load_scenario("tabletop_box", [fault])
    log = simulate(scenario)
    report = motion_report(scenario, log)
    # The errors of its joints count as contact: the command follows the arm, which sinks.
    assert "brakes" in "; ".join(log.supervision_reason)
    assert {contact.partition(" - ")[2] for contact in report["contacts"]} <= {"table"}
    assert report["ended"] == MotionEnd.GOAL, report["stop_reason"]
    assert report["goal_error"] <= 1e-3


# Models and cameras that differ.


def test_only_the_controllers_model_is_wrong() -> None:
    diagram = build_avoidance(
        load_scenario("tabletop_box", [GROUND_TRUTH, "faults=[!ModelError {}]"])
    )
    plant = diagram.GetSubsystemByName("plant")
    controller = diagram.GetSubsystemByName("controller")
    mass = read_inertias(package_file(ModelError().inertias))["panda_link1"].mass
    assert controller._plant.GetBodyByName("panda_link1").default_mass() == mass
    assert plant.GetBodyByName("panda_link1").default_mass() > 1.5 * mass
    assert plant.num_positions(ModelInstanceIndex(2)) == controller._plant.num_positions()


def test_one_of_two_cameras_that_stops_ages_what_is_seen() -> None:
    fault = "faults=[!CameraDropout {start: 0.1, duration: 10, camera: left}]"
    diagram = build_avoidance(load_scenario("two_cameras", [fault, QUICK]))
    assert diagram.HasSubsystemNamed("camera_faults_left")
    assert not diagram.HasSubsystemNamed("camera_faults_right")
    simulator = Simulator(diagram)
    simulator.AdvanceTo(0.25)
    perception = diagram.GetSubsystemByName("perception")
    context = perception.GetMyContextFromRoot(simulator.get_context())
    seen = perception.GetOutputPort("obstacles_W").Eval(context)
    assert seen.note == "left: no new image"
    assert seen.stamp < 0.1


# Observations that a source system switches.


class Scripted(LeafSystem):
    """One abstract output `name` that is a function of time, as a source that looks every frame."""

    def __init__(self, name: str, script: Callable[[float], object], model: object) -> None:
        super().__init__()
        self._script = script
        self._seen = self.DeclareAbstractState(Value(model))
        self.DeclareStateOutputPort(name, self._seen)
        self.DeclareInitializationUnrestrictedUpdateEvent(self._look)
        self.DeclarePeriodicUnrestrictedUpdateEvent(FRAME, 0.0, self._look)

    def _look(self, context: Context, state: State) -> None:
        seen = self._script(context.get_time())
        state.get_mutable_abstract_state(self._seen).set_value(seen)


def seen_by(source: LeafSystem) -> Layers:
    """The layers, with a perception source of one's own."""
    return replace(Layers(), perception=lambda wires, *_: wires.add("perception", source))


@pytest.fixture
def free_motion() -> Callable[..., MotionLog]:
    """Runs `free_space` (from x = 0 to x = 1 m in 5 s) on scripted ellipsoids."""

    def run(script: Callable[[float], EllipsoidSet], *overrides: str, **options: object) -> object:
        source = Scripted("ellipsoids_W", script, EllipsoidSet())
        scenario = load_scenario("free_space", list(overrides))
        return simulate(scenario, layers=seen_by(source), **options)

    return run


@pytest.fixture
def robot_motion(recording_folder: Path) -> Callable[..., MotionLog]:
    """Runs `tabletop_box` on scripted clouds, wired as a recording is."""

    def run(script: Callable[[float], ObstacleClouds], **options: object) -> MotionLog:
        source = Scripted("obstacles_W", script, ObstacleClouds())
        folder = f"perception=!RecordedClouds {{folder: {recording_folder}}}"
        scenario = load_scenario("tabletop_box", [folder])
        return simulate(scenario, layers=seen_by(source), **options)

    return run


def assert_sound(log: MotionLog) -> None:
    """No number that is not finite, and no jump of the desired motion."""
    for name in ("q", "v", "torque", "desired_position", "desired_velocity"):
        assert np.isfinite(getattr(log, name)).all(), name
    step = np.linalg.norm(np.diff(log.desired_position, axis=0), axis=1)
    assert step.max(initial=0.0) < 0.02


def test_a_stale_observation_holds_the_motion_on_its_path_and_a_fresh_one_resumes_it(
    free_motion: Callable[..., MotionLog], caplog: pytest.LogCaptureFixture
) -> None:
    def stops_for_two_seconds(time: float) -> EllipsoidSet:
        stamp = 22 * FRAME if 1.5 < time < 3.5 else time
        return balls((0.5, 0.02, 0.0), radius=0.12, stamp=stamp)

    with caplog.at_level(logging.WARNING, "drake_oa"):
        log = free_motion(stops_for_two_seconds)
    assert_sound(log)
    held = (log.t > 1.5 + AGE + HOLD + 0.02) & (log.t < 3.5)
    assert not log.desired_velocity[held].any()
    assert np.ptp(log.desired_position[held], axis=0).max() == 0.0
    assert log.event == ("obstacles not seen since t = 1.47 s", "")
    assert "held: obstacles not seen since" in caplog.text
    assert "running again" in caplog.text
    assert log.stop_reason == "goal"
    np.testing.assert_allclose(log.desired_position[-1], [1.0, 0.0, 0.0], atol=1e-3)
    assert np.linalg.norm(log.desired_position - [0.5, 0.02, 0.0], axis=1).min() >= 0.12 + 0.148


@pytest.mark.parametrize(
    ("seen", "overrides", "why"),
    [
        (EllipsoidSet(note="no valid pixel"), [], "no observation yet (no valid pixel)"),
        (balls((0.05, 0.0, 0.0), radius=0.12), [], "tool inside obstacle 0"),
        (balls((0.95, 0.0, 0.0), radius=0.12), [], "goal inside obstacle 0"),
        # An obstacle so big that any way past it is far outside the table's height.
        (
            balls((0.5, 0.0, 0.0), radius=0.12, table=TablePlane(offset=5.0)),
            [QUICK],
            "every side of obstacle 0 is forbidden",
        ),
    ],
)
def test_where_no_motion_is_possible_the_start_is_held(
    seen: EllipsoidSet,
    overrides: list[str],
    why: str,
    free_motion: Callable[..., MotionLog],
    caplog: pytest.LogCaptureFixture,
) -> None:
    def script(time: float) -> EllipsoidSet:
        return replace(seen, stamp=time) if len(seen) else seen

    with caplog.at_level(logging.WARNING, "drake_oa"):
        log = free_motion(script, *overrides)
    assert log.stop_reason == f"held for 5 s: {why}"
    assert f"held: {why}" in caplog.text
    assert_sound(log)
    # The desired motion comes to rest at the policy's first step after.
    assert not log.desired_velocity[log.t >= HOLD + POLICY_STEP - 1e-9].any()
    assert np.linalg.norm(log.desired_position[-1]) < 0.01


# Clouds, with the whole robot.

BOX = np.stack(
    np.meshgrid(np.linspace(0.40, 0.50, 6), np.linspace(-0.05, 0.05, 6), np.linspace(0, 0.25, 6)),
    axis=-1,
).reshape(-1, 3)


def clouds(stamp: float, *points: FloatArray, note: str = "") -> ObstacleClouds:
    return ObstacleClouds(stamp, tuple(points), np.arange(len(points)), TablePlane(), note)


def test_clusters_without_volume_are_obstacles_too(robot_motion: Callable[..., MotionLog]) -> None:
    flat = BOX[BOX[:, 0] == BOX[0, 0]]
    shapes = (BOX[:1] + [0.0, 0.3, 0.0], flat, np.repeat(BOX[:1], 5, axis=0) + [0.2, 0.0, 0.0])
    log = robot_motion(lambda time: clouds(time, *shapes), duration=0.3)
    assert_sound(log)
    assert log.p_WO.shape[1] == 3
    assert (log.semi_axes > 0.0).all()
    assert log.event == (DECIDING, "")


def test_points_that_are_not_finite_never_reach_the_torques(
    robot_motion: Callable[..., MotionLog],
) -> None:
    spoilt = np.where(np.arange(len(BOX))[:, None] % 3 == 0, np.nan, BOX)
    nothing = np.full((10, 3), np.nan)

    def turns_bad(time: float) -> ObstacleClouds:
        points = (BOX,) if time < 0.2 else (spoilt, nothing)
        return clouds(time, *points)

    log = robot_motion(turns_bad, duration=0.6)
    assert_sound(log)
    assert np.isfinite(log.p_WO).all()


# The end before the end.


@pytest.mark.parametrize(
    ("cause", "name"),
    [
        (KeyboardInterrupt(), "interrupted"),
        (RuntimeError("out of memory"), "RuntimeError: out of memory"),
    ],
)
def test_an_interrupted_run_leaves_its_log(cause: BaseException, name: str) -> None:
    def interrupt(time: float, phase: float) -> None:
        if time > 0.5:
            raise cause

    with pytest.raises(MotionInterruptedError) as caught:
        simulate(load_scenario("tabletop_box", [GROUND_TRUTH]), on_progress=interrupt)
    log = caught.value.log
    assert log.stop_reason == name
    assert log.duration == pytest.approx(0.5, abs=0.02)
    assert len(log.q) == len(log.t) == len(log.torque) > 50
    assert len(log.observation_stamp) > 5
    report = motion_report(load_scenario("tabletop_box"), log)
    assert report["stop_reason"] == name
    assert report["collisions"] == 0
