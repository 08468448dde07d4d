"""Demonstrated motions of a scenario: read from their files, and averaged."""

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
from drake_oa.scenario.task import LONGEST, Task

MOST_SAMPLES = 1_000_000
"""Files of more are refused before they are read whole."""
_CONTENTS = (
    "it must be an .npz with `path` (T, 3), optionally `t` (T,), and optionally the "
    "orientations R_WE as `quaternion` (T, 4), w first, or `R` (T, 3, 3)"
)
_TURN = ("qw", "qx", "qy", "qz")
_HEADER = "x,y,z in any order, optionally with t, and optionally with qw,qx,qy,qz"
_CSV = (
    f"it must be a CSV whose first line names its columns, {_HEADER}, and every other line has a "
    "number for each of them"
)


@dataclass(frozen=True, eq=False)
class Demonstration:
    """One demonstrated motion.

    Attributes:
        path: (T, 3) positions [m].
        t: (T,) stamps [s].
        orientations: (T, 3, 3) R_WE; None: the file has none.
    """

    path: FloatArray
    t: FloatArray
    orientations: FloatArray | None = None


def read_demonstration(file: str | Path, duration: float = 5.0) -> Demonstration:
    """Reads one demonstration.

    Args:
        file: .npz with `path` (T, 3), optionally `t` (T,), and optionally `quaternion` (T, 4), w
            first, of any sign and length, or `R` (T, 3, 3); or .csv whose header names columns of
            t, x, y, z, qw, qx, qy, qz. May be a package:// URL.
        duration: what it spans where it has no stamps [s].

    Raises:
        ValueError: if it cannot be read, or not imitated; says what is wrong at which sample, and
            what it must be.
        OSError: if there is none.
    """
    path = package_file(str(file))
    is_csv = path.suffix.lower() == ".csv"
    try:
        arrays = _of_csv(path) if is_csv else _of_archive(path)
    except (OSError, ValueError) as error:
        raise ValueError(f"cannot read it: {error}; {_CSV if is_csv else _CONTENTS}") from None
    try:
        return _checked(arrays, duration)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{error}{'; sample 0 is line 2' if is_csv else ''}") from None


def read_demonstrations(task: Task) -> list[Demonstration]:
    """Reads the files of `task.demonstration`.

    Raises:
        ScenarioError: naming the file, if it cannot be read or imitated; or if some have
            orientations and some have none.
    """
    shown = []
    for file in task.demonstration:
        with field_errors(f"task.demonstration: '{file}'", ValueError, OSError):
            shown.append(read_demonstration(file, task.duration))
    turning = [item.orientations is not None for item in shown]
    if any(turning) and not all(turning):
        file = task.demonstration[turning.index(False)]
        raise ScenarioError(
            f"task.demonstration: '{file}' has no orientations, others have; give them in all or "
            "in none"
        )
    return shown


def demonstrated_path(scenario: Scenario) -> Dmp:
    """Makes the movement primitive of the demonstrated positions.

    Raises:
        ScenarioError: naming the files, if they cannot be imitated.
    """
    shown, policy = read_demonstrations(scenario.task), scenario.policy
    with field_errors(_files(scenario.task), ValueError):
        path, t = average_paths(
            [item.path for item in shown], [item.t for item in shown], n_basis=policy.n_basis
        )
        return imitate(path, t, **primitive_constants(policy))


def demonstrated_orientation(scenario: Scenario) -> OrientationDmp | None:
    """Makes the movement primitive of the demonstrated orientations; None: there are none.

    Raises:
        ScenarioError: naming the files, if they cannot be imitated.
    """
    shown, policy = read_demonstrations(scenario.task), scenario.policy
    given = [(item.orientations, item.t) for item in shown if item.orientations is not None]
    if not given:
        return None
    with field_errors(_files(scenario.task), ValueError):
        R_WE, t = average_orientations(*zip(*given, strict=True), n_basis=policy.n_basis)
        return imitate_orientation(R_WE, t, **primitive_constants(policy))


def primitive_constants(policy: Policy) -> dict[str, Any]:
    """Returns the constants that position and orientation share."""
    names = ("n_basis", "alpha_x", "beta_x", "alpha_k")
    return {name: getattr(policy, name) for name in names}


def _files(task: Task) -> str:
    return f"task.demonstration: {', '.join(map(repr, task.demonstration))}"


def _of_archive(path: Path) -> dict[str, FloatArray]:
    """Returns the arrays of an .npz that are of a demonstration."""
    arrays = read_arrays(path)
    if "path" not in arrays:
        raise ValueError("it has no `path`")
    return {name: arrays[name] for name in ("path", "t", "quaternion", "R") if name in arrays}


def _of_csv(path: Path) -> dict[str, FloatArray]:
    """Returns the columns of a CSV, as an .npz would have them."""
    with path.open(encoding="utf-8-sig") as file:
        header = file.readline(1000).strip()
        names = [name.strip() for name in header.split(",")]
        known = ("x y z", "t x y z", "x y z qw qx qy qz", "t x y z qw qx qy qz")
        if sorted(names) not in [sorted(columns.split()) for columns in known]:
            raise ValueError(f"its first line is {header[:80]!r}")
        table = np.loadtxt(islice(file, MOST_SAMPLES + 1), delimiter=",", ndmin=2)
    column = dict(zip(names, table.T, strict=True))
    groups = {"path": tuple("xyz"), "quaternion": _TURN}
    found = {
        field: np.stack([column[name] for name in group], axis=1)
        for field, group in groups.items()
        if group[0] in column
    }
    if "t" in column:
        found["t"] = column["t"]
    return found


def _checked(arrays: dict[str, FloatArray], duration: float) -> Demonstration:
    """Returns the arrays of a file as a demonstration that can be imitated."""
    path = arrays["path"]
    if path.ndim != 2 or path.shape[1] != 3:
        raise ValueError(f"its path is {path.shape}; {_CONTENTS}")
    if len(path) > MOST_SAMPLES:
        raise ValueError(
            f"it has more than {MOST_SAMPLES} samples, which is {MOST_SAMPLES // 1000} s at 1 kHz: "
            "cut it, or keep every so many"
        )
    given = [arrays[name] for name in ("quaternion", "R") if name in arrays]
    if len(given) > 1:
        raise ValueError("it has both `quaternion` and `R`; leave one of the two out")
    t = arrays["t"] if "t" in arrays else np.linspace(0.0, duration, len(path))
    path, t = checked_demonstration(path, t)
    if not t[-1] - t[0] <= LONGEST:
        raise ValueError(
            f"its stamps span {t[-1] - t[0]:g} s, at most {LONGEST:g}: they must be in seconds"
        )
    if given and np.shape(given[0])[:1] != (len(path),):
        count = np.shape(given[0])[:1]
        raise ValueError(
            f"it has {len(path)} positions and {count[0] if count else 'no'} orientations; "
            f"{_CONTENTS}"
        )
    return Demonstration(path, t, checked_rotations(given[0]) if given else None)
