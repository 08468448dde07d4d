"""The log of one motion, and its file.

The file is a NumPy .npz archive; the keys are the attributes of `MotionLog`, and
texts are zero-dimensional string arrays. It can be read with `numpy.load` alone.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from drake_oa.values import EllipsoidSet, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class MotionLog:
    """What happened in one motion: T instants, F observations of up to M obstacles.

    Attributes:
        t: (T,) time [s].
        q: (T, nq) positions of the robot [rad, m]; (T, 0) without a robot.
        v: (T, nv) velocities of the robot.
        torque: (T, nu) actuation applied [N m, N].
        saturated: (T,) 1 where a torque limit was reached.
        desired_position: (T, 3) p_WE asked of the controller [m].
        desired_velocity: (T, 3) [m/s].
        desired_acceleration: (T, 3) [m/s^2].
        phase: (T,) canonical phase k.
        observation_stamp: (F,) stamps of the observations [s].
        p_WO: (F, M, 3) centres of the ellipsoids [m]; NaN rows where there are fewer.
        R_WO: (F, M, 3, 3) their orientations.
        semi_axes: (F, M, 3) their semi-axes [m].
        out_of_range: (F,) for how many of them the regressor chain was asked for more
            than it was trained for.
        regulation: what the coupling parameters came from, "Verified" or "Regressor"; ""
            without modulation.
        shortfall: (T,) what the verified motion lacked of the feasible clearance [m]; 0
            where it was kept, or nothing was verified.
        short_of: (T,) name of the obstacle that it lacked it to; -1: none.
        event_time: (E,) times at which a note of the policy changed [s].
        event: (E,) those notes; "" is "running freely again".
        stop_reason: why the motion ended: "goal", or what stopped it short.
        wall_time: seconds of real time the simulation took.
        modulated: whether the motion was bent round obstacles.
        scenario: the scenario as YAML, defaults included.
        seed: the scenario's seed.
        versions: packages and commit, "name version" each.
    """

    t: FloatArray
    q: FloatArray
    v: FloatArray
    torque: FloatArray
    saturated: FloatArray
    desired_position: FloatArray
    desired_velocity: FloatArray
    desired_acceleration: FloatArray
    phase: FloatArray
    observation_stamp: FloatArray
    p_WO: FloatArray
    R_WO: FloatArray
    semi_axes: FloatArray
    out_of_range: IntArray
    regulation: str
    shortfall: FloatArray
    short_of: IntArray
    event_time: FloatArray
    event: tuple[str, ...]
    stop_reason: str
    wall_time: float
    modulated: bool
    scenario: str
    seed: int
    versions: tuple[str, ...] = field(default=())

    @property
    def duration(self) -> float:
        """Simulated time [s]."""
        return float(self.t[-1]) if len(self.t) else 0.0

    def arrays(self) -> dict[str, np.ndarray]:
        """Every attribute as an array, as it goes into a file."""
        return {item.name: np.asarray(getattr(self, item.name)) for item in fields(self)}


def pack_ellipsoids(
    frames: list[EllipsoidSet],
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Stamps, centres, orientations and semi-axes of F sets, NaN where one has fewer."""
    most = max((len(frame) for frame in frames), default=0)
    stamp = np.array([frame.stamp for frame in frames], dtype=float)
    centre = np.full((len(frames), most, 3), np.nan)
    rotation = np.full((len(frames), most, 3, 3), np.nan)
    axes = np.full((len(frames), most, 3), np.nan)
    for row, frame in enumerate(frames):
        count = len(frame)
        centre[row, :count] = frame.p_WO
        rotation[row, :count] = frame.R_WO
        axes[row, :count] = frame.semi_axes
    return stamp, centre, rotation, axes


def save_logs(path: Path, logs: dict[str, MotionLog]) -> None:
    """Writes motions into one archive; keys are "<name>/<attribute>"."""
    arrays = {
        f"{name}/{key}": value for name, log in logs.items() for key, value in log.arrays().items()
    }
    with path.open("wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def load_logs(path: Path) -> dict[str, MotionLog]:
    """Reads what `save_logs` wrote.

    Raises:
        ValueError: if the file is not such an archive; names what is missing.
    """
    names = [item.name for item in fields(MotionLog)]
    with np.load(path) as archive:
        motions = dict.fromkeys(key.partition("/")[0] for key in archive.files)
        logs = {}
        for motion in motions:
            missing = [name for name in names if f"{motion}/{name}" not in archive.files]
            if missing:
                raise ValueError(f"{path} is not a motion log: '{motion}' lacks {missing}")
            values: dict[str, Any] = {n: _read(archive[f"{motion}/{n}"]) for n in names}
            logs[motion] = MotionLog(**values)
    return logs


def _read(array: np.ndarray) -> object:
    if array.ndim == 0:
        return array.item()
    return tuple(array.tolist()) if array.dtype.kind == "U" else array
