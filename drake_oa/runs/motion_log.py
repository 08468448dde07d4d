"""The log of one motion, and its file.

The file is a NumPy .npz archive of schema `SCHEMA_VERSION`: the key `schema_version`
holds that number, and each motion has one key "MOTION/ATTRIBUTE" for every attribute
of `MotionLog`, where MOTION is "nominal" or "avoiding". Texts are string arrays,
zero-dimensional for a single text. `numpy.load` alone reads it, without pickle.

W is the world frame, E the tool point, O an obstacle; nq, nv and nu are the robot's
positions, velocities and actuators, 0 without a robot. SI units: m, rad, s, N, N m.

=====================  =============  =======  ==========================================
key                    shape          unit     content
=====================  =============  =======  ==========================================
t                      (T,)           s        simulated time
q                      (T, nq)        rad, m   positions of the robot
v                      (T, nv)        rad/s    velocities of the robot (m/s: sliding)
torque                 (T, nu)        N m, N   actuation applied
saturated              (T,)           1        1 where a torque limit was reached
p_WE                   (T, 3)         m        actual tool point; without a robot the
                                               desired one
desired_position       (T, 3)         m        p_WE asked of the controller
desired_velocity       (T, 3)         m/s      its derivative
desired_acceleration   (T, 3)         m/s^2    its second derivative
phase                  (T,)           1        canonical phase k, 1 falling to 0
speed_scale            (T,)           1        share of full speed that the guard allows, in
                                               [0, 1]; 1 without one
tracking_error         (T,)           m        distance of E to where it was asked to be,
                                               as the controller tells it; NaN where none does
q_world                (T, n)         rad, m   all positions of the station's plant, in its
                                               order; (T, 0) where only the robot moves
observation_time       (F,)           s        times at which observations arrived
observation_stamp      (F,)           s        when the scene looked as they say; inf for
                                               ellipsoids that are given
p_WO                   (F, M, 3)      m        centers of the ellipsoids; NaN rows where an
                                               observation has fewer than M
R_WO                   (F, M, 3, 3)   1        their orientations, principal axes in columns
semi_axes              (F, M, 3)      m        their semi-axes
v_WO                   (F, M, 3)      m/s      velocities of their centers
obstacle_id            (F, M)         -        their names; -1 where there is none
out_of_range           (F,)           1        for how many of them the regressor chain was
                                               asked for more than it was trained for
inference             ()             text     "Verified" or "Paper"; "" unmodulated
shortfall              (T,)           m        what the verified motion lacked of the
                                               feasible clearance, as inference believed
event_time             (E,)           s        times at which a note of the policy changed
event                  (E,)           text     those notes; "": running freely again
supervision_time       (S,)           s        times at which the guard's decision changed
supervision_action     (S,)           text     "run", "slow", "hold" or "stop" from then on
supervision_reason     (S,)           text     why; "" for "run"
position_name          (nq,)          text     names of the robot's positions
position_lower         (nq,)          rad, m   their lower limits
position_upper         (nq,)          rad, m   their upper limits
velocity_limit         (nv,)          rad/s    greatest speed of each (m/s: sliding)
actuator_name          (nu,)          text     names of the actuated joints
effort_limit           (nu,)          N m, N   their greatest actuation; inf: none
stop_reason            ()             text     "goal", or what ended the motion short of it
wall_time              ()             s        real time that the simulation took
avoid_obstacles        ()             bool     whether the motion was bent round obstacles
scenario               ()             text     the scenario as YAML, defaults included
seed                   ()             1        the scenario's seed
versions               (P,)           text     packages, date, source digest: "name value"
goal                   (T, 3)         m        where the goal was
desired_orientation    (T, 4)         1        quaternion w, x, y, z of R_WE asked of the
                                               controller; (0, 4) where it stays
orientation_error      (T, 3)         rad      rotation vector from the actual to the desired
                                               orientation in W; (0, 3) likewise
desired_posture        (T, 2n)        rad,     arm positions, then velocities, that the null space
                                      rad/s    was drawn to; (T, 0) where none was planned
guard_action           (T,)           1        action of the motion guard: 0 follow, 1 slow, 2 wait,
                                               3 evade, 4 brake; (0,) without a guard
guard_contact          (T,)           s        time of the first contact that it predicts on the
                                               verified motion; inf: none; (0,) likewise
guard_claim            (T,)           1        claim of passive motion safety that limits the speed:
                                               0 none, 1 (A), 2 (B); (0,) likewise
clearance_reduction    (T,)           m        reduction of the requested clearance, because the
                                               start or the goal leaves no more; (0,): unknown
motion_source          (T,)           1        source of the motion: -1 none, 0 nominal, 1 chain,
                                               2 search, 3 joint_path; (0,) likewise
motion_end             ()             s        when the motion ended; the world goes on after it
                                               until all is at rest; NaN where a file does not tell
settled                ()             bool     whether all came to rest
decision_time          (D,)           s        when decisions began; (0,) where a file does
                                               not tell, or they cost no time
decision_latency          (D,)           s        the simulated time that each takes
decision_layer         (D,)           text     layer that decides: "verification" or "guard"
event_hold             (E,)           text     what held the motion from then on, one of `HoldReason`
ended                  ()             text     how the motion ended, one of `MotionEnd`
=====================  =============  =======  ==========================================
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
"""Schema of the files that are written and read; a file without a number has schema 1."""

_SCHEMA_KEY = "schema_version"
DECISION_SIGNAL = "decision_"
"""Prefix of the name of the log of a layer's port `decision`; the layer's name follows."""


def _empty(*shape: int) -> Any:
    """Returns a field that is an empty array by default; a file may lack it."""
    return field(default_factory=partial(np.zeros, shape))


class MotionEnd(StrEnum):
    """How a motion ended; `stop_reason` says it in words."""

    GOAL = "goal"
    STOPPED = "stopped"
    """By the supervisor."""
    HELD = "held"
    """For too long."""
    MISSED = "goal missed"
    """The tool did not come to the goal in time."""
    LEFT = "goal left"
    """It evaded there, and did not come back."""
    TIME_LIMIT = "time limit"
    INTERRUPTED = "interrupted"
    """Interrupted, or something was raised."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MotionLog:
    """Log of one motion: T instants, F observations of up to M obstacles.

    The attributes are the keys of the file: the table above has the shape, unit and
    frame of each.
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
        """Time until all was at rest, or the run was ended [s]."""
        return float(self.t[-1]) if len(self.t) else 0.0

    @property
    def duration(self) -> float:
        """Duration of the motion, to its end [s]."""
        return self.simulated_time if math.isnan(self.motion_end) else self.motion_end

    @property
    def moving(self) -> slice:
        """The instants of the motion, without what came after its end."""
        return slice(int(np.searchsorted(self.t, self.duration, side="right")))

    def arrays(self) -> dict[str, np.ndarray]:
        """Returns every attribute as an array, the form in which it is written to a file."""
        return {
            name: np.asarray(value, dtype=str if isinstance(value, tuple) else None)
            for name, value in vars(self).items()
        }

    def observation(self, row: int) -> EllipsoidSet:
        """Returns the ellipsoids of one of the F observations."""
        there = np.isfinite(self.p_WO[row]).all(axis=1)
        return EllipsoidSet(
            stamp=float(self.observation_stamp[row]),
            p_WO=self.p_WO[row][there],
            R_WO=self.R_WO[row][there],
            semi_axes=self.semi_axes[row][there],
            v_WO=self.v_WO[row][there],
            ids=self.obstacle_id[row][there],
        )


def pack_ellipsoids(frames: Sequence[EllipsoidSet]) -> dict[str, Any]:
    """Packs F sets into attributes of a log, NaN (names: -1) where one has fewer than M.

    Returns:
        `observation_stamp`, `p_WO`, `R_WO`, `semi_axes`, `v_WO` and `obstacle_id`.
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
    """Packs the logged signals (T, 2) of the ports `decision` into attributes of a log.

    Returns:
        `decision_time`, `decision_latency` and `decision_layer`.
    """
    found = []
    for name, rows in signals.items():
        if name.startswith(DECISION_SIGNAL):
            begun = np.unique(rows[np.isfinite(rows).all(axis=1)], axis=0)
            found += [(*row, name.removeprefix(DECISION_SIGNAL)) for row in begun.tolist()]
    times, costs, layers = zip(*sorted(found), strict=True) if found else [()] * 3
    return {
        "decision_time": np.array(times),
        "decision_latency": np.array(costs),
        "decision_layer": layers,
    }


