"""The methods that can be compared, by name: functions of scenes and a setting.

`verified` is the project's own: a network's proposals, verified by roll-outs.

`movement_primitives`: the package of that name, with its own obstacle term. Its `DMP` (10 weights a
dimension, steps of 0.01 s, its compiled Runge-Kutta: all its defaults) imitates the straight
minimum-jerk demonstration and is driven with its `CouplingTermObstacleAvoidance3D` at the published
gains (gamma 1000, beta 20/pi). That term takes the position of a point obstacle: here the
obstacle's centre, one term an obstacle, summed. (The paper by Ijspeert et al. that it follows
speaks of the nearest point as well; the package's interface and its examples have centres.) It
knows neither the obstacle's size nor a clearance, and no scaling of the duration: the setting of an
evaluation does not change it. Needs the extra `peers`: pip install 'drake_oa[peers]'.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np

from drake_oa.common.messages import FloatArray, IntArray
from drake_oa.policy.dmp import minimum_jerk
from drake_oa.regulation.config import SearchParameters
from drake_oa.regulation.proposal_network import ProposalNetwork, load_proposals
from drake_oa.regulation.search import roll_out, verify
from drake_oa.scenario.shipped import package_file
from drake_oa.studies.scenes.paper_method import run as run_paper
from drake_oa.studies.scenes.paper_method import run_original
from drake_oa.studies.scenes.scenes import (
    DURATION,
    Motions,
    Scenes,
    Setting,
    single_obstacle,
    spatial_scenes,
)

Method = Callable[[Scenes, Setting], Motions]

WEIGHTS = "package://drake_oa/weights/proposals.safetensors"
SAMPLES = 500
"""Intervals in which the motions are handed over."""
LEAST_CLEARANCE = 0.01
"""Kept where no clearance is asked for: what the paper's training set calls free [m]."""
PARAMETERS = SearchParameters()
"""As the running system has them."""


def run_verified(scenes: Scenes, setting: Setting) -> Motions:
    """Decides once for each scene, from rest, and follows the motion that was verified.

    Args:
        scenes: N scenes.
        setting: without `constrained`, `LEAST_CLEARANCE` is kept; without `scale_time`
            tau is 1, which changes the path among moving obstacles only.

    Returns:
        The motions, from rest until they have arrived.
    """
    network = _warmed_up()
    begun = time.perf_counter()
    posed = spatial_scenes(scenes, scenes.clearance if setting.constrained else LEAST_CLEARANCE)
    found = verify(posed, network, duration=DURATION, parameters=PARAMETERS)
    tau = found.tau if setting.scale_time else np.ones(len(scenes))
    rolled = roll_out(
        posed,
        np.arange(len(scenes)),
        found.terms,
        PARAMETERS,
        seconds=DURATION * tau,
        keep_path=True,
    )
    taken = rolled.steps.astype(np.int64)
    path, z = _resampled(rolled.path, rolled.velocity, taken, 1.0 / PARAMETERS.steps)
    return Motions(
        path=path,
        velocity=z / (DURATION * tau)[:, None, None],
        duration=DURATION * tau * taken / PARAMETERS.steps,
        seconds=time.perf_counter() - begun,
        in_range=found.in_range,
    )


def _resampled(
    path: FloatArray, z: FloatArray, taken: IntArray, step: float
) -> tuple[FloatArray, FloatArray]:
    """Cubic Hermite interpolation at `SAMPLES` + 1 instants from the first to the last step."""
    at = taken[:, None] * np.linspace(0.0, 1.0, SAMPLES + 1)
    i = np.minimum(at.astype(np.int64), taken[:, None] - 1)
    u = (at - i)[..., None]
    row = np.arange(len(path))[:, None]
    p0, p1, v0, v1 = path[row, i], path[row, i + 1], step * z[row, i], step * z[row, i + 1]
    a = 2.0 * (p0 - p1) + v0 + v1
    b = 3.0 * (p1 - p0) - 2.0 * v0 - v1
    return p0 + u * (v0 + u * (b + u * a)), (v0 + u * (2.0 * b + 3.0 * u * a)) / step


@cache
def _warmed_up() -> ProposalNetwork:
    """Loads the network and the kernels, so that it does not count as computing time."""
    network = load_proposals(package_file(WEIGHTS))
    scene = spatial_scenes(single_obstacle(1.0, [[0.5, 0.0, 0.0]], [[0.05, 0.05, 0.05]]), 0.05)
    verify(scene, network, duration=DURATION, parameters=replace(PARAMETERS, rounds=1))
    return network


STEP = 0.01
"""The package's default step [s]."""


class _ObstacleTerms:
    """Sum of the package's obstacle terms, as one coupling term of its own kind."""

    def __init__(self, center: FloatArray, velocity: FloatArray) -> None:
        self._center = center
        self._velocity = velocity
        term = _movement_primitives().CouplingTermObstacleAvoidance3D
        self._terms = [term(row.copy()) for row in center]

    def move(self, t: float) -> None:
        """Puts the centres where they are at time t [s]."""
        for term, center, velocity in zip(self._terms, self._center, self._velocity, strict=True):
            term.obstacle_position = center + t * velocity

    def coupling(self, y: FloatArray, yd: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Velocity and acceleration that the package adds, at position y and velocity yd."""
        return np.zeros(3), sum((term.coupling(y, yd)[1] for term in self._terms), np.zeros(3))


def run_movement_primitives(scenes: Scenes, setting: Setting) -> Motions:
    """Computes the package's motion in N scenes; the setting does not change it.

    Raises:
        ValueError: if the package is not installed.
    """
    N, steps = len(scenes), round(DURATION / STEP)
    path, velocity = np.zeros((2, N, steps + 1, 3))
    begin = time.perf_counter()
    for row in range(N):
        there = scenes.present[row]
        obstacles = _ObstacleTerms(scenes.center[row, there], scenes.velocity[row, there])
        dmp = _movement_primitives().DMP(n_dims=3, execution_time=DURATION, dt=STEP)
        goal = (float(scenes.baseline[row]), 0.0, 0.0)
        demonstrated, t = minimum_jerk((0.0, 0.0, 0.0), goal, duration=DURATION, samples=steps + 1)
        dmp.imitate(t, demonstrated)
        p, v = np.zeros(3), np.zeros(3)
        for step in range(steps):
            obstacles.move(step * STEP)
            p, v = dmp.step(p, v, coupling_term=obstacles)
            path[row, step + 1], velocity[row, step + 1] = p, v
    return Motions(path, velocity, np.full(N, DURATION), time.perf_counter() - begin)


def _movement_primitives() -> Any:
    try:
        return import_module("movement_primitives.dmp")
    except ModuleNotFoundError as error:
        # The package does not name pytransform3d as a dependency, but imports it.
        if (error.name or "").partition(".")[0] not in ("movement_primitives", "pytransform3d"):
            raise
        raise ValueError(
            f"method movement_primitives needs the package {error.name}: "
            "pip install 'drake_oa[peers]'"
        ) from error


METHODS: dict[str, Method] = {
    "paper": run_paper,
    "verified": run_verified,
    "original": run_original,
    "movement_primitives": run_movement_primitives,
}
"""Methods by name."""


def load_method(name: str) -> Method:
    """Returns the method of a name.

    Raises:
        ValueError: for an unknown name, or one whose package is not installed.
    """
    if name not in METHODS:
        raise ValueError(f"unknown method {name!r}; valid: {', '.join(METHODS)}")
    if name == "movement_primitives":
        _movement_primitives()
    return METHODS[name]
