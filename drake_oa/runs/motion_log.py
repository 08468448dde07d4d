"""Log of one motion as arrays over time, and the .npz file that contains the logs of one run.

The file is a NumPy .npz archive, which `numpy.load` reads without pickle. Its key `schema_version`
holds the number `SCHEMA_VERSION`. Each motion has one key MOTION/ATTRIBUTE for every attribute of
`MotionLog`. MOTION is "nominal" or "avoiding", or "leg_1", "leg_2" and so on for `drake-oa play`.
Texts are string arrays, of dimension 0 for a single text.

W is the world frame (z up), E the tool point, O an obstacle. nq, nv and nu are the numbers of
positions, velocities and actuators of the robot, 0 without a robot. Other letters in shapes count
the entries of the log:

- T instants (every 4 ms).
- F observations of at most M obstacles each.
- K notes with which the policy (the movement primitive) explains holds. During a hold the motion
  rests on its path.
- S changes of the action of the motion guard, which commands the joints.
- D decisions of two layers: "verification" selects the motion, and "guard" selects maneuvers away
  from obstacles.

The verified motion is the selected motion, which was checked by simulation.

====================  =============  ========  ====================================================
key                   shape          unit      content
====================  =============  ========  ====================================================
t                     (T,)           s         simulated time
q                     (T, nq)        rad, m    positions of the robot
v                     (T, nv)        rad/s     velocities of the robot (m/s: prismatic)
torque                (T, nu)        N m, N    applied actuation
saturated             (T,)           none      1 if a joint is at its effort limit, else 0
p_WE                  (T, 3)         m         actual position of the tool point in W; without a
                                               robot the desired one
desired_position      (T, 3)         m         desired position of the tool point in W
desired_velocity      (T, 3)         m/s       first derivative of desired_position
desired_acceleration  (T, 3)         m/s^2     second derivative of desired_position
phase                 (T,)           none      canonical phase k of the movement primitive, from 1
                                               down to 0
speed_scale           (T,)           none      fraction of full speed that the motion guard permits,
                                               in [0, 1]; 1 without a guard
tracking_error        (T,)           m         distance of E to its desired position, as the
                                               controller outputs it; NaN without a controller
q_world               (T, n)         rad, m    all positions of the plant of robot and world; (T, 0)
                                               if only the robot moves
observation_time      (F,)           s         times at which observations became available
observation_stamp     (F,)           s         times at which the observed scene was captured, for
                                               example those of the images; inf: the scenario gives
                                               the ellipsoids
p_WO                  (F, M, 3)      m         centers of the obstacles' ellipsoids in W; NaN rows
                                               for observations of fewer than M ellipsoids
R_WO                  (F, M, 3, 3)   none      orientations of the ellipsoids in W; the columns are
                                               the principal axes
semi_axes             (F, M, 3)      m         semi-axes of the ellipsoids
v_WO                  (F, M, 3)      m/s       velocities of the centers in W
obstacle_id           (F, M)         none      IDs of the ellipsoids; -1: no ellipsoid
out_of_range          (F,)           none      number of obstacles beyond the training range of the
                                               regressor chain
inference             ()             text      method: "Verified" by simulation, or "Paper" (Pairet
                                               et al., RA-L 2019); "" for the nominal motion
shortfall             (T,)           m         predicted amount by which the verified motion falls
                                               below the required clearance; 0: none
event_time            (K,)           s         times at which the note of the policy changed
event                 (K,)           text      notes that explain why the policy holds the motion;
                                               "": the motion continues
supervision_time      (S,)           s         times at which the guard's action or reason changed
supervision_action    (S,)           text      "run", "slow", "hold" or "stop" (a hold for a lasting
                                               reason) from then on
supervision_reason    (S,)           text      reason of the action; "" for "run"
position_name         (nq,)          text      names of the robot's positions
position_lower        (nq,)          rad, m    lower position limits
position_upper        (nq,)          rad, m    upper position limits
velocity_limit        (nv,)          rad/s     maximum speed of each velocity (m/s: prismatic)
actuator_name         (nu,)          text      names of the actuated joints
effort_limit          (nu,)          N m, N    maximum actuation of these joints; inf: none
stop_reason           ()             text      "goal", or the reason of another termination
wall_time             ()             s         wall-clock time of the simulation
avoid_obstacles       ()             bool      whether obstacles were avoided
scenario              ()             text      the scenario as YAML, defaults included
seed                  ()             none      seed of the scenario
versions              (P,)           text      P entries "name value": versions of packages, date,
                                               and source digest (hash of the source files)
goal                  (T, 3)         m         position of the goal
desired_orientation   (T, 4)         none      quaternion w, x, y, z of the desired R_WE; (0, 4):
                                               constant orientation
orientation_error     (T, 3)         rad       rotation vector in W from actual to desired
                                               orientation; (0, 3): constant orientation
desired_posture       (T, 2m)        rad,      nominal positions of the arm's m joints, tracked in
                                     rad/s     the null space, then their velocities; (T, 0): none
guard_action          (T,)           none      decision of the guard: 0 follow the verified motion,
                                               1 follow it at reduced speed, 2 wait on it, 3 evade
                                               by a maneuver, 4 brake; (0,): no guard
guard_contact         (T,)           s         simulated time of the first contact predicted on the
                                               verified motion; inf: none
guard_claim           (T,)           none      claim of passive motion safety by which the guard
                                               limits the speed: 0 none, 1 (A) toward moving
                                               obstacles, 2 (B) toward unobserved space
clearance_reduction   (T,)           m         reduction of the requested clearance because start or
                                               goal is nearer to an obstacle: requested clearance of
                                               the tool minus the largest clearance required between
                                               any link and any obstacle; (0,): unknown
motion_source         (T,)           none      source of the motion: -1 none, 0 nominal motion, 1
                                               regressor chain, 2 search, 3 path in joint space
motion_end            ()             s         time at which the motion terminated, after which the
                                               world comes to rest; NaN: no termination
settled               ()             bool      whether the world came to rest after the termination
decision_time         (D,)           s         times at which decisions started; (0,): no compute
                                               latency is simulated
decision_latency      (D,)           s         simulated duration of each decision
decision_layer        (D,)           text      layer that decides: "verification" or "guard"
event_hold            (K,)           text      reason of the hold from then on: "deciding" (no
                                               motion is selected yet), "speed_scale" (the speed
                                               scale is 0), "supervisor" (the motion guard has set
                                               the speed scale to 0), "goal" (the input `goal` of
                                               the policy is not finite) or "obstacles" (obstacles
                                               are not observed or cannot be passed, or an ellipsoid
                                               contains the tool or the goal); "none": no hold
ended                 ()             text      kind of the termination, a value of `MotionEnd`, such
                                               as "goal"
====================  =============  ========  ====================================================
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from drake_oa.common.files import read_arrays, replace_arrays
from drake_oa.common.messages import EllipsoidSet, FloatArray, IntArray

SCHEMA_VERSION = 3
"""Version of the keys and shapes in log files, stored under the key `schema_version`; a file
without this key has version 1."""

_SCHEMA_KEY = "schema_version"
DECISION_SIGNAL = "decision_"
"""Prefix in the names of logged signals with start time and compute latency of a layer's decisions;
the name of the layer follows, as in "decision_guard"."""


def _empty(*shape: int) -> Any:
    """Returns a dataclass field of `MotionLog` whose default is an empty array, for keys that a log
    file may lack.

    Args:
        shape: shape of the default, with at least one 0.
    """
    return field(default_factory=partial(np.zeros, shape))


class MotionEnd(StrEnum):
    """Kind of termination of a motion; `MotionLog.stop_reason` states the reason in words."""

    GOAL = "goal"
    """Termination because the tool reached the goal."""
    STOPPED = "stopped"
    """Termination because the motion guard stopped the motion, for a cause that is not expected to
    end by itself."""
    HELD = "held"
    """Termination because the motion was held, at rest on its path, longer than the maximum hold
    time of 5 s. A hold until the first motion is selected does not count."""
    MISSED = "goal missed"
    """Termination because the tool was late: still more than 5 mm from the goal at normalized time
    2.2 (1 is the end of the demonstrated motion), or at 0.2 after the predicted arrival of the
    selected motion, whichever is later."""
    LEFT = "goal left"
    """Termination at the goal, after which the tool moved away: at the end of the simulation it was
    more than 5 mm from the goal, for example to evade an obstacle."""
    TIME_LIMIT = "time limit"
    """Termination because the time limit of the run was reached: 6 demonstrated durations after the
    last move of the goal, unless another limit was set."""
    INTERRUPTED = "interrupted"
    """Interruption of the run by an exception, by a signal such as Ctrl-C, or by a restart of the
    motion in `drake-oa play`."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MotionLog:
    """Log of one motion: signals at T instants, F observations of up to M obstacles, notes on
    holds, and decisions.

    The attributes are the keys of a log file. The table in the docstring of the module
    `drake_oa.runs.motion_log` lists shape, unit and meaning of each.
    """

    t: FloatArray
    q: FloatArray
    v: FloatArray
    torque: FloatArray
    saturated: FloatArray
    p_WE: FloatArray
    desired_position: FloatArray
    desired_velocity: FloatArray
    desired_acceleration: FloatArray
    phase: FloatArray
    speed_scale: FloatArray
    tracking_error: FloatArray
    q_world: FloatArray
    observation_time: FloatArray = _empty(0)
    observation_stamp: FloatArray = _empty(0)
    p_WO: FloatArray = _empty(0, 0, 3)
    R_WO: FloatArray = _empty(0, 0, 3, 3)
    semi_axes: FloatArray = _empty(0, 0, 3)
    v_WO: FloatArray = _empty(0, 0, 3)
    obstacle_id: IntArray = _empty(0, 0)
    out_of_range: IntArray = _empty(0)
    inference: str
    shortfall: FloatArray
    event_time: FloatArray = _empty(0)
    event: tuple[str, ...] = ()
    supervision_time: FloatArray = _empty(0)
    supervision_action: tuple[str, ...] = ()
    supervision_reason: tuple[str, ...] = ()
    position_name: tuple[str, ...]
    position_lower: FloatArray
    position_upper: FloatArray
    velocity_limit: FloatArray
    actuator_name: tuple[str, ...]
    effort_limit: FloatArray
    stop_reason: str
    wall_time: float
    avoid_obstacles: bool
    scenario: str
    seed: int
    versions: tuple[str, ...]
    goal: FloatArray
    desired_orientation: FloatArray = _empty(0, 4)
    orientation_error: FloatArray = _empty(0, 3)
    desired_posture: FloatArray = _empty(0, 0)
    guard_action: FloatArray = _empty(0)
    guard_contact: FloatArray = _empty(0)
    guard_claim: FloatArray = _empty(0)
    clearance_reduction: FloatArray = _empty(0)
    motion_source: FloatArray = _empty(0)
    motion_end: float = math.nan
    settled: bool = False
    decision_time: FloatArray = _empty(0)
    decision_latency: FloatArray = _empty(0)
    decision_layer: tuple[str, ...] = ()
    event_hold: tuple[str, ...] = ()
    ended: str

    @property
    def simulated_time(self) -> float:
        """Simulated time of the last logged instant, at which the world was at rest or the run
        ended [s].
        """
        return float(self.t[-1]) if len(self.t) else 0.0

    @property
    def duration(self) -> float:
        """Simulated time from the start to the termination of the motion [s]; without a
        termination, to the last logged instant.
        """
        return self.simulated_time if math.isnan(self.motion_end) else self.motion_end

    @property
    def moving(self) -> slice:
        """Slice of the T logged instants up to the termination of the motion."""
        return slice(int(np.searchsorted(self.t, self.duration, side="right")))

    def arrays(self) -> dict[str, np.ndarray]:
        """Returns all attributes as NumPy arrays, by the keys of a log file; texts become arrays of
        strings.
        """
        return {
            name: np.asarray(value, dtype=str if isinstance(value, tuple) else None)
            for name, value in vars(self).items()
        }

    def observation(self, row: int) -> EllipsoidSet:
        """Returns the ellipsoids of one of the F observations.

        Args:
            row: index of the observation.
        """
        is_present = np.isfinite(self.p_WO[row]).all(axis=1)
        return EllipsoidSet(
            stamp=float(self.observation_stamp[row]),
            p_WO=self.p_WO[row][is_present],
            R_WO=self.R_WO[row][is_present],
            semi_axes=self.semi_axes[row][is_present],
            v_WO=self.v_WO[row][is_present],
            ids=self.obstacle_id[row][is_present],
        )


