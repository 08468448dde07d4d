"""The log of one motion, and its file.

The file is a NumPy .npz archive of schema `SCHEMA_VERSION`: the key `schema_version`
holds that number, and each motion has one key "MOTION/ATTRIBUTE" for every attribute
of `MotionLog`, where MOTION is "preplanned" or "modulated". Texts are string arrays,
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
speed_scale            (T,)           1        share of full speed that the supervisor leaves, in
                                               [0, 1]; 1 without one
tracking_error         (T,)           m        distance of E to where it was asked to be,
                                               as the controller tells it; NaN where none does
q_world                (T, n)         rad, m   all positions of the station's plant, in its
                                               order; (T, 0) where only the robot moves
observation_time       (F,)           s        times at which observations arrived
observation_stamp      (F,)           s        when the scene looked as they say; inf for
                                               ellipsoids that are given
p_WO                   (F, M, 3)      m        centres of the ellipsoids; NaN rows where an
                                               observation has fewer than M
R_WO                   (F, M, 3, 3)   1        their orientations, principal axes in columns
semi_axes              (F, M, 3)      m        their semi-axes
v_WO                   (F, M, 3)      m/s      velocities of their centres
obstacle_id            (F, M)         -        their names; -1 where there is none
out_of_range           (F,)           1        for how many of them the regressor chain was
                                               asked for more than it was trained for
regulation             ()             text     "Verified" or "Paper"; "" unmodulated
shortfall              (T,)           m        what the verified motion lacked of the
                                               feasible clearance, as regulation believed
event_time             (E,)           s        times at which a note of the policy changed
event                  (E,)           text     those notes; "": running freely again
supervision_time       (S,)           s        times at which the supervisor changed its mind
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
modulated              ()             bool     whether the motion was bent round obstacles
scenario               ()             text     the scenario as YAML, defaults included
seed                   ()             1        the scenario's seed
versions               (P,)           text     packages, date, source digest: "name value"
goal                   (T, 3)         m        where the goal was; (0, 3) where a file of before
                                               it was logged has none
desired_orientation    (T, 4)         1        quaternion w, x, y, z of R_WE asked of the
                                               controller; (0, 4) where it stays
orientation_error      (T, 3)         rad      rotation vector from the actual to the desired
                                               orientation in W; (0, 3) likewise
desired_posture        (T, 2n)        rad,     arm positions, then velocities, that the null space
                                      rad/s    was drawn to; (T, 0) where none was planned
evasion                (T, 3)         m/s      velocity of the tool point out of the way of what
                                               moves; (0, 3) where nothing watches for it
lowered                (T,)           m        by how much regulation had lowered the asked
                                               clearance; (0,) where a file does not tell
motion_end             ()             s        when the motion ended; the world goes on after it
                                               until all is at rest; NaN where a file does not tell
settled                ()             bool     whether all came to rest
decision_time          (D,)           s        when decisions began; (0,) where a file does
                                               not tell, or they cost no time
decision_cost          (D,)           s        the simulated time that each takes
decision_layer         (D,)           text     whose it is: "regulation" or "evasion"
event_hold             (E,)           text     what held the motion from then on, one of `HoldCause`
ended                  ()             text     how the motion ended, one of `MotionEnd`
=====================  =============  =======  ==========================================
"""

from __future__ import annotations

import math
import zipfile
import zlib
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from drake_oa.common.files import check_archive, replace_file
from drake_oa.common.messages import DECIDING, EllipsoidSet, FloatArray, HoldCause, IntArray

SCHEMA_VERSION = 2
"""Of the files that are written and read; a file without one is of schema 1."""

_SCHEMA_KEY = "schema_version"
_LATER = frozenset(
    {
        "goal",
        "desired_orientation",
        "orientation_error",
        "desired_posture",
        "evasion",
        "lowered",
        "motion_end",
        "settled",
        "decision_time",
        "decision_cost",
        "decision_layer",
        "event_hold",
        "ended",
    }
)
"""Attributes with defaults, or found from others, which files of this schema may lack."""

_COUNTED = {
    "t": "t q v torque saturated p_WE desired_position desired_velocity desired_acceleration "
    "phase speed_scale tracking_error q_world shortfall lowered goal "
    "desired_orientation orientation_error desired_posture evasion",
    "observation_time": "observation_stamp p_WO R_WO semi_axes v_WO obstacle_id out_of_range",
    "event_time": "event event_hold",
    "supervision_time": "supervision_action supervision_reason",
    "decision_time": "decision_cost decision_layer",
}
"""Attribute -> those that have as many rows."""
_POINTS = frozenset({"p_WE", "desired_position", "desired_velocity", "goal", "p_WO", "semi_axes"})
_FINITE = ("t", "q", "q_world", "p_WE", "desired_position", "desired_velocity", "phase")
"""Attributes without which nothing can be shown."""


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
    STUCK = "stuck"
    """It stood still short of the goal."""
    TIME_LIMIT = "time limit"
    CUT_SHORT = "cut short"
    """Interrupted, or something was raised."""


