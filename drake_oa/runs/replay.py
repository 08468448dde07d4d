"""A logged motion as a function of time, on ports, and drawn again."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.geometry import (
    Meshcat,
    MeshcatVisualizer,
    MeshcatVisualizerParams,
    Role,
    SceneGraph,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, ModelInstanceIndex
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
from drake_oa.common.messages import EllipsoidSet, FloatArray, HoldCause, PolicyState
from drake_oa.policy.dmp import local_frame
from drake_oa.robot.plant import base_pose
from drake_oa.runs.motion_log import MotionEnd, MotionLog
from drake_oa.scenario.loading import parse_scenario
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.task import goal_at
from drake_oa.viewing.meshcat_overlay import MeshcatOverlay
from drake_oa.viewing.panel import LivePage, Reading
from drake_oa.viewing.viewer import dress_scene
from drake_oa.world.world_model import add_world

_EARLY = 1e-9
"""What was logged up to this much later [s] counts as logged: times are rounded."""


def logged_scenario(path: Path, log: MotionLog) -> Scenario:
    """The scenario that a log was made with.

    Args:
        path: the log's file, for errors.
        log: the log.

    Raises:
        ScenarioError: if this version does not know the scenario's fields.
    """
    try:
        # Its file names were made absolute when it was read first.
        return parse_scenario(log.scenario)
    except ScenarioError as error:
        made = ", ".join(log.versions[:1])
        raise ScenarioError(f"the scenario in {path} (made with {made}): {error}") from None


def choose_motion(path: Path, logs: dict[str, MotionLog], name: str | None) -> str:
    """The motion to show: the one asked for, else the modulated one if it was started.

    Args:
        path: the log's file, for errors.
        logs: the motions in it.
        name: the motion asked for, or None.

    Raises:
        ValueError: if there is no such motion, or nothing was logged of it.
    """
    chosen = name or ("modulated" if "modulated" in logs else next(iter(logs)))
    if chosen not in logs:
        raise ValueError(f"{path} has no motion '{chosen}'; it has {', '.join(logs)}")
    if not len(logs[chosen].t):
        raise ValueError(
            f"{path}: the {chosen} motion was ended before its first instant: "
            f"{logs[chosen].stop_reason}"
        )
    return chosen


def world_positions(plant: MultibodyPlant, robot: ModelInstanceIndex, log: MotionLog) -> FloatArray:
    """(T, n) positions of a scenario's world at the instants of a log [rad, m].

    Args:
        plant: the finalized plant of the world.
        robot: the robot's model instance.
        log: the log; where it has only the robot's positions, the rest stays where the
            plant has it by default.

    Raises:
        ValueError: if the log is not of this world.
    """
    n, n_robot = plant.num_positions(), plant.num_positions(robot)
    if log.q.shape[1] != n_robot or log.q_world.shape[1] not in (0, n):
        raise ValueError(
            f"the log has {log.q.shape[1]} positions of the robot and {log.q_world.shape[1]} of "
            f"the world; its scenario has {n_robot} and {n}: was the robot's model changed?"
        )
    if log.q_world.shape[1]:
        return log.q_world
    world = np.tile(plant.GetPositions(plant.CreateDefaultContext()), (len(log.q), 1))
    for row, q in zip(world, log.q, strict=True):
        plant.SetPositionsInArray(robot, q, row)
    return world


_MOST_POINTS = 200
"""Greatest number of points of a planned path."""


def planned_path(scenario: Scenario, logs: dict[str, MotionLog]) -> FloatArray | None:
    """The planned path as the pre-planned motion was asked to go; None: a straight line.

    Args:
        scenario: the scenario of the logs.
        logs: the motions of a run.

    Returns:
        (N, 3) points [m], or None where the line from start to goal was planned, or the
        demonstrated path is not in the log whole.
    """
    log = logs.get("preplanned")
    if not scenario.task.demonstration or log is None or log.ended != MotionEnd.GOAL:
        return None
    step = math.ceil(len(log.t) / _MOST_POINTS)
    return log.desired_position[::step]


FRAME_PERIOD = 1.0 / 30.0


def build_replay(
    scenario: Scenario,
    log: MotionLog,
    meshcat: Meshcat,
    *,
    planned_W: FloatArray | None = None,
    speed: float = 1.0,
) -> Diagram:
    """Wires a log to the viewer.

    Args:
        scenario: the log's scenario.
        log: the motion.
        meshcat: the viewer.
        planned_W: (N, 3) the planned path [m]; None: the line from start to goal.
        speed: logged seconds that pass in one simulated second.

    Raises:
        ScenarioError: if the world cannot be built.
        ValueError: if the log is empty or not of this world.
    """
    builder = DiagramBuilder()
    dress_scene(meshcat, base_pose(scenario.robot), scenario.table_height or 0.0)
    positions = np.zeros((len(log.t), 0))
    if scenario.robot is not None:
        scene_graph = builder.AddNamedSystem("scene_graph", SceneGraph())
        plant = MultibodyPlant(time_step=scenario.plant_step)
        source = plant.RegisterAsSourceForSceneGraph(scene_graph)
        robot = add_world(plant, scenario)
        plant.Finalize()
        positions = world_positions(plant, robot, log)
        poses = builder.AddNamedSystem("geometry_poses", MultibodyPositionToGeometryPose(plant))
        builder.Connect(poses.get_output_port(), scene_graph.get_source_pose_port(source))
        # The same path in the viewer's tree as that of a run.
        shown = MeshcatVisualizerParams(
            role=Role.kIllustration, prefix="illustration", publish_period=FRAME_PERIOD
        )
        MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat, shown)
    player = LogPlayer(scenario, log, positions, speed=speed)
    builder.AddNamedSystem("log_player", player)
    if scenario.robot is not None:
        builder.Connect(player.GetOutputPort("positions"), poses.get_input_port())
    overlay = builder.AddNamedSystem(
        "overlay", MeshcatOverlay(meshcat, planned_W=planned_W, body_index=BodyIndex(0))
    )
    for name in ("ellipsoids_W", "policy_state", "body_poses"):
        builder.Connect(player.GetOutputPort(name), overlay.GetInputPort(name))
    diagram = builder.Build()
    diagram.set_name("replay")
    return diagram


def show_readings(page: LivePage, rows: list[Reading]) -> Callable[[Context], EventStatus]:
    """Makes a monitor that shows the reading of each instant on a live page.

    Args:
        page: the page.
        rows: readings by time, one at least.
    """

    def show(root: Context) -> EventStatus:
        late = bisect_right(rows, root.get_time() + _EARLY, key=lambda row: row.time)
        page.reading = rows[max(0, late - 1)]
        page.pace()
        return EventStatus.Succeeded()

    return show


def _output(look_up: Callable[[Context], Any], context: Context, output: AbstractValue) -> None:
    output.set_value(look_up(context))


class LogPlayer(LeafSystem):
    """Plays a logged motion: at each instant the newest values that were logged.

    .. pydrake_system::

      name: LogPlayer
      output_ports:
      - positions
      - ellipsoids_W
      - policy_state
      - body_poses

    - positions: (n,) positions of the world's plant, in its order [rad, m].
    - ellipsoids_W: abstract `EllipsoidSet` in the world frame, the observation that had
      arrived last; empty before the first.
    - policy_state: abstract `PolicyState`; its z_W is the desired velocity [m/s]: the log knows
      the direction alone, not the scale tau T.
    - body_poses: list of one `RigidTransform`, whose origin is the actual tool point E;
      its axes are the world's.

    There is no state: the outputs depend on time alone.
    """

    def __init__(
        self, scenario: Scenario, log: MotionLog, positions: FloatArray, *, speed: float = 1.0
    ) -> None:
        """Declares the ports.

        Args:
            scenario: of the log.
            log: the motion.
            positions: (T, n) positions of the world's plant at its instants [rad, m].
            speed: logged seconds that pass in one simulated second.

        Raises:
            ValueError: if the log has no instant.
        """
        super().__init__()
        if not len(log.t):
            raise ValueError(f"the log has no instant: {log.stop_reason}")
        self._task, self._log, self._world, self._speed = scenario.task, log, positions, speed
        self._seen = [log.observation(row) for row in range(len(log.observation_time))]
        now = {self.time_ticket()}
        self.DeclareVectorOutputPort("positions", positions.shape[1], self._calc_positions, now)
        for name, model, look_up in (
            ("ellipsoids_W", Value(EllipsoidSet()), self._ellipsoids),
            ("policy_state", Value(PolicyState()), self._policy_state),
            ("body_poses", Value[list[RigidTransform]](), self._body_poses),
        ):
            self.DeclareAbstractOutputPort(name, model.Clone, partial(_output, look_up), now)

    def _newest(self, times: FloatArray, context: Context) -> int:
        """Finds the row of the last of the times that is not later than now; -1: none."""
        now = self._speed * context.get_time() + _EARLY
        return int(np.searchsorted(times, now, side="right")) - 1

    def _row(self, context: Context) -> int:
        """Finds the row of the newest instant; the first one before it."""
        return max(0, self._newest(self._log.t, context))

    def _body_poses(self, context: Context) -> list[RigidTransform]:
        return [RigidTransform(self._log.p_WE[self._row(context)])]

    def _calc_positions(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._world[self._row(context)])

    def _ellipsoids(self, context: Context) -> EllipsoidSet:
        row = self._newest(self._log.observation_time, context)
        return self._seen[row] if row >= 0 else EllipsoidSet()

    def _policy_state(self, context: Context) -> PolicyState:
        log, row = self._log, self._row(context)
        p_WS = np.asarray(self._task.start, dtype=float)
        p_WG = goal_at(self._task, float(log.t[row]))
        event = self._newest(log.event_time, context)
        return PolicyState(
            p_WE=log.desired_position[row],
            z_W=log.desired_velocity[row],
            phase=float(log.phase[row]),
            p_WS=p_WS,
            p_WG=p_WG,
            R_WL=local_frame(p_WS, p_WG),
            stamp=float(log.t[row]),
            hold=HoldCause(log.event_hold[event]) if event >= 0 else HoldCause.NONE,
            note=log.event[event] if event >= 0 else "",
        )