def pack_ellipsoids(frames: Sequence[EllipsoidSet]) -> dict[str, Any]:
    """Packs F observed sets of ellipsoids into arrays with M rows each, for attributes of a
    `MotionLog`.

    M is the maximum number of ellipsoids in a set. Missing rows are NaN, and their ID is -1.

    Args:
        frames: sets of ellipsoids in the order of the observations.

    Returns:
        Arrays `observation_stamp`, `p_WO`, `R_WO`, `semi_axes`, `v_WO` and `obstacle_id`, by name.
    """
    shape = (len(frames), max(map(len, frames), default=0))
    empty = EllipsoidSet()
    packed: dict[str, np.ndarray] = {
        name: np.full((*shape, *getattr(empty, name).shape[1:]), np.nan)
        for name in ("p_WO", "R_WO", "semi_axes", "v_WO")
    }
    packed["ids"] = np.full(shape, -1, dtype=np.int64)
    for row, frame in enumerate(frames):
        for name, array in packed.items():
            array[row, : len(frame)] = getattr(frame, name)
    stamp = np.array([frame.stamp for frame in frames], dtype=float)
    return {"observation_stamp": stamp, "obstacle_id": packed.pop("ids"), **packed}


def pack_decisions(signals: Mapping[str, FloatArray]) -> dict[str, Any]:
    """Collects the decisions of all layers from logged signals, for attributes of a `MotionLog`.

    Args:
        signals: logged signals by name. A signal with the prefix `decision_` has the shape (T, 2),
            with start time and compute latency [s] of the last decision of the layer that its name
            contains ("verification" or "guard").

    Returns:
        Start times `decision_time` (D,) [s], `decision_latency` (D,) [s] and names of the layers
        `decision_layer` (D,), by these keys, in the order of time.
    """
    decisions = []
    for name, rows in signals.items():
        if name.startswith(DECISION_SIGNAL):
            starts = np.unique(rows[np.isfinite(rows).all(axis=1)], axis=0)
            decisions += [(*row, name.removeprefix(DECISION_SIGNAL)) for row in starts.tolist()]
    times, latencies, layers = zip(*sorted(decisions), strict=True) if decisions else [()] * 3
    return {
        "decision_time": np.array(times),
        "decision_latency": np.array(latencies),
        "decision_layer": layers,
    }