@dataclass(frozen=True, eq=False)
class MotionLog:
    """What happened in one motion: T instants, F observations of up to M obstacles.

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
    observation_time: FloatArray
    observation_stamp: FloatArray
    p_WO: FloatArray
    R_WO: FloatArray
    semi_axes: FloatArray
    v_WO: FloatArray
    obstacle_id: IntArray
    out_of_range: IntArray
    regulation: str
    shortfall: FloatArray
    event_time: FloatArray
    event: tuple[str, ...]
    supervision_time: FloatArray
    supervision_action: tuple[str, ...]
    supervision_reason: tuple[str, ...]
    position_name: tuple[str, ...]
    position_lower: FloatArray
    position_upper: FloatArray
    velocity_limit: FloatArray
    actuator_name: tuple[str, ...]
    effort_limit: FloatArray
    stop_reason: str
    wall_time: float
    modulated: bool
    scenario: str
    seed: int
    versions: tuple[str, ...] = field(default=())
    goal: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    desired_orientation: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))
    orientation_error: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    desired_posture: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    evasion: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    lowered: FloatArray = field(default_factory=lambda: np.zeros(0))
    motion_end: float = math.nan
    settled: bool = False
    decision_time: FloatArray = field(default_factory=lambda: np.zeros(0))
    decision_cost: FloatArray = field(default_factory=lambda: np.zeros(0))
    decision_layer: tuple[str, ...] = ()
    event_hold: tuple[str, ...] = ()
    ended: str = ""

    @property
    def simulated_time(self) -> float:
        """Until all was at rest, or the run was ended [s]."""
        return float(self.t[-1]) if len(self.t) else 0.0

    @property
    def duration(self) -> float:
        """Of the motion, to its end [s]."""
        return self.simulated_time if math.isnan(self.motion_end) else self.motion_end

    @property
    def moving(self) -> slice:
        """The instants of the motion, without what came after its end."""
        return slice(int(np.searchsorted(self.t, self.duration, side="right")))

    def arrays(self) -> dict[str, np.ndarray]:
        """Every attribute as an array, as it goes into a file."""
        return {item.name: _as_array(getattr(self, item.name)) for item in fields(self)}

    def observation(self, row: int) -> EllipsoidSet:
        """What was seen in one of the F observations."""
        there = np.isfinite(self.p_WO[row]).all(axis=1)
        return EllipsoidSet(
            stamp=float(self.observation_stamp[row]),
            p_WO=self.p_WO[row][there],
            R_WO=self.R_WO[row][there],
            semi_axes=self.semi_axes[row][there],
            v_WO=self.v_WO[row][there],
            ids=self.obstacle_id[row][there],
        )


def _as_array(value: Any) -> np.ndarray:
    return np.array(value, dtype=str) if isinstance(value, tuple) else np.asarray(value)


def pack_ellipsoids(frames: list[EllipsoidSet]) -> dict[str, Any]:
    """F sets as the attributes of a log, NaN (names: -1) where one has fewer than M.

    Returns:
        `observation_stamp`, `p_WO`, `R_WO`, `semi_axes`, `v_WO` and `obstacle_id`.
    """
    count, most = len(frames), max((len(frame) for frame in frames), default=0)
    packed = {
        "p_WO": np.full((count, most, 3), np.nan),
        "R_WO": np.full((count, most, 3, 3), np.nan),
        "semi_axes": np.full((count, most, 3), np.nan),
        "v_WO": np.full((count, most, 3), np.nan),
    }
    names = np.full((count, most), -1, dtype=np.int64)
    for row, frame in enumerate(frames):
        for name, array in packed.items():
            array[row, : len(frame)] = getattr(frame, name)
        names[row, : len(frame)] = frame.ids
    stamp = np.array([frame.stamp for frame in frames], dtype=float)
    return {"observation_stamp": stamp, **packed, "obstacle_id": names}


def save_logs(path: Path, logs: dict[str, MotionLog]) -> None:
    """Writes motions into one archive; an earlier file stays whole until this one is."""
    arrays = {
        f"{name}/{key}": value for name, log in logs.items() for key, value in log.arrays().items()
    }
    arrays[_SCHEMA_KEY] = np.asarray(SCHEMA_VERSION)

    def write(beside: Path) -> None:
        with beside.open("wb") as file:
            np.savez_compressed(file, **arrays)  # type: ignore[arg-type]

    replace_file(path, write)


def load_logs(path: Path) -> dict[str, MotionLog]:
    """Reads what `save_logs` wrote.

    Raises:
        OSError: if there is no such file, or it cannot be read.
        ValueError: if it is no such archive, is damaged, is of another schema, or its
            arrays do not go together or hold a pose that is no finite number.
    """
    with path.open("rb") as file:
        try:
            archive = np.load(file, allow_pickle=False)
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise ValueError("it is one array, no .npz archive")
            check_archive(path)
            return _motions(path, archive)
        except _RefusedError:
            raise
        except (
            EOFError,
            KeyError,
            OSError,
            TypeError,
            ValueError,
            zipfile.BadZipFile,
            zlib.error,
        ) as error:
            # np.load takes what is no archive for a pickle.
            why = "it is no .npz archive" if "pickle" in str(error) else str(error)
            raise ValueError(f"{path} is not a motion log, or is damaged: {why}") from None


class _RefusedError(ValueError):
    """An archive that can be read, but is no motion log of this schema."""


def _motions(path: Path, archive: Any) -> dict[str, MotionLog]:
    files = archive.files
    names = [item.name for item in fields(MotionLog)]
    motions = [key.removesuffix("/stop_reason") for key in files if key.endswith("/stop_reason")]
    if not motions:
        raise _RefusedError(f"{path} is not a motion log: it has no key MOTION/stop_reason")
    version = int(archive[_SCHEMA_KEY]) if _SCHEMA_KEY in files else 1
    if version != SCHEMA_VERSION:
        age = "older" if version < SCHEMA_VERSION else "newer"
        raise _RefusedError(
            f"{path} is a log of schema {version}, {age} than the {SCHEMA_VERSION} that this "
            "version of drake_oa reads; run the scenario again, or take the version named in "
            "the log's versions"
        )
    logs = {}
    for motion in motions:
        missing = [name for name in names if f"{motion}/{name}" not in files]
        if not _LATER.issuperset(missing):
            raise _RefusedError(f"{path} is not a motion log: '{motion}' lacks {missing}")
        there = [name for name in names if name not in missing]
        logs[motion] = MotionLog(**{n: _read(archive[f"{motion}/{n}"]) for n in there})
        logs[motion] = _with_causes(logs[motion])
        _check_motion(f"{path}: {motion}", logs[motion])
    return logs


def _with_causes(log: MotionLog) -> MotionLog:
    """With the causes that an older file has only in words."""
    holds, ended = log.event_hold, log.ended
    if not holds:
        holds = tuple(_hold_of(note) for note in log.event)
    if not ended:
        ends = (end for end in MotionEnd if log.stop_reason.startswith(end))
        # The longest: "goal" begins "goal missed", too.
        ended = max(ends, key=len, default=MotionEnd.CUT_SHORT)
    return replace(log, event_hold=holds, ended=ended)


def _hold_of(note: str) -> HoldCause:
    if note.startswith("supervisor: "):
        return HoldCause.SUPERVISOR
    return {"": HoldCause.NONE, DECIDING: HoldCause.DECIDING}.get(note, HoldCause.OBSTACLES)


def _check_motion(where: str, log: MotionLog) -> None:
    """Raises _RefusedError for what neither Drake nor matplotlib would name."""
    arrays = log.arrays()
    for counter, names in _COUNTED.items():
        rows = len(arrays[counter])
        for name in names.split():
            shape = arrays[name].shape
            if shape[:1] != (rows,) and not (name in _LATER and shape[:1] == (0,)):
                raise _RefusedError(
                    f"{where}/{name} must have a row for each of the {rows} of {counter}; its "
                    f"shape is {shape}"
                )
            if name in _POINTS and (len(shape) < 2 or shape[-1] != 3):
                raise _RefusedError(f"{where}/{name} must hold x, y, z [m]; its shape is {shape}")
    for name in _FINITE:
        bad = ~np.isfinite(arrays[name]).all(axis=tuple(range(1, arrays[name].ndim)))
        if bad.any():
            row = int(bad.argmax())
            raise _RefusedError(f"{where}/{name} must be finite; in row {row} it is not")
    if (np.diff(log.t) < 0.0).any():
        raise _RefusedError(f"{where}/t must not fall [s]")


def _read(array: np.ndarray) -> Any:
    if array.ndim == 0:
        return array.item()
    return tuple(array.tolist()) if array.dtype.kind == "U" else array
