"""Interactive run of a scenario: clearance, goal and obstacles change while the arm moves.

A change takes effect after a moment, in a diagram that is built again: the motion starts from
rest where the arm is. Between changes it is the diagram that `drake-oa run` runs, in the same
steps.
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
from drake_oa.runs.simulation import AT_THE_GOAL, MotionMonitor, MotionOutcome, collect_log
from drake_oa.scenario.end_poses import follow_joints
from drake_oa.scenario.obstacles import OBSTACLE_PREFIX
from drake_oa.scenario.scenario import Scenario, robot_of
from drake_oa.viewing.panel import LivePage
from drake_oa.world.station import release_cameras
from drake_oa.world.world_model import flat_directives

TICK = 1.0 / 30.0
"""Simulated time between two looks at the controls [s]."""
SETTLED = 0.3
"""Time for which the controls must rest before a change takes effect [s]."""
_MAX_LEGS = 20
"""Maximum number of motions in the log: the newest ones."""
_LATEST = 0.1
"""Lateness of a picture above which it is not caught up with [s]."""
_REGULATIONS = ("verified", "paper", "nominal")
_NEXT = "next method (verified, paper, nominal)"
_SOURCE = "camera or ground truth"


def _welds(scenario: Scenario) -> dict[str, Any]:
    """Returns the directives that weld obstacles to the world, by the obstacles' names."""
    prefix = f"{OBSTACLE_PREFIX}_"
    welds = [item.add_weld for item in scenario.directives if item.add_weld is not None]
    return {
        weld.child.partition("::")[0].removeprefix(prefix): weld
        for weld in welds
        if weld.child.startswith(prefix) and weld.parent == "world"
    }


def obstacle_poses(scenario: Scenario) -> dict[str, RigidTransform]:
    """Returns the poses X_WO of the obstacles that can be moved, by their names."""
    poses = {item.name: pose(item) for item in scenario.obstacles}
    for name, weld in _welds(scenario).items():
        poses[name] = weld.X_PC.GetDeterministicValue() if weld.X_PC else RigidTransform()
    return poses


def move_obstacle(scenario: Scenario, name: str, X_WO: RigidTransform) -> None:
    """Moves an obstacle of `obstacle_poses`."""
    welds = _welds(scenario)
    if name in welds:
        welds[name].X_PC = Transform(X_WO)
    for item in scenario.obstacles:
        if item.name == name:
            item.translation = X_WO.translation().tolist()
            item.rpy = RollPitchYaw(X_WO.rotation()).vector().tolist()