def save_logs(path: Path, logs: dict[str, MotionLog]) -> None:
    """Writes the logs of several motions to one log file, which is replaced atomically.

    Args:
        path: log file (.npz).
        logs: logs by the names of the motions.

    Raises:
        OutputError: if the file cannot be written.
    """
    arrays = {
        f"{name}/{key}": value for name, log in logs.items() for key, value in log.arrays().items()
    }
    replace_arrays(path, {**arrays, _SCHEMA_KEY: SCHEMA_VERSION})


def load_logs(path: Path) -> dict[str, MotionLog]:
    """Reads a log file, and returns its logs by the names of the motions.

    Raises:
        OSError: if the file cannot be opened.
        ValueError: if the file is no motion log, is damaged, has another schema version, or lacks a
            key.
    """
    try:
        return _motions(read_arrays(path))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path} is not a motion log, or is damaged: {error}") from None


def _motions(arrays: Mapping[str, np.ndarray]) -> dict[str, MotionLog]:
    """Creates the logs of all motions from the arrays of a log file, and returns them by name.

    Args:
        arrays: arrays of the file by key, such as "avoiding/q".

    Raises:
        ValueError: if there is no motion, or if the file has another schema version.
    """
    motions = [key.removesuffix("/stop_reason") for key in arrays if key.endswith("/stop_reason")]
    if not motions:
        raise ValueError("it has no key MOTION/stop_reason")
    version = int(arrays.get(_SCHEMA_KEY, 1))
    if version != SCHEMA_VERSION:
        versions = arrays.get(f"{motions[0]}/versions", np.array(["an earlier version"]))
        reader = " ".join(str(versions[0]).split()[:2])
        raise ValueError(
            f"it has schema {version}, this version of drake_oa reads schema {SCHEMA_VERSION}: "
            f"read it with {reader}, or run the scenario again"
        )
    logs = {}
    for motion in motions:
        attributes = {
            item.name: _value(arrays[f"{motion}/{item.name}"])
            for item in fields(MotionLog)
            if f"{motion}/{item.name}" in arrays
        }
        logs[motion] = MotionLog(**attributes)
    return logs


def _value(array: np.ndarray) -> Any:
    """Converts an array of a log file to the value of a `MotionLog` attribute: scalar, array, or
    tuple of texts.
    """
    if array.ndim == 0:
        return array.item()
    return tuple(array.tolist()) if array.dtype.kind == "U" else array
