"""Demonstrated motions of a scenario: functions that read them from files, average them, and fit
movement primitives to the average.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from drake_oa.common.config import ScenarioError, field_errors
from drake_oa.common.files import package_file, read_arrays
from drake_oa.common.messages import FloatArray
from drake_oa.policy.averaging import average_orientations, average_paths
from drake_oa.policy.config import Policy
from drake_oa.policy.dmp import (
    Dmp,
    OrientationDmp,
    checked_demonstration,
    checked_rotations,
    imitate,
    imitate_orientation,
)
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.task import MAX_DURATION, Task

MAX_SAMPLES = 1_000_000
"""Maximum number of samples in a demonstration file; a longer CSV file is rejected before it is
read completely."""
_NPZ_FORMAT = (
    "it must be an .npz with `path` (T, 3), optionally `t` (T,), and optionally the "
    "orientations R_WE as `quaternion` (T, 4), w first, or `R` (T, 3, 3)"
)
"""Description of the valid arrays in an .npz demonstration file, a part of error messages."""
_QUATERNION_COLUMNS = ("qw", "qx", "qy", "qz")
"""Names of the columns of a CSV demonstration that contain the quaternion of the tool's
orientation, w first."""
_HEADER = "x,y,z in any order, optionally with t, and optionally with qw,qx,qy,qz"
"""Description of the valid column names in a CSV demonstration file, a part of error messages."""
_CSV_FORMAT = (
    f"it must be a CSV whose first line names its columns, {_HEADER}, and every other line has a "
    "number for each of them"
)
"""Description of the valid content of a CSV demonstration file, a part of error messages."""


@dataclass(frozen=True, eq=False)
class Demonstration:
    """One demonstrated motion of the tool, as read from a file.

    Attributes:
        path: (T, 3) positions of the tool point in the world [m].
        t: (T,) times of the samples [s].
        orientations: (T, 3, 3) rotation matrices R_WE of the tool frame E in the world; None if the
            file has no orientations.
    """

    path: FloatArray
    t: FloatArray
    orientations: FloatArray | None = None


def read_demonstration(file: str | Path, duration: float = 5.0) -> Demonstration:
    """Reads and checks one demonstration file.

    Args:
        file: .npz file with the array `path` (T, 3), positions in the world [m]; optionally the
            times `t` (T,) [s]; and optionally the orientations R_WE of the tool frame in the world,
            as `quaternion` (T, 4), w first, of any sign and length, or as `R` (T, 3, 3). Or .csv
            file whose header names the columns x, y, z, and optionally t, and qw, qx, qy, qz. May
            be a package://drake_oa/ URL.
        duration: duration of the motion if the file has no times; the samples are then evenly
            spaced in time [s].

    Raises:
        ValueError: if the file does not exist or cannot be read, or no movement primitive can be
            fitted to it; the message names the invalid sample or the valid format.
    """
    path = package_file(str(file))
    is_csv = path.suffix.lower() == ".csv"
    try:
        arrays = _read_csv(path) if is_csv else _read_archive(path)
    except (OSError, ValueError) as error:
        raise ValueError(
            f"cannot read it: {error}; {_CSV_FORMAT if is_csv else _NPZ_FORMAT}"
        ) from None
    try:
        return _check_arrays(arrays, duration)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{error}{'; sample 0 is line 2' if is_csv else ''}") from None


def read_demonstrations(task: Task) -> list[Demonstration]:
    """Reads the demonstration files of `task.demonstration`.

    Raises:
        ScenarioError: naming the file, if it cannot be read, if no movement primitive can be fitted
            to it, or if it has no orientations while other files have them.
    """
    demonstrations = []
    for file in task.demonstration:
        with field_errors(f"task.demonstration: '{file}'", ValueError, OSError):
            demonstrations.append(read_demonstration(file, task.duration))
    has_orientations = [item.orientations is not None for item in demonstrations]
    if any(has_orientations) and not all(has_orientations):
        file = task.demonstration[has_orientations.index(False)]
        raise ScenarioError(
            f"task.demonstration: '{file}' has no orientations, other files have; state "
            "orientations in all files or in none"
        )
    return demonstrations


def demonstrated_path(scenario: Scenario) -> Dmp:
    """Fits a position movement primitive to the demonstrated tool paths of a scenario, averaged
    over its files.

    Raises:
        ScenarioError: naming the files, if a movement primitive cannot be fitted to them.
    """
    demonstrations, policy = read_demonstrations(scenario.task), scenario.policy
    with field_errors(_file_field(scenario.task), ValueError):
        path, t = average_paths(
            [item.path for item in demonstrations],
            [item.t for item in demonstrations],
            n_basis=policy.n_basis,
        )
        return imitate(path, t, **primitive_constants(policy))


def demonstrated_orientation(scenario: Scenario) -> OrientationDmp | None:
    """Fits an orientation movement primitive to the demonstrated tool orientations of a scenario.

    The orientations are averaged over the files. The result is None if no file has orientations.

    Raises:
        ScenarioError: naming the files, if a movement primitive cannot be fitted to them.
    """
    demonstrations, policy = read_demonstrations(scenario.task), scenario.policy
    samples = [
        (item.orientations, item.t) for item in demonstrations if item.orientations is not None
    ]
    if not samples:
        return None
    with field_errors(_file_field(scenario.task), ValueError):
        R_WE, t = average_orientations(*zip(*samples, strict=True), n_basis=policy.n_basis)
        return imitate_orientation(R_WE, t, **primitive_constants(policy))


def primitive_constants(policy: Policy) -> dict[str, Any]:
    """Returns the constants that the position and the orientation primitive share, as keyword
    arguments of the functions that fit them.

    They are the number of basis functions, the gains alpha_x and beta_x of the transformation
    system, and the rate alpha_k of the phase.
    """
    names = ("n_basis", "alpha_x", "beta_x", "alpha_k")
    return {name: getattr(policy, name) for name in names}


def _file_field(task: Task) -> str:
    """Returns the name of the field `task.demonstration` with the task's file names, as the
    beginning of error messages.
    """
    return f"task.demonstration: {', '.join(map(repr, task.demonstration))}"


def _read_archive(path: Path) -> dict[str, FloatArray]:
    """Reads those of the arrays `path`, `t`, `quaternion` and `R` that an .npz demonstration file
    contains, by name.

    Raises:
        ValueError: if the file has no `path`.
    """
    arrays = read_arrays(path)
    if "path" not in arrays:
        raise ValueError("it has no `path`")
    return {name: arrays[name] for name in ("path", "t", "quaternion", "R") if name in arrays}


def _read_csv(path: Path) -> dict[str, FloatArray]:
    """Reads a CSV demonstration file into arrays with the names and shapes of an .npz
    demonstration: `path`, `t`, `quaternion`.

    Raises:
        ValueError: if the header or a number is invalid.
    """
    with path.open(encoding="utf-8-sig") as file:
        header = file.readline(1000).strip()
        names = [name.strip() for name in header.split(",")]
        known = ("x y z", "t x y z", "x y z qw qx qy qz", "t x y z qw qx qy qz")
        if sorted(names) not in [sorted(columns.split()) for columns in known]:
            raise ValueError(f"its first line is {header[:80]!r}")
        if not (lines := list(islice(file, MAX_SAMPLES + 1))):
            raise ValueError("it has no line after the header")
        table = np.loadtxt(lines, delimiter=",", ndmin=2)
    column = dict(zip(names, table.T, strict=True))
    groups = {"path": tuple("xyz"), "quaternion": _QUATERNION_COLUMNS}
    arrays = {
        field: np.stack([column[name] for name in group], axis=1)
        for field, group in groups.items()
        if group[0] in column
    }
    if "t" in column:
        arrays["t"] = column["t"]
    return arrays


def _check_arrays(arrays: dict[str, FloatArray], duration: float) -> Demonstration:
    """Checks the arrays of a demonstration file and returns them as a demonstration.

    Args:
        arrays: arrays by name: positions `path` (T, 3) [m], and optionally times `t` (T,) [s] and
            orientations R_WE of the tool, `quaternion` (T, 4), w first, or `R` (T, 3, 3).
        duration: duration of a motion without times [s].

    Raises:
        ValueError: if a movement primitive cannot be fitted to the arrays.
    """
    path = arrays["path"]
    if path.ndim != 2 or path.shape[1] != 3:
        raise ValueError(f"its path has shape {path.shape}; {_NPZ_FORMAT}")
    if len(path) > MAX_SAMPLES:
        raise ValueError(
            f"it has more than {MAX_SAMPLES} samples, which is {MAX_SAMPLES // 1000} s at 1 kHz: "
            "cut it, or reduce its sampling rate"
        )
    rotations = [arrays[name] for name in ("quaternion", "R") if name in arrays]
    if len(rotations) > 1:
        raise ValueError("it has both `quaternion` and `R`; remove one of the two arrays")
    t = arrays["t"] if "t" in arrays else np.linspace(0.0, duration, len(path))
    path, t = checked_demonstration(path, t)
    if not t[-1] - t[0] <= MAX_DURATION:
        raise ValueError(
            f"its times span {t[-1] - t[0]:g} s, at most {MAX_DURATION:g}: they must be in seconds"
        )
    if rotations and np.shape(rotations[0])[:1] != (len(path),):
        count = np.shape(rotations[0])[:1]
        raise ValueError(
            f"it has {len(path)} positions and {count[0] if count else 'no'} orientations; "
            f"{_NPZ_FORMAT}"
        )
    return Demonstration(path, t, checked_rotations(rotations[0]) if rotations else None)