def save_logs(path: Path, logs: dict[str, MotionLog]) -> None:
    """Writes motions into one archive in one piece.

    Raises:
        OutputError: if the file cannot be written.
    """
    arrays = {
        f"{name}/{key}": value for name, log in logs.items() for key, value in log.arrays().items()
    }
    replace_arrays(path, {**arrays, _SCHEMA_KEY: SCHEMA_VERSION})


def load_logs(path: Path) -> dict[str, MotionLog]:
    """Reads a file of `save_logs`.

    Raises:
        OSError: if the file cannot be opened.
        ValueError: if it is not such an archive, is damaged, is of another schema, or lacks a key.
    """
    try:
        return _motions(read_arrays(path))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path} is not a motion log, or is damaged: {error}") from None


def _motions(arrays: Mapping[str, np.ndarray]) -> dict[str, MotionLog]:
    motions = [key.removesuffix("/stop_reason") for key in arrays if key.endswith("/stop_reason")]
    if not motions:
        raise ValueError("it has no key MOTION/stop_reason")
    version = int(arrays.get(_SCHEMA_KEY, 1))
    if version != SCHEMA_VERSION:
        made_by = arrays.get(f"{motions[0]}/versions", np.array(["an earlier version"]))
        reader = " ".join(str(made_by[0]).split()[:2])
        raise ValueError(
            f"it has schema {version}, this version of drake_oa reads schema {SCHEMA_VERSION}: "
            f"read it with {reader}, or run the scenario again"
        )
    logs = {}
    for motion in motions:
        found = {
            item.name: _value(arrays[f"{motion}/{item.name}"])
            for item in fields(MotionLog)
            if f"{motion}/{item.name}" in arrays
        }
        logs[motion] = MotionLog(**found)
    return logs


def _value(array: np.ndarray) -> Any:
    """Returns the attribute of an array in a file."""
    if array.ndim == 0:
        return array.item()
    return tuple(array.tolist()) if array.dtype.kind == "U" else array
