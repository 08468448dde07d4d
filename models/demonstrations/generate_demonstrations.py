"""Writes demonstrations as of a hand that leads a Panda: `python generate_demonstrations.py`.

A hand goes through via points with least jerk (Flash and Hogan 1985), now slower and now faster,
and trembles by about a millimeter at 8 to 12 Hz; the recorder takes about 100 samples a second at
uneven times, misses some, and gives quaternions with w >= 0, so that their signs jump. Positions
of the tool point E and orientations R_WE are of the world: the Panda's base, z up [m].
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RollPitchYaw
from scipy.interpolate import make_interp_spline

Array = NDArray[np.float64]

FOLDER = Path(__file__).resolve().parent
RATE = 100.0  # Of the recorder [Hz].
TREMOR, TILT_TREMOR = 0.7e-3, 0.005  # Root mean square [m, rad].
NOISE = 5e-5  # Of the encoders, seen at the tool [m].
REST = 0.15  # Before and after the motion [s].


class Shown(NamedTuple):
    """A motion, its via points in rows: share of the time, x, y, z [m], roll, pitch, yaw [rad]."""

    vias: list[list[float]]
    duration: float
    seed: int
    repetitions: int = 1
    spread: float = 0.0  # Of the via points from one repetition to the next [m].


DOWN = [np.pi, 0.0, np.pi / 2.0]
SHOWN = {
    # Out and round to the other side, at about one height: three times.
    "arc": Shown(
        [
            [0.0, 0.40, -0.42, 0.22, *DOWN],
            [0.27, 0.56, -0.25, 0.27, *DOWN],
            [0.5, 0.62, 0.0, 0.29, *DOWN],
            [0.73, 0.56, 0.25, 0.27, *DOWN],
            [1.0, 0.40, 0.42, 0.22, *DOWN],
        ],
        5.0,
        seed=1,
        repetitions=3,
        spread=0.012,
    ),
    # Up, over, and down while the hand turns and tips what it holds.
    "pour": Shown(
        [
            [0.0, 0.42, -0.38, 0.16, *DOWN],
            [0.22, 0.43, -0.34, 0.36, *DOWN],
            [0.58, 0.50, 0.08, 0.42, np.pi, 0.0, np.pi / 2.0 - 0.25],
            [0.8, 0.50, 0.27, 0.37, np.pi - 0.35, 0.0, np.pi / 2.0 - 0.35],
            [1.0, 0.50, 0.34, 0.32, np.pi - 0.75, 0.0, np.pi / 2.0 - 0.4],
        ],
        5.5,
        seed=2,
    ),
    # An S over the table, as with a cloth.
    "wipe": Shown(
        [
            [0.0, 0.40, -0.35, 0.12, *DOWN],
            [0.25, 0.58, -0.20, 0.115, np.pi, 0.0, np.pi / 2.0 + 0.2],
            [0.5, 0.46, 0.0, 0.12, np.pi, 0.0, np.pi / 2.0],
            [0.75, 0.38, 0.20, 0.115, np.pi, 0.0, np.pi / 2.0 - 0.2],
            [1.0, 0.56, 0.35, 0.12, *DOWN],
        ],
        6.0,
        seed=3,
    ),
}


def stamps(duration: float, random: np.random.Generator) -> Array:
    """(T,) when the recorder took a sample [s]: unevenly, and not always."""
    t = np.arange(0.0, duration, 1.0 / RATE)
    t[1:] += random.uniform(-0.3, 0.3, len(t) - 1) / RATE
    kept = random.random(len(t)) > 0.02
    kept[0] = kept[-1] = True
    return np.asarray(t[kept])


def tremor(t: Array, rms: float, random: np.random.Generator) -> Array:
    """(T, 3) sum of waves of 8 to 12 Hz, each axis for itself."""
    frequency, phase = random.uniform(8.0, 12.0, (2, 3, 6))
    waves = np.sin(2.0 * np.pi * frequency * t[:, None, None] + 10.0 * phase)
    return np.asarray(rms * waves.sum(axis=2) / np.sqrt(3.0))


def show(shown: Shown, random: np.random.Generator) -> tuple[Array, Array, Array]:
    """Stamps (T,) [s], positions (T, 3) [m] and quaternions (T, 4), w first, of one repetition."""
    vias = np.array(shown.vias)
    vias[:, 1:4] += random.normal(0.0, 1.0, (len(vias), 3)) * shown.spread
    duration = shown.duration * random.uniform(0.9, 1.1)
    t = stamps(duration + 2.0 * REST, random)
    s = np.clip((t - REST) / duration, 0.0, 1.0)
    # Now slower and now faster, and at rest at both ends all the same.
    for wave in (1, 2):
        s = s + random.uniform(-0.2, 0.2) / (np.pi * wave**2) * np.sin(np.pi * wave * s) ** 2
    rest = [(1, np.zeros(6)), (2, np.zeros(6))]
    way = make_interp_spline(vias[:, 0], vias[:, 1:], k=5, bc_type=(rest, rest))(s)
    p = way[:, :3] + tremor(t, TREMOR, random) + random.normal(0.0, NOISE, (len(t), 3))
    rpy = way[:, 3:] + tremor(t, TILT_TREMOR, random)
    q = np.array([RollPitchYaw(row).ToQuaternion().wxyz() for row in rpy])
    return t, p, np.where(q[:, :1] < 0.0, -q, q)


def main() -> None:
    """Writes the files: the pouring motion as CSV, the others as .npz."""
    for name, shown in SHOWN.items():
        random = np.random.default_rng(shown.seed)
        for repetition in range(1, shown.repetitions + 1):
            t, p, q = (np.round(values, 6) for values in show(shown, random))
            part = f"_{repetition}" if shown.repetitions > 1 else ""
            if name == "pour":
                header = "t,x,y,z,qw,qx,qy,qz"
                table = np.column_stack([t, p, q])
                np.savetxt(FOLDER / "pour.csv", table, "%.6f", ",", header=header, comments="")
            elif name == "arc":
                # Of positions: the tool is held as the robot's configuration says.
                np.savez_compressed(FOLDER / f"{name}{part}.npz", t=t, path=p)
            else:
                np.savez_compressed(FOLDER / f"{name}{part}.npz", t=t, path=p, quaternion=q)


if __name__ == "__main__":
    main()
