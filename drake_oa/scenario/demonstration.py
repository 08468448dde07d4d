"""The demonstrated motion of a scenario, read from its file."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drake_oa.common.config import ScenarioError
from drake_oa.common.files import check_archive
from drake_oa.common.messages import FloatArray
from drake_oa.policy.config import Policy
from drake_oa.policy.orientation_dmp import OrientationDmp, imitate_orientation
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.task import Task

_CONTENTS = (
    "it must be an .npz with `path` (T, 3), optionally `t` (T,), and optionally the "
    "orientations R_WE as `quaternion` (T, 4), w first, or `R` (T, 3, 3)"
)


@dataclass(frozen=True, eq=False)
class Demonstration:
    """What somebody showed.

    Attributes:
        path: (T, 3) positions [m].
        t: (T,) stamps [s].
        orientations: (T, 4) quaternions or (T, 3, 3) rotation matrices R_WE; None: the file
            has none.
    """

    path: FloatArray
    t: FloatArray
    orientations: FloatArray | None


def read_demonstration(task: Task) -> Demonstration:
    """Reads the file of `task.demonstration`.

    Raises:
        ScenarioError: naming the file, if it cannot be read or holds something else.
    """
    try:
        check_archive(Path(task.demonstration))
        with np.load(task.demonstration) as archive:
            path = archive["path"]
            t = archive["t"] if "t" in archive.files else None
            given = [archive[name] for name in ("quaternion", "R") if name in archive.files]
        if path.ndim != 2 or path.shape[1] != 3:
            raise ValueError(f"its path is {path.shape}")
        if len(given) > 1:
            raise ValueError("it has both `quaternion` and `R`")
        if given and len(given[0]) != len(path):
            raise ValueError(f"it has {len(path)} positions and {len(given[0])} orientations")
        stamps = np.linspace(0.0, task.duration, len(path)) if t is None else t
        return Demonstration(path, stamps, given[0] if given else None)
    except (OSError, EOFError, KeyError, ValueError, TypeError, zipfile.BadZipFile) as error:
        raise ScenarioError(
            f"task.demonstration: cannot read '{task.demonstration}': {error}; {_CONTENTS}"
        ) from None


def demonstrated_orientation(scenario: Scenario) -> OrientationDmp | None:
    """The movement primitive of the demonstrated orientations; None: there are none.

    Raises:
        ScenarioError: naming the file, if they cannot be imitated.
    """
    task, policy = scenario.task, scenario.policy
    if not task.demonstration:
        return None
    shown = read_demonstration(task)
    if shown.orientations is None:
        return None
    try:
        return imitate_orientation(shown.orientations, shown.t, **primitive_constants(policy))
    except ValueError as error:
        raise ScenarioError(f"task.demonstration: '{task.demonstration}': {error}") from None


def primitive_constants(policy: Policy) -> dict[str, Any]:
    """What position and orientation are both learnt with."""
    names = ("n_basis", "alpha_x", "beta_x", "alpha_k")
    return {name: getattr(policy, name) for name in names}
