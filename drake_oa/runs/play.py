"""Interactive run of a scenario (`drake-oa play`), in which a user changes clearance, goal and
obstacles while the arm moves.

After a change the diagram is built again, and a new motion starts from rest at the present
configuration. Between changes the diagram and its time steps are those of `drake-oa run`.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from pydrake.common.schema import Transform
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from drake_oa.common.config import ScenarioError
from drake_oa.common.messages import FloatArray
from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.geometry.shapes import pose
from drake_oa.inference.config import Paper, Verified
from drake_oa.perception.config import CameraSource, GroundTruth
from drake_oa.robot.plant import make_robot_plant
from drake_oa.runs.metrics import clearance_evaluator
from drake_oa.runs.motion_log import MotionEnd, MotionLog
from drake_oa.runs.page import LivePanel
from drake_oa.runs.simulation import GOAL_OUTCOME, MotionMonitor, MotionOutcome, collect_log
from drake_oa.scenario.end_poses import follow_joints
from drake_oa.scenario.obstacles import OBSTACLE_PREFIX
from drake_oa.scenario.scenario import Scenario, robot_of
from drake_oa.viewing.panel import LivePage
from drake_oa.world.station import release_cameras
from drake_oa.world.world_model import flat_directives

TICK = 1.0 / 30.0
"""Simulated time of one step of `PlaySession`, before which buttons and sliders are read [s]."""
SETTLING_TIME = 0.3
"""Time for which all sliders and buttons must stay unchanged before a change becomes active [s]."""
_MAX_LEGS = 20
"""Maximum number of motions of an interactive run whose logs are stored; older logs are deleted."""
_MAX_LATENESS = 0.1
"""Maximum delay behind the wall clock, at the selected speed, that an interactive run makes up for
by faster steps [s]. The part of a delay above this maximum remains."""
_METHODS = ("verified", "paper", "nominal")
"""Names of the methods that compute the motion, in the order in which a button of the viewer
selects them: "verified" by simulations of candidate motions, "paper" by the regressor chain of
Pairet et al., RA-L 2019, and "nominal", which avoids nothing."""
_NEXT = "next method (verified, paper, nominal)"
"""Name of the button in the viewer that selects the next method that computes the motion."""
_SOURCE = "camera or ground truth"
"""Name of the button in the viewer that switches the source of obstacles: camera or true shapes."""


def _welds(scenario: Scenario) -> dict[str, Any]:
    """Returns the model directives of a scenario that weld obstacles to the world, by obstacle
    name.
    """
    prefix = f"{OBSTACLE_PREFIX}_"
    welds = [item.add_weld for item in scenario.directives if item.add_weld is not None]
    return {
        weld.child.partition("::")[0].removeprefix(prefix): weld
        for weld in welds
        if weld.child.startswith(prefix) and weld.parent == "world"
    }


def obstacle_poses(scenario: Scenario) -> dict[str, RigidTransform]:
    """Returns the poses X_WO in the world of all obstacles that a user can move, by obstacle name.

    These are the obstacles of the block `obstacles`, and those that a directive welds to the world.
    """
    poses = {item.name: pose(item) for item in scenario.obstacles}
    for name, weld in _welds(scenario).items():
        poses[name] = weld.X_PC.GetDeterministicValue() if weld.X_PC else RigidTransform()
    return poses


def move_obstacle(scenario: Scenario, name: str, X_WO: RigidTransform) -> None:
    """Sets the pose of an obstacle in a scenario: in its block `obstacles`, or in its weld
    directive.

    Args:
        scenario: scenario to modify.
        name: name of the obstacle, a key of `obstacle_poses`.
        X_WO: new pose of the obstacle in the world.
    """
    welds = _welds(scenario)
    if name in welds:
        welds[name].X_PC = Transform(X_WO)
    for item in scenario.obstacles:
        if item.name == name:
            item.translation = X_WO.translation().tolist()
            item.rpy = RollPitchYaw(X_WO.rotation()).vector().tolist()


class PlaySession:
    """Interactive run of one scenario with controls in the viewer; `tick` advances it until
    `is_stopped` is True.

    The arm moves to the goal and back to the start, repeatedly. The page shows the sliders of an
    obstacle, such as "NAME: x [m]", in a folder NAME.

    Attributes:
        meshcat: viewer with the sliders and buttons.
        page: page with the viewer and the panel.
        logs: logs of the finished motions by the names "leg_1", "leg_2" and so on.
        is_stopped: whether the stop button was pressed.
        is_returning: whether the goal of the present motion is the start of the scenario.
    """

    def __init__(self, scenario: Scenario, meshcat: Meshcat, page: LivePage) -> None:
        """Adds the controls to the viewer, builds the diagram of a scenario, and starts the first
        motion.

        Args:
            scenario: scenario with a robot.
            meshcat: viewer.
            page: page with the viewer and the panel.

        Raises:
            ScenarioError: if the scenario has no robot, or a field is wrong.
        """
        self._limits = make_robot_plant(robot_of(scenario)).limits
        self._scenario = copy.deepcopy(scenario)
        self._scenario.directives = flat_directives(self._scenario.directives)
        self.meshcat, self.page = meshcat, page
        self._poses = obstacle_poses(self._scenario)
        self._sliders = self._add_controls()
        self._active_settings = self._tried_settings = self._settings_now = self._settings()
        self._rest_time = 0.0
        self._returned: MotionMonitor | None = None
        self._start = tuple(self._scenario.task.start)
        self.is_returning = self.is_stopped = False
        self._reset_count = 0
        self._refusal = ""
        self.logs: dict[str, MotionLog] = {}
        self._leg_count = 0
        self._simulator: Simulator | None = None
        self._begin(None)

    def _add_controls(self) -> list[str]:
        """Adds buttons and sliders to the viewer, and returns the names of all sliders except
        "speed".
        """
        for name, key in (
            ("pause", "Space"),
            ("reset", "KeyR"),
            (_NEXT, "KeyV"),
            (_SOURCE, "KeyC"),
            ("stop", "Escape"),
        ):
            self.meshcat.AddButton(name, key)
        self.meshcat.AddSlider("speed", 0.1, 1.0, 0.1, 1.0)
        task = self._scenario.task
        sliders = [("clearance [m]", 0.02, max(0.3, task.clearance), 0.005, task.clearance)]
        for axis, at in zip("xyz", task.goal, strict=True):
            sliders.append((f"goal {axis} [m]", at - 0.5, at + 0.5, 0.01, at))
        for name, X_WO in self._poses.items():
            (x, y, _), yaw = X_WO.translation(), RollPitchYaw(X_WO.rotation()).yaw_angle()
            sliders += [
                (f"{name}: x [m]", x - 0.4, x + 0.4, 0.01, x),
                (f"{name}: y [m]", y - 0.6, y + 0.6, 0.01, y),
                (f"{name}: yaw [rad]", -3.14, 3.14, 0.02, yaw),
            ]
        for slider in sliders:
            self.meshcat.AddSlider(*slider)
        return [name for name, *_ in sliders]

    def _clicks(self, name: str) -> int:
        """Returns the number of times that a button of the viewer was pressed.

        Args:
            name: name of the button.
        """
        return int(self.meshcat.GetButtonClicks(name))

    def _settings(self) -> dict[str, Any]:
        """Reads the controls of the viewer.

        Returns:
            Values of the sliders of clearance, goal and obstacles by name [m, rad]; under
            "inference" the selected method ("verified", "paper" or "nominal"), and under
            "has_camera" whether a camera is the source of the obstacles.
        """
        turn = self._clicks(_NEXT) + _is_paper(self._scenario)
        can_see = isinstance(self._scenario.perception, CameraSource)
        return {
            **{name: self.meshcat.GetSliderValue(name) for name in self._sliders},
            "inference": _METHODS[turn % len(_METHODS)],
            "has_camera": can_see and self._clicks(_SOURCE) % 2 == 0,
        }

    def tick(self) -> None:
        """Applies changed controls, advances the simulation by `TICK` unless paused, and updates
        the viewer's panel.
        """
        self.is_stopped = self._clicks("stop") > 0
        settings = self._settings()
        if settings != self._settings_now:
            self._settings_now, self._rest_time = settings, 0.0
        self._rest_time += TICK
        if self._clicks("reset") > self._reset_count:
            self._reset_count = self._clicks("reset")
            self.is_returning = False
            self._begin(None)
        elif self._settings_now != self._tried_settings and self._rest_time >= SETTLING_TIME:
            self._begin(self._positions())
        elif (
            self._monitor.settled
            and self._monitor.outcome == GOAL_OUTCOME
            and self._returned is not self._monitor
        ):
            # A refused return is not tried again.
            self._returned = self._monitor
            self.is_returning = not self.is_returning
            self._begin(self._positions())
            if self._monitor is self._returned:
                self.is_returning = not self.is_returning
        paused = self._clicks("pause") % 2 == 1
        if self._simulator and not self._monitor.settled and not paused:
            self._simulator.AdvanceTo(self._root().get_time() + TICK)
        self._panel(self._monitor, self._root(), self.status(paused))

    def run(self, each_tick: Callable[[], None] = lambda: None) -> None:
        """Advances the simulation at the selected speed until the stop button is pressed.

        Args:
            each_tick: function that is called before each step of `TICK`; its exceptions end the
                run.
        """
        due = time.monotonic()
        while not self.is_stopped:
            each_tick()
            self.tick()
            due += TICK / self.meshcat.GetSliderValue("speed")
            due = max(due, time.monotonic() - _MAX_LATENESS)
            time.sleep(max(0.0, due - time.monotonic()))

    def finish(self) -> dict[str, MotionLog]:
        """Ends the present motion, and returns the logs of up to 20 last motions by the names
        "leg_1", "leg_2" and so on.
        """
        self._end_leg("ended")
        return self.logs

    def _begin(self, q: FloatArray | None) -> None:
        """Builds the diagram with the present settings of the controls, and starts a new motion
        from rest.

        Invalid settings are refused: the sliders return to the previous values, and the present
        motion continues.

        Args:
            q: (nq,) configuration at which the motion starts [rad, m]; None: the start of the
                scenario.
        """
        settings = self._tried_settings = self._settings_now
        avoid_obstacles = settings["inference"] != "nominal"
        try:
            scenario = self._modified_scenario(settings, q)
            diagram = build_avoidance(
                scenario, avoid_obstacles=avoid_obstacles, meshcat=self.meshcat
            )
            evaluator = clearance_evaluator(scenario)
            simulator = Simulator(diagram)
            monitor = MotionMonitor(diagram, scenario, math.inf)
            contacts = evaluator.metrics(*monitor.positions(simulator.get_context())).contacts
            if self._simulator is not None and not self._contacts().issuperset(contacts):
                release_cameras(diagram)
                raise ScenarioError(f"obstacle inside the robot ({', '.join(contacts)})")
        except (ScenarioError, ValueError, RuntimeError) as error:
            self._refusal = str(error)
            if self._simulator is None:
                raise
            for name in self._sliders:
                self.meshcat.SetSliderValue(name, self._active_settings[name])
            self._tried_settings = self._settings_now = self._settings()
            return
        self._end_leg("restarted")
        self._refusal = ""
        self._active_settings, self._active_scenario = settings, scenario
        self._evaluator, self._simulator, self._monitor = evaluator, simulator, monitor
        self._panel = LivePanel(self.page, scenario, avoid_obstacles)
        simulator.Initialize()
        simulator.set_monitor(monitor)

    def _contacts(self) -> frozenset[str]:
        """Returns the names "link - object" of the pairs in contact at the present configuration of
        the robot.
        """
        return frozenset(self._evaluator.metrics(*self._monitor.positions(self._root())).contacts)

    def _modified_scenario(self, settings: dict[str, Any], q: FloatArray | None) -> Scenario:
        """Returns a copy of the scenario that is modified by the settings of the controls.

        Args:
            settings: values of the controls by name: of the sliders [m, rad], "inference" (selected
                method) and "has_camera" (whether a camera is the source of the obstacles).
            q: (nq,) configuration at which the motion starts [rad, m]; None: the start of the
                scenario.
        """
        scenario = copy.deepcopy(self._scenario)
        task = scenario.task
        task.clearance = settings["clearance [m]"]
        task.goal = [settings[f"goal {axis} [m]"] for axis in "xyz"]
        if not np.allclose(task.goal, self._scenario.task.goal, atol=0.01):
            task.q_goal = None
        if self.is_returning:
            task.goal, task.rpy_goal = list(self._start), task.rpy_start
        if q is not None:
            task.q_start, task.q_goal = q[: len(robot_of(scenario).q_seed)].tolist(), None
            task.goal_moves, task.demonstration = [], []
            follow_joints(scenario)
        is_paper = settings["inference"] == "paper"
        if is_paper != _is_paper(scenario):
            scenario.inference = Paper() if is_paper else Verified()
        if not settings["has_camera"] and isinstance(scenario.perception, CameraSource):
            scenario.perception, scenario.faults = GroundTruth(), []
        for name, X_WO in self._poses.items():
            x, y, yaw = (settings[f"{name}: {of}"] for of in ("x [m]", "y [m]", "yaw [rad]"))
            roll, pitch, _ = RollPitchYaw(X_WO.rotation()).vector()
            p_WO = [x, y, X_WO.translation()[2]]
            X_WO = RigidTransform(RollPitchYaw(roll, pitch, yaw), p_WO)
            move_obstacle(scenario, name, X_WO)
        return scenario

    def tool_point(self) -> FloatArray:
        """Returns the present position (3,) of the tool point in the world [m]."""
        return self._monitor.tool_point(self._root())

    def _positions(self) -> FloatArray:
        """Returns the present configuration (nq,) of the robot, clipped to values inside the joint
        limits [rad, m].
        """
        q = self._monitor.positions(self._root())[0][0]
        lower, upper = self._limits.position_lower, self._limits.position_upper
        return np.clip(q, lower + 1e-6, upper - 1e-6)

    def _root(self) -> Context:
        """Returns the root Context of the present diagram."""
        if self._simulator is None:
            raise RuntimeError("no motion has been started")
        return self._simulator.get_context()

    def status(self, paused: bool = False) -> str:
        """Returns the last line of the viewer's panel: refusal of a change, "paused", or state of
        the motion.
        """
        if self._refusal:
            return f"refused: {self._refusal}"
        return "paused" if paused else self._monitor.state

    def _end_leg(self, reason: str) -> None:
        """Ends the present motion (leg), if any, and adds its log to `logs`.

        Args:
            reason: reason that the log states if the motion is interrupted before its termination.
        """
        if self._simulator is None:
            return
        self._simulator.clear_monitor()
        self._leg_count += 1
        avoid_obstacles = self._active_settings["inference"] != "nominal"
        if self._monitor.outcome:
            self._monitor.finish(self._root())
        else:
            self._monitor.outcome = MotionOutcome(MotionEnd.INTERRUPTED, reason)
        log = collect_log(
            self._active_scenario, self._simulator, self._monitor, avoid_obstacles, math.nan
        )
        self.logs[f"leg_{self._leg_count}"] = log
        for name in list(self.logs)[:-_MAX_LEGS]:
            del self.logs[name]
        release_cameras(self._simulator.get_system())
        self._simulator = None


def _is_paper(scenario: Scenario) -> bool:
    """Checks whether a scenario uses the method of Pairet et al., RA-L 2019, without verification
    by roll-outs.
    """
    return isinstance(scenario.inference, Paper)
