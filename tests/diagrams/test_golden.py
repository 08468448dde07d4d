"""Tests of the shipped scenarios against stored connections and logs (golden files).

`tests/golden` has, for each scenario, the connections of its diagram and the log of its first two
seconds. After an intended change, `GOLDEN=write python -m pytest tests/diagrams/test_golden.py -m
''` replaces the files, and their difference is part of the commit.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import llvmlite.binding as llvm
import numpy as np
import pytest

from drake_oa.common.signal_builder import connections
from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.perception.config import GroundTruth
from drake_oa.runs.motion_log import MotionLog
from drake_oa.runs.simulation import simulate
from drake_oa.safety.maneuvers import ACTIONS
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.shipped import shipped_scenarios

_GOLDEN = Path(__file__).resolve().parents[1] / "golden"
_WRITES = os.environ.get("GOLDEN") == "write"
_SAMPLED = 40
"""Stride of the rows of a time series in a golden file."""
_NOT_COMPARED = "wall_time versions scenario stop_reason ended event_hold motion_end settled"
"""Fields of a log that are not compared."""
_TRUTH = "tabletop_box-truth"
# Models of other packages may have other versions elsewhere.
_OURS = [name for name in shipped_scenarios() if not name.startswith(("gen3_", "ur5e_"))]
_NAMES = [*_OURS, _TRUTH]
# Other processors round differently, and decisions may depend on the last bit.
_PROCESSOR = llvm.get_host_cpu_name() + "," + llvm.get_host_cpu_features().flatten()
_ELSEWHERE = 0.1
"""Compared time of a run on another processor [s]."""


def _scenario(name: str) -> Scenario:
    """Loads a shipped scenario, or `tabletop_box` with ground-truth perception."""
    if name == _TRUTH:
        return replace(load_scenario("tabletop_box"), perception=GroundTruth())
    return load_scenario(name)


@pytest.mark.parametrize("name", _NAMES)
def test_connections_equal_the_golden_file(name: str) -> None:
    diagram = build_avoidance(_scenario(name))
    result = "".join(f"{source} -> {reader}\n" for source, reader in connections(diagram))
    path = _GOLDEN / f"{name}.connections.txt"
    if _WRITES:
        path.write_text(result)
    assert result == path.read_text()


def assert_tool_at_desired_pose(log: MotionLog) -> None:
    """Checks that the arm has the tool at its desired pose while no maneuver is active."""
    is_following = log.guard_action < ACTIONS.index("evade")
    assert log.tracking_error[is_following].max() <= 1e-3
    assert np.linalg.norm(log.orientation_error[is_following], axis=1).max() <= np.radians(0.5)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in shipped_scenarios() if name not in _OURS])
def test_tool_of_other_robots_is_at_its_desired_pose(name: str) -> None:
    assert_tool_at_desired_pose(simulate(load_scenario(name), duration=2.0))


@pytest.mark.slow
@pytest.mark.parametrize("name", _NAMES)
def test_motion_equals_the_golden_log(name: str) -> None:
    scenario = _scenario(name)
    log = simulate(scenario, duration=2.0)
    if not scenario.faults and len(log.guard_action):
        assert_tool_at_desired_pose(log)
    result = {"processor": np.array(_PROCESSOR)}
    for key, value in log.arrays().items():
        if key not in _NOT_COMPARED.split():
            is_series = value.ndim and len(value) == len(log.t)
            result[key] = value[::_SAMPLED] if is_series else value
    path = _GOLDEN / f"{name}.npz"
    if _WRITES:
        np.savez_compressed(path, **result)
    with np.load(path) as archive:
        golden = {key: value for key, value in archive.items() if key not in _NOT_COMPARED.split()}
    assert result.keys() == golden.keys()
    same = str(golden.pop("processor")) == _PROCESSOR
    soon = int(np.sum(golden["t"] <= _ELSEWHERE))
    for key, value in golden.items():
        if same and value.dtype.kind != "f":
            np.testing.assert_array_equal(result[key], value, err_msg=key)
        elif same or (value.ndim and len(value) == len(golden["t"])):
            rows = slice(None) if same or not value.ndim else slice(soon)
            # Not bitwise: a kernel that is compiled elsewhere may round differently.
            rtol, atol = (1e-9, 1e-10) if same else (1e-6, 1e-9)
            one, other = np.atleast_1d(result[key])[rows], np.atleast_1d(value)[rows]
            np.testing.assert_allclose(one, other, rtol=rtol, atol=atol, err_msg=key)
