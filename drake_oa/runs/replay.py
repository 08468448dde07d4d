"""Replay of a logged motion: a system that outputs the logged values, and a diagram that displays
them in a viewer.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from pathlib import Path

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.geometry import Meshcat, SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import (
    BasicVector,
    Context,
    Diagram,
    DiagramBuilder,
    EventStatus,
    LeafSystem,
)
from pydrake.systems.rendering import MultibodyPositionToGeometryPose

from drake_oa.common.config import ScenarioError
from drake_oa.common.messages import EllipsoidSet, FloatArray, PolicyState
from drake_oa.policy.dmp import local_frame
from drake_oa.robot.plant import base_pose
from drake_oa.runs.motion_log import MotionEnd, MotionLog
from drake_oa.scenario.loading import parse_scenario
from drake_oa.scenario.scenario import Scenario
from drake_oa.viewing.meshcat_overlay import MeshcatOverlay
from drake_oa.viewing.panel import LivePage, Reading
from drake_oa.viewing.viewer import add_world_visualizer, set_scene_style
from drake_oa.world.world_model import add_world

_TIME_TOLERANCE = 1e-9
"""Tolerance for comparing simulated time with logged times, which have rounding errors [s]."""
_MAX_POINTS = 200
"""Maximum number of points with which a replay displays the nominal path."""


def logged_scenario(path: Path, log: MotionLog) -> Scenario:
    """Parses the scenario that a log contains as YAML text.

    Args:
        path: file of the log, for error messages.
        log: log of a motion.

    Raises:
        ScenarioError: if a field of the scenario does not exist in this version.
    """
    try:
        # The run has already resolved the file names in the scenario to absolute ones.
        return parse_scenario(log.scenario)
    except ScenarioError as error:
        version = ", ".join(log.versions[:1])
        raise ScenarioError(f"scenario in {path} (written by {version}): {error}") from None


def choose_motion(path: Path, logs: dict[str, MotionLog], name: str | None) -> str:
    """Returns the name of the motion in a log file that is displayed: the requested one, or a
    default.

    Args:
        path: file of the logs, for error messages.
        logs: logs of the file by the names of the motions.
        name: requested motion; None: the motion "avoiding", or the first motion of a file without
            it.

    Raises:
        ValueError: if the file has no motion of this name, or the motion has no logged instant.
    """
    chosen = name or ("avoiding" if "avoiding" in logs else next(iter(logs)))
    if chosen not in logs:
        raise ValueError(f"{path} has no motion '{chosen}'; it has {', '.join(logs)}")
    if not len(logs[chosen].t):
        raise ValueError(
            f"{path}: the {chosen} motion terminated before its first instant: "
            f"{logs[chosen].stop_reason}"
        )
    return chosen


def world_positions(plant: MultibodyPlant, robot: ModelInstanceIndex, log: MotionLog) -> FloatArray:
    """Returns all positions (T, n) of the plant of robot and world at the T instants of a log [rad,
    m].

    Args:
        plant: finalized plant of the scenario.
        robot: model instance of the robot.
        log: log of a motion. If it contains only the robot's positions, all other positions have
            the default values of the plant.

    Raises:
        ValueError: if the numbers of positions of log and plant differ.
    """
    n, n_robot = plant.num_positions(), plant.num_positions(robot)
    if log.q.shape[1] != n_robot or log.q_world.shape[1] not in (0, n):
        raise ValueError(
            f"the log has {log.q.shape[1]} positions of the robot and {log.q_world.shape[1]} of "
            f"the world, the scenario {n_robot} and {n}: use the robot model of the logged run"
        )
    if log.q_world.shape[1]:
        return log.q_world
    world = np.tile(plant.GetPositions(plant.CreateDefaultContext()), (len(log.q), 1))
    for row, q in zip(world, log.q, strict=True):
        plant.SetPositionsInArray(robot, q, row)
    return world


def nominal_path(scenario: Scenario, logs: dict[str, MotionLog]) -> FloatArray | None:
    """Returns points (N, 3) of the demonstrated path in the world [m], taken from the log of the
    nominal motion.

    The result is None for a scenario without demonstration, whose path is a straight line, or if
    the nominal motion did not reach the goal.

    Args:
        scenario: scenario of the logs.
        logs: logs by the names of the motions.
    """
    log = logs.get("nominal")
    if not scenario.task.demonstration or log is None or log.ended != MotionEnd.GOAL:
        return None
    return log.desired_position[:: 1 + len(log.t) // _MAX_POINTS]


def build_replay(
    scenario: Scenario, log: MotionLog, meshcat: Meshcat, *, nominal_W: FloatArray | None = None
) -> Diagram:
    """Builds the diagram that displays a logged motion in a viewer.

    Args:
        scenario: scenario of the log.
        log: log of the motion.
        meshcat: viewer.
        nominal_W: (N, 3) points of the nominal path in the world [m]; None: the straight line from
            start to goal.

    Raises:
        ScenarioError: if the world cannot be built.
        ValueError: if the numbers of positions of log and scenario differ.
    """
    builder = DiagramBuilder()
    set_scene_style(meshcat, base_pose(scenario.robot), scenario.table_height or 0.0)
    positions, poses = np.zeros((len(log.t), 0)), None
    if scenario.robot is not None:
        scene_graph = builder.AddNamedSystem("scene_graph", SceneGraph())
        plant = MultibodyPlant(time_step=scenario.plant_step)
        source = plant.RegisterAsSourceForSceneGraph(scene_graph)
        robot = add_world(plant, scenario)
        plant.Finalize()
        positions = world_positions(plant, robot, log)
        poses = builder.AddNamedSystem("geometry_poses", MultibodyPositionToGeometryPose(plant))
        builder.Connect(poses.get_output_port(), scene_graph.get_source_pose_port(source))
        add_world_visualizer(builder, scene_graph, meshcat)
    player = builder.AddNamedSystem("log_player", LogPlayer(scenario, log, positions))
    if poses is not None:
        builder.Connect(player.GetOutputPort("positions"), poses.get_input_port())
    overlay = builder.AddNamedSystem("overlay", MeshcatOverlay(meshcat, nominal_W=nominal_W))
    for name in ("ellipsoids_W", "policy_state"):
        builder.Connect(player.GetOutputPort(name), overlay.GetInputPort(name))
    diagram = builder.Build()
    diagram.set_name("replay")
    return diagram


def show_readings(page: LivePage, rows: list[Reading]) -> Callable[[Context], EventStatus]:
    """Creates a monitor for Drake's Simulator that displays the logged text of each time in the
    panel of a live page.

    Args:
        page: live page with the panel.
        rows: texts of the panel (readings) in the order of time, at least one.
    """

    def show(root: Context) -> EventStatus:
        late = bisect_right(rows, root.get_time() + _TIME_TOLERANCE, key=lambda row: row.time)
        page.reading = rows[max(0, late - 1)]
        page.pace()
        return EventStatus.Succeeded()

    return show


class LogPlayer(LeafSystem):
    """System that replays a logged motion: at each time it outputs the latest logged values.

    .. pydrake_system::

      name: LogPlayer
      output_ports:
      - positions
      - ellipsoids_W
      - policy_state

    - positions: (n,) positions of the plant of robot and world, in its order [rad, m].
    - ellipsoids_W: abstract `EllipsoidSet` in the world frame, the latest observation; empty
      before the first one.
    - policy_state: abstract `PolicyState` of the movement primitive. Its p_WE is the actual
      position of the tool point in the world [m]. Its z_W is the desired velocity [m/s]. In a
      simulation, z_W [m] is this velocity times tau T (temporal scaling, demonstrated duration),
      but the log does not contain tau T.

    The system has no state: its outputs depend only on time.
    """

    def __init__(self, scenario: Scenario, log: MotionLog, positions: FloatArray) -> None:
        """Declares the output ports for the values of a log.

        Args:
            scenario: scenario of the log.
            log: log of the motion, with at least one instant.
            positions: (T, n) positions of the plant of robot and world at the instants of the log
                [rad, m].
        """
        super().__init__()
        self._p_WS = np.asarray(scenario.task.start, dtype=float)
        self._log, self._world = log, positions
        now = {self.time_ticket()}
        self.DeclareVectorOutputPort("positions", positions.shape[1], self._calc_positions, now)
        for name, model, calc in (
            ("ellipsoids_W", Value(EllipsoidSet()), self._calc_ellipsoids),
            ("policy_state", Value(PolicyState()), self._calc_policy_state),
        ):
            self.DeclareAbstractOutputPort(name, model.Clone, calc, now)

    def _newest(self, times: FloatArray, context: Context) -> int:
        """Returns the index of the latest logged time that is not after the time of a context; -1:
        there is none.

        Args:
            times: (N,) logged times, increasing [s].
            context: context of this system.
        """
        return int(np.searchsorted(times, context.get_time() + _TIME_TOLERANCE, side="right")) - 1

    def _calc_positions(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._world[max(0, self._newest(self._log.t, context))])

    def _calc_ellipsoids(self, context: Context, output: AbstractValue) -> None:
        row = self._newest(self._log.observation_time, context)
        output.set_value(self._log.observation(row) if row >= 0 else EllipsoidSet())

    def _calc_policy_state(self, context: Context, output: AbstractValue) -> None:
        log, row = self._log, max(0, self._newest(self._log.t, context))
        state = PolicyState(
            p_WE=log.p_WE[row],
            z_W=log.desired_velocity[row],
            phase=float(log.phase[row]),
            p_WS=self._p_WS,
            p_WG=log.goal[row],
            R_WL=local_frame(self._p_WS, log.goal[row]),
            stamp=float(log.t[row]),
        )
        output.set_value(state)
