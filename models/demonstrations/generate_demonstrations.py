"""Generates the shipped demonstrations: `python generate_demonstrations.py`.

The script simulates recordings of a Panda that is guided by hand. A hand passes via points with
minimum jerk (Flash and Hogan 1985) at varying speed, with a tremor of about one millimeter at 8 to
12 Hz. The recorder samples at about 100 Hz, at uneven times, loses some samples, and records
quaternions with w >= 0, so that their signs jump. Positions of the tool point E [m] and
orientations R_WE are in the world, whose origin is the Panda's base, z up.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RollPitchYaw
from scipy.interpolate import make_interp_spline

Array = NDArray[np.float64]

FOLDER = Path(__file__).resolve().parent
"""Folder of the generated files."""
RATE = 100.0
"""Mean sampling rate of the recorder [Hz]."""
TREMOR, TILT_TREMOR = 0.7e-3, 0.005
"""Root mean square of the hand's tremor in position [m] and orientation [rad]."""
NOISE = 5e-5
"""Standard deviation of the tool position due to the encoders [m]."""
REST = 0.15
"""Time at rest before and after the motion [s]."""


class Recording(NamedTuple):
    """Parameters of a recorded motion.

    Attributes:
        vias: rows of via points: normalized time, x, y, z [m], roll, pitch, yaw [rad].
        duration: mean duration [s].
        seed: seed of the random numbers.
        repetitions: number of recordings.
        spread: standard deviation of the via points between repetitions [m].
    """

    vias: list[list[float]]
    duration: float
    seed: int
    repetitions: int = 1
    spread: float = 0.0


DOWN = [np.pi, 0.0, np.pi / 2.0]
"""Roll, pitch and yaw of a tool that points down [rad]."""
RECORDINGS = {
    # An arc from one side to the other at nearly constant height, recorded three times.
    "arc": Recording(
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
    # Up, across, and down while the tool turns and tilts.
    "pour": Recording(
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
    # An S-shaped wiping motion above the table.
    "wipe": Recording(
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
"""Parameters of the recorded motions, by name."""


def stamps(duration: float, random: np.random.Generator) -> Array:
    """Returns the times (T,) of the recorder's samples [s], uneven and with missing samples."""
    t = np.arange(0.0, duration, 1.0 / RATE)
    t[1:] += random.uniform(-0.3, 0.3, len(t) - 1) / RATE
    is_sampled = random.random(len(t)) > 0.02
    is_sampled[0] = is_sampled[-1] = True
    return np.asarray(t[is_sampled])


def tremor(t: Array, rms: float, random: np.random.Generator) -> Array:
    """Returns a tremor (T, 3) at times t (T,): sum of waves of 8 to 12 Hz, independent per axis."""
    frequency, phase = random.uniform(8.0, 12.0, (2, 3, 6))
    waves = np.sin(2.0 * np.pi * frequency * t[:, None, None] + 10.0 * phase)
    return np.asarray(rms * waves.sum(axis=2) / np.sqrt(3.0))


def record(recording: Recording, random: np.random.Generator) -> tuple[Array, Array, Array]:
    """Simulates a repetition: times (T,) [s], positions (T, 3) [m], quaternions (T, 4), w first."""
    vias = np.array(recording.vias)
    vias[:, 1:4] += random.normal(0.0, 1.0, (len(vias), 3)) * recording.spread
    duration = recording.duration * random.uniform(0.9, 1.1)
    t = stamps(duration + 2.0 * REST, random)
    s = np.clip((t - REST) / duration, 0.0, 1.0)
    # Vary the speed along the path, with rest at both ends.
    for wave in (1, 2):
        s = s + random.uniform(-0.2, 0.2) / (np.pi * wave**2) * np.sin(np.pi * wave * s) ** 2
    rest = [(1, np.zeros(6)), (2, np.zeros(6))]
    motion = make_interp_spline(vias[:, 0], vias[:, 1:], k=5, bc_type=(rest, rest))(s)
    p = motion[:, :3] + tremor(t, TREMOR, random) + random.normal(0.0, NOISE, (len(t), 3))
    rpy = motion[:, 3:] + tremor(t, TILT_TREMOR, random)
    q = np.array([RollPitchYaw(row).ToQuaternion().wxyz() for row in rpy])
    return t, p, np.where(q[:, :1] < 0.0, -q, q)


def main() -> None:
    """Writes the files: the pouring motion as CSV, the others as .npz."""
    for name, recording in RECORDINGS.items():
        random = np.random.default_rng(recording.seed)
        for repetition in range(1, recording.repetitions + 1):
            t, p, q = (np.round(values, 6) for values in record(recording, random))
            part = f"_{repetition}" if recording.repetitions > 1 else ""
            if name == "pour":
                header = "t,x,y,z,qw,qx,qy,qz"
                table = np.column_stack([t, p, q])
                np.savetxt(FOLDER / "pour.csv", table, "%.6f", ",", header=header, comments="")
            elif name == "arc":
                # Positions only: the robot's configuration block sets the orientation.
                np.savez_compressed(FOLDER / f"{name}{part}.npz", t=t, path=p)
            else:
                np.savez_compressed(FOLDER / f"{name}{part}.npz", t=t, path=p, quaternion=q)


if __name__ == "__main__":
    main()