class PlaySession:
    """Interactive run of one scenario: `tick` after `tick`, until `stopped`.

    The page folds a slider "NAME: x [m]" into the folder of an obstacle.

    Attributes:
        meshcat: the viewer, with sliders and buttons.
        page: page that shows it with the panel.
        logs: "leg_1" and so on, the motions that have ended; see `finish`.
        stopped: whether the button was pressed.
        homeward: whether it returns to where it began.
    """

    def __init__(self, scenario: Scenario, meshcat: Meshcat, page: LivePage) -> None:
        """Builds the scenario and begins its motion.

        Args:
            scenario: the scenario.
            meshcat: the viewer.
            page: page that shows it with the panel.

        Raises:
            ScenarioError: without a robot, or for a field that does not fit.
        """
        self._limits = make_robot_plant(robot_of(scenario)).limits
        self._scenario = copy.deepcopy(scenario)
        self._scenario.directives = flat_directives(self._scenario.directives)
        self.meshcat, self.page = meshcat, page
        self._poses = obstacle_poses(self._scenario)
        self._sliders = self._add_controls()
        self._active = self._taken = self._wanted = self._settings()
        self._rested = 0.0
        self._home = tuple(self._scenario.task.start)
        self.homeward = self.stopped = False
        self._resets = 0
        self._refused = ""
        self.logs: dict[str, MotionLog] = {}
        self._leg = 0
        self._simulator: Simulator | None = None
        self._begin(None)

    def _add_controls(self) -> list[str]:
        """Adds buttons and sliders; returns the names of the sliders but that of the speed."""
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
        sliders = [("clearance [m]", 0.02, 0.30, 0.005, task.clearance)]
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
        return int(self.meshcat.GetButtonClicks(name))

    def _settings(self) -> dict[str, Any]:
        """Reads the sliders [m, rad], "inference", and "is_seen" by the scenario's camera."""
        turn = self._clicks(_NEXT) + _is_paper(self._scenario)
        can_see = isinstance(self._scenario.perception, CameraSource)
        return {
            **{name: self.meshcat.GetSliderValue(name) for name in self._sliders},
            "inference": _REGULATIONS[turn % len(_REGULATIONS)],
            "is_seen": can_see and self._clicks(_SOURCE) % 2 == 0,
        }

    def tick(self) -> None:
        """Applies changes, advances by `TICK` unless paused, and shows the state."""
        self.stopped = self._clicks("stop") > 0
        settings = self._settings()
        if settings != self._wanted:
            self._wanted, self._rested = settings, 0.0
        self._rested += TICK
        if self._clicks("reset") > self._resets:
            self._resets = self._clicks("reset")
            self.homeward = False
            self._begin(None)
        elif self._wanted != self._taken and self._rested >= SETTLED:
            self._begin(self._positions())
        elif self._monitor.settled and self._monitor.outcome == AT_THE_GOAL:
            self.homeward = not self.homeward
            self._begin(self._positions())
        paused = self._clicks("pause") % 2 == 1
        if self._simulator and not self._monitor.settled and not paused:
            self._simulator.AdvanceTo(self._root().get_time() + TICK)
        self._panel(self._monitor, self._root(), self.status(paused))

    def run(self, each_tick: Callable[[], None] = lambda: None) -> None:
        """Ticks at the selected speed, until the button is pressed.

        Args:
            each_tick: called before each; what it raises ends it.
        """
        due = time.monotonic()
        while not self.stopped:
            each_tick()
            self.tick()
            due += TICK / self.meshcat.GetSliderValue("speed")
            due = max(due, time.monotonic() - _LATEST)
            time.sleep(max(0.0, due - time.monotonic()))

    def finish(self) -> dict[str, MotionLog]:
        """Ends the present motion, and returns the logs."""
        self._end_leg()
        return self.logs

    def _begin(self, q: FloatArray | None) -> None:
        """Builds the wanted scenario, from these joints or the scenario's start.

        Impossible settings are refused: the sliders return, and the present motion goes on.
        """
        settings = self._taken = self._wanted
        avoid_obstacles = settings["inference"] != "nominal"
        try:
            scenario = self._changed(settings, q)
            diagram = build_avoidance(
                scenario, avoid_obstacles=avoid_obstacles, meshcat=self.meshcat
            )
            evaluator = clearance_evaluator(scenario)
            simulator = Simulator(diagram)
            monitor = MotionMonitor(diagram, scenario, math.inf)
            touched = evaluator.metrics(*monitor.positions(simulator.get_context())).contacts
            if self._simulator is not None and not self._contacts().issuperset(touched):
                raise ScenarioError(f"obstacle inside the robot ({', '.join(touched)})")
        except (ScenarioError, ValueError, RuntimeError) as error:
            self._refused = str(error)
            if self._simulator is None:
                raise
            for name in self._sliders:
                self.meshcat.SetSliderValue(name, self._active[name])
            self._taken = self._wanted = self._settings()
            return
        self._end_leg()
        self._refused = ""
        self._active, self._played, self._evaluator = settings, scenario, evaluator
        self._simulator, self._monitor = simulator, monitor
        self._panel = LivePanel(self.page, scenario, avoid_obstacles)
        simulator.Initialize()
        simulator.set_monitor(monitor)

    def _contacts(self) -> frozenset[str]:
        """Returns the pairs in contact now."""
        return frozenset(self._evaluator.metrics(*self._monitor.positions(self._root())).contacts)

    def _changed(self, settings: dict[str, Any], q: FloatArray | None) -> Scenario:
        """Returns the scenario with the settings, its motion from where the arm is."""
        scenario = copy.deepcopy(self._scenario)
        task = scenario.task
        task.clearance = settings["clearance [m]"]
        task.goal = [settings[f"goal {axis} [m]"] for axis in "xyz"]
        if self.homeward:
            task.goal = list(self._home)
        if q is not None:
            task.q_start, task.q_goal = q[: len(robot_of(scenario).q_seed)].tolist(), None
            task.goal_moves, task.demonstration = [], []
            follow_joints(scenario)
        wants_paper = settings["inference"] == "paper"
        if wants_paper != _is_paper(scenario):
            scenario.inference = Paper() if wants_paper else Verified()
        if not settings["is_seen"] and isinstance(scenario.perception, CameraSource):
            scenario.perception, scenario.faults = GroundTruth(), []
        for name, X_WO in self._poses.items():
            x, y, yaw = (settings[f"{name}: {of}"] for of in ("x [m]", "y [m]", "yaw [rad]"))
            roll, pitch, _ = RollPitchYaw(X_WO.rotation()).vector()
            p_WO = [x, y, X_WO.translation()[2]]
            X_WO = RigidTransform(RollPitchYaw(roll, pitch, yaw), p_WO)
            move_obstacle(scenario, name, X_WO)
        return scenario

    def tool_point(self) -> FloatArray:
        """Returns the tool point (3,) now [m]."""
        return self._monitor.tool_point(self._root())

    def _positions(self) -> FloatArray:
        """Returns positions (nq,) of the robot now, within its joints' limits."""
        q = self._monitor.positions(self._root())[0][0]
        lower, upper = self._limits.position_lower, self._limits.position_upper
        return np.clip(q, lower + 1e-6, upper - 1e-6)

    def _root(self) -> Context:
        if self._simulator is None:
            raise RuntimeError("nothing runs")
        return self._simulator.get_context()

    def status(self, paused: bool = False) -> str:
        """Returns the refusal of a change, else the state of the motion."""
        if self._refused:
            return f"refused: {self._refused}"
        return "paused" if paused else self._monitor.state

    def _end_leg(self) -> None:
        if self._simulator is None:
            return
        self._simulator.clear_monitor()
        self._leg += 1
        avoid_obstacles = self._active["inference"] != "nominal"
        self._monitor.finish(self._root())
        if not math.isfinite(self._monitor.motion_end):
            self._monitor.outcome = MotionOutcome(MotionEnd.INTERRUPTED, "restarted")
        log = collect_log(self._played, self._simulator, self._monitor, avoid_obstacles, math.nan)
        self.logs[f"leg_{self._leg}"] = log
        for name in list(self.logs)[:-_MAX_LEGS]:
            del self.logs[name]
        release_cameras(self._simulator.get_system())
        self._simulator = None


def _is_paper(scenario: Scenario) -> bool:
    return isinstance(scenario.inference, Paper)
