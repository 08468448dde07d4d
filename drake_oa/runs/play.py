"""A scenario to play with: its motion goes to and fro while clearance, goal and things are changed.

Whatever is changed is taken over after a moment, in a diagram that is built anew: the motion
begins again, from rest, where the arm is. Between changes it is the very diagram that
`drake-oa run` runs, in the same steps.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydrake.common.schema import Transform
from pydrake.geometry import Meshcat, Rgba
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from drake_oa.common.config import ScenarioError
from drake_oa.common.messages import FloatArray
from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.geometry.shapes import Sphere
from drake_oa.perception.config import CameraSource, GroundTruth
from drake_oa.regulation.config import Paper, Verified
from drake_oa.robot.plant import make_robot_plant
from drake_oa.runs.metrics import robot_judge
from drake_oa.runs.motion_log import MotionEnd, MotionLog
from drake_oa.runs.page import LivePanel
from drake_oa.runs.simulation import AT_THE_GOAL, Ending, MotionWatcher, collect_log
from drake_oa.scenario.end_poses import follow_joints
from drake_oa.scenario.obstacles import OBSTACLE_PREFIX, Obstacle
from drake_oa.scenario.scenario import Scenario, robot_of
from drake_oa.viewing.drawing import DISTANCE
from drake_oa.viewing.panel import LivePage
from drake_oa.world.station import release_cameras
from drake_oa.world.world_model import flat_directives

TICK = 1.0 / 30.0
"""Simulated time between two looks at the controls [s]."""
SETTLED = 0.3
"""A control that is being moved is taken over so long after it rests [s]."""
MOST_LEGS = 20
"""Motions that the log keeps: the newest ones."""
THROWN = Obstacle(
    name="thrown_in",
    shapes=[Sphere(radius=0.06)],
    color=[0.29, 0.46, 0.66, 1.0],
    waypoints=[
        [0.0, 0.7, 0.0, 0.2],
        [1.2, 0.0, 0.0, 0.0],
        [5.0, 0.0, 0.0, 0.0],
        [6.2, 0.7, 0.0, 0.2],
    ],
)
"""What is thrown in: it comes to the middle of the way that is left, and leaves again."""
_LATEST = 0.1
"""A picture that is later than this is not caught up with [s]."""
_LINE = "/drake_oa/deciding_distance"
_REGULATIONS = ("verified", "paper", "preplanned")
_NEXT = "next method (verified, paper, nominal)"


@dataclass
class Movable:
    """An obstacle that has sliders: one of `obstacles`, or a model that a directive welds.

    Attributes:
        name: name of the obstacle.
        p_WO: (3,) its position [m].
        rpy: (3,) roll, pitch, yaw [rad].
        row: its place in the scenario's obstacles or directives.
        is_welded: whether it is one of the directives.
    """

    name: str
    p_WO: FloatArray
    rpy: FloatArray
    row: int
    is_welded: bool = False

    def put(self, scenario: Scenario, p_WO: FloatArray, rpy: FloatArray) -> None:
        """Puts it at another pose of a scenario."""
        if self.is_welded:
            weld: Any = scenario.directives[self.row].add_weld
            weld.X_PC = Transform(RigidTransform(RollPitchYaw(rpy), p_WO))
        else:
            obstacle = scenario.obstacles[self.row]
            obstacle.translation, obstacle.rpy = p_WO.tolist(), rpy.tolist()


def movables(scenario: Scenario) -> list[Movable]:
    """Lists the obstacles with a pose of their own: those of the scenario, and welded models."""
    found = [
        Movable(item.name, np.array(item.translation), np.array(item.rpy), row)
        for row, item in enumerate(scenario.obstacles)
    ]
    for row, directive in enumerate(scenario.directives):
        weld = directive.add_weld
        if weld is None or not weld.child.startswith(OBSTACLE_PREFIX) or weld.parent != "world":
            continue
        X_WO = weld.X_PC.GetDeterministicValue() if weld.X_PC else RigidTransform()
        rpy = RollPitchYaw(X_WO.rotation()).vector()
        name = weld.child.partition("::")[0].removeprefix(f"{OBSTACLE_PREFIX}_")
        found.append(Movable(name, X_WO.translation().copy(), rpy, row, is_welded=True))
    return found


@dataclass
class Choice:
    """State of the controls.

    Attributes:
        values: name of a slider -> its value [m, rad].
        regulation: "verified", "paper" or "preplanned".
        seen: whether obstacles are seen by the scenario's camera, rather than known.
        thrown: how often something was thrown in.
    """

    values: dict[str, float]
    regulation: str
    seen: bool
    thrown: int


@dataclass
class Controls:
    """Sliders and buttons in Meshcat's panel; their state is a `Choice`.

    The page folds "NAME: x [m]" into the folder of an obstacle.

    Attributes:
        meshcat: the viewer.
        scenario: their state at the beginning.
        things: the obstacles that have sliders.
    """

    meshcat: Meshcat
    scenario: Scenario
    things: list[Movable]

    def __post_init__(self) -> None:
        for name, key in (
            ("pause", "Space"),
            ("step", "KeyN"),
            ("reset", "KeyR"),
            ("throw it in", "KeyT"),
            (_NEXT, "KeyV"),
            ("camera or ground truth", "KeyC"),
            ("stop", "Escape"),
        ):
            self.meshcat.AddButton(name, key)
        self.meshcat.AddSlider("speed", 0.1, 1.0, 0.1, 1.0)
        task = self.scenario.task
        sliders = [("clearance [m]", 0.02, 0.30, 0.005, task.clearance)]
        for axis, at, low, high in zip(
            "xyz", task.goal, (0.2, -0.7, 0.05), (0.75, 0.7, 0.8), strict=True
        ):
            sliders.append((f"goal {axis} [m]", min(low, at), max(high, at), 0.01, at))
        for thing in self.things:
            x, y, yaw = thing.p_WO[0], thing.p_WO[1], thing.rpy[2]
            sliders += [
                (f"{thing.name}: x [m]", x - 0.4, x + 0.4, 0.01, x),
                (f"{thing.name}: y [m]", y - 0.6, y + 0.6, 0.01, y),
                (f"{thing.name}: yaw [rad]", -3.14, 3.14, 0.02, yaw),
            ]
        for slider in sliders:
            self.meshcat.AddSlider(*slider)
        self._sliders = [name for name, *_ in sliders]

    def clicks(self, name: str) -> int:
        """Returns how often a button was pressed."""
        return int(self.meshcat.GetButtonClicks(name))

    def choice(self) -> Choice:
        """Reads their state."""
        first = _REGULATIONS.index("paper" if _is_paper(self.scenario) else "verified")
        turn = first + self.clicks(_NEXT)
        can_see = isinstance(self.scenario.perception, CameraSource)
        return Choice(
            {name: self.meshcat.GetSliderValue(name) for name in self._sliders},
            regulation=_REGULATIONS[turn % len(_REGULATIONS)],
            seen=can_see and self.clicks("camera or ground truth") % 2 == 0,
            thrown=self.clicks("throw it in"),
        )

    def put_back(self, choice: Choice) -> None:
        """Sets the sliders to an earlier choice."""
        for name, value in choice.values.items():
            self.meshcat.SetSliderValue(name, value)


def _is_paper(scenario: Scenario) -> bool:
    return isinstance(scenario.regulation, Paper)


class PlaySession:
    """One scenario, played: `tick` after `tick`, until `stopped`.

    Attributes:
        controls: what may be changed.
        page: whose panel shows it.
        logs: "leg_1" and so on, the motions that have ended; see `finish`.
        stopped: whether the button was pressed.
        kept: distance of the arm to the nearest obstacle now [m].
        homeward: whether it goes back to where it began.
    """

    def __init__(self, scenario: Scenario, meshcat: Meshcat, page: LivePage) -> None:
        """Builds the scenario and begins its motion.

        Args:
            scenario: what is played.
            meshcat: the viewer.
            page: whose panel shows it.

        Raises:
            ScenarioError: without a robot, or for a field that does not fit.
        """
        self._limits = make_robot_plant(robot_of(scenario)).limits
        self._scenario = copy.deepcopy(scenario)
        self._scenario.directives = flat_directives(self._scenario.directives)
        self.controls = Controls(meshcat, self._scenario, movables(self._scenario))
        self._meshcat, self.page = meshcat, page
        self._taken = self._wanted = self._playing = self.controls.choice()
        self._rested = 0.0
        self._home = tuple(self._scenario.task.start)
        self.homeward = False
        self._resets = self._steps = self._thrown = 0
        self._refused = ""
        self.logs: dict[str, MotionLog] = {}
        self._leg = 0
        self.stopped = False
        self.kept = math.inf
        self._simulator: Simulator | None = None
        self._begin(None)

    def tick(self) -> None:
        """Takes over what was changed, goes on by `TICK` unless paused, and says how it is."""
        controls = self.controls
        self.stopped = controls.clicks("stop") > 0
        choice = controls.choice()
        if choice != self._wanted:
            self._wanted, self._rested = choice, 0.0
        self._rested += TICK
        if controls.clicks("reset") > self._resets:
            self._resets = controls.clicks("reset")
            self.homeward = False
            self._begin(None)
        elif self._wanted != self._taken and self._rested >= SETTLED:
            self._begin(self._positions())
        elif self._watcher.settled and self._watcher.ending == AT_THE_GOAL:
            self.homeward = not self.homeward
            self._begin(self._positions())
        paused = controls.clicks("pause") % 2 == 1
        stepping = controls.clicks("step") > self._steps
        self._steps = controls.clicks("step")
        now = self._root().get_time()
        if self._simulator and not self._watcher.settled and (not paused or stepping):
            self._simulator.AdvanceTo(now + TICK)
        self._say(paused)

    def run(self, each_tick: Callable[[], None] = lambda: None) -> None:
        """Ticks at the speed that is asked for, until the button is pressed.

        Args:
            each_tick: called before each; what it raises ends it.
        """
        due = time.monotonic()
        while not self.stopped:
            each_tick()
            self.tick()
            due += TICK / self._meshcat.GetSliderValue("speed")
            wait = due - time.monotonic()
            if wait > 0.0:
                time.sleep(wait)
            elif wait < -_LATEST:
                due = time.monotonic()

    def finish(self) -> dict[str, MotionLog]:
        """The motions until now, the present one too; what takes images is given back."""
        self._end_leg()
        return self.logs

    def _begin(self, q: FloatArray | None) -> None:
        """Builds what is wanted, from these joints or the scenario's start.

        What cannot be is refused: the sliders go back, and the motion there is goes on.
        """
        choice = self._wanted
        self._taken = choice
        modulated = choice.regulation != "preplanned"
        try:
            scenario = self._chosen(choice, q)
            diagram = build_avoidance(scenario, modulated=modulated, meshcat=self._meshcat)
            judge = robot_judge(scenario)
            simulator = Simulator(diagram)
            watcher = MotionWatcher(diagram, scenario, math.inf)
            touched = judge.metrics(*watcher.positions(simulator.get_context())).contacts
            if self._simulator is not None and not self._contacts().issuperset(touched):
                raise ScenarioError(f"obstacle inside the robot ({', '.join(touched)})")
        except (ScenarioError, ValueError, RuntimeError) as error:
            self._refused = str(error)
            if self._simulator is None:
                raise
            self.controls.put_back(self._playing)
            self._taken = self._wanted = self.controls.choice()
            return
        self._end_leg()
        self._refused = ""
        self._thrown = choice.thrown
        self._playing, self._played, self._judge = choice, scenario, judge
        self._simulator, self._watcher = simulator, watcher
        self._panel = LivePanel(self.page, scenario, modulated)
        simulator.Initialize()
        simulator.set_monitor(watcher)

    def _contacts(self) -> frozenset[str]:
        """Pairs that touch now, in the motion there is."""
        return frozenset(self._judge.metrics(*self._watcher.positions(self._root())).contacts)

    def _chosen(self, choice: Choice, q: FloatArray | None) -> Scenario:
        """The scenario that is asked for, its motion from where the arm is."""
        scenario = copy.deepcopy(self._scenario)
        task = scenario.task
        values = choice.values
        task.clearance = values["clearance [m]"]
        task.goal = [values[f"goal {axis} [m]"] for axis in "xyz"]
        if self.homeward:
            task.goal = list(self._home)
        if q is not None:
            task.q_start, task.q_goal = q[: len(robot_of(scenario).q_seed)].tolist(), None
            task.goal_moves, task.demonstration = [], []
            follow_joints(scenario)
        if choice.regulation == "paper" and not _is_paper(scenario):
            scenario.regulation = Paper()
        elif choice.regulation == "verified" and _is_paper(scenario):
            scenario.regulation = Verified()
        if not choice.seen and isinstance(scenario.perception, CameraSource):
            scenario.perception, scenario.faults = GroundTruth(), []
        for thing in self.controls.things:
            x, y, yaw = (values[f"{thing.name}: {of}"] for of in ("x [m]", "y [m]", "yaw [rad]"))
            thing.put(scenario, np.array([x, y, thing.p_WO[2]]), np.array([*thing.rpy[:2], yaw]))
        if choice.thrown > self._thrown:
            middle = 0.5 * (np.array(task.start) + np.array(task.goal))
            scenario.obstacles.append(replace(THROWN, translation=middle.tolist()))
        return scenario

    def tool_point(self) -> FloatArray:
        """(3,) where the tool point is now [m]."""
        return self._watcher.tool_point(self._root())

    def _positions(self) -> FloatArray:
        """(nq,) of the robot now, within its joints' limits."""
        q = self._watcher.positions(self._root())[0][0]
        lower, upper = self._limits.position_lower, self._limits.position_upper
        return np.clip(q, lower + 1e-6, upper - 1e-6)

    def _root(self) -> Context:
        if self._simulator is None:
            raise RuntimeError("nothing runs")
        return self._simulator.get_context()

    def _say(self, paused: bool) -> None:
        root = self._root()
        q, q_world = self._watcher.positions(root)
        near = self._judge.nearest(q[0], q_world[0])
        self.kept = near.distance if near else math.inf
        if near:
            ends = near.p_WA.reshape(3, 1), near.p_WB.reshape(3, 1)
            self._meshcat.SetLineSegments(_LINE, *ends, 3.0, Rgba(*DISTANCE))
        else:
            self._meshcat.Delete(_LINE)
        self._panel(self._watcher, root, self.status(paused))

    def status(self, paused: bool = False) -> str:
        """Says what was refused, else what holds or has ended the motion, or that it runs."""
        if self._refused:
            return f"refused: {self._refused}"
        return "paused" if paused else self._watcher.state

    def _end_leg(self) -> None:
        if self._simulator is None:
            return
        self._simulator.clear_monitor()
        self._leg += 1
        modulated = self._playing.regulation != "preplanned"
        self._watcher.finish(self._root())
        if math.isnan(self._watcher.motion_end) or self._watcher.motion_end == math.inf:
            self._watcher.ending = Ending(MotionEnd.CUT_SHORT, "begun anew")
        log = collect_log(self._played, self._simulator, self._watcher, modulated, math.nan)
        self.logs[f"leg_{self._leg}"] = log
        for name in list(self.logs)[:-MOST_LEGS]:
            del self.logs[name]
        release_cameras(self._simulator.get_system())
        self._simulator = None
