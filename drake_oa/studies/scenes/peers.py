"""The method `movement_primitives`: the package of that name, with its own obstacle term.

Its `DMP` (10 weights a dimension, steps of 0.01 s, its compiled Runge-Kutta: all its
defaults) imitates the straight minimum-jerk demonstration and is driven with its
`CouplingTermObstacleAvoidance3D` at the published gains (gamma 1000, beta 20/pi). That term
takes the position of a point obstacle: here the obstacle's centre, one term an obstacle,
summed. (The paper by Ijspeert et al. that it follows speaks of the nearest point as well;
the package's interface and its examples have centres.) It knows neither the obstacle's
size nor a clearance, and no scaling of the duration: the setting of an evaluation does not
change it.

Needs the extra `peers`: pip install 'drake_oa[peers]'.
"""

from __future__ import annotations

from importlib import import_module
from time import perf_counter
from typing import Any

import numpy as np

from drake_oa.common.messages import FloatArray
from drake_oa.policy.dmp import minimum_jerk
from drake_oa.studies.scenes.methods import Motions, Setting
from drake_oa.studies.scenes.scenes import DURATION, Scenes

# The package does not name pytransform3d as a dependency, but imports it.
_package: Any = import_module("movement_primitives.dmp")

STEP = 0.01
"""The package's default step [s]."""


class _Obstacles:
    """Its obstacle terms, summed, as one coupling term of its own kind."""

    def __init__(self, center: FloatArray, velocity: FloatArray) -> None:
        self._center = center
        self._velocity = velocity
        self._terms = [_package.CouplingTermObstacleAvoidance3D(row.copy()) for row in center]

    def move(self, t: float) -> None:
        """Puts the centres where they are at time t [s]."""
        for term, center, velocity in zip(self._terms, self._center, self._velocity, strict=True):
            term.obstacle_position = center + t * velocity

    def coupling(self, y: FloatArray, yd: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Velocity and acceleration that the package adds, at position y and velocity yd."""
        total = np.zeros(3)
        for term in self._terms:
            total += term.coupling(y, yd)[1]
        return np.zeros(3), total


def run(scenes: Scenes, setting: Setting) -> Motions:
    """The package's motion in N scenes; the setting does not change it."""
    N, steps = len(scenes), round(DURATION / STEP)
    path, velocity = np.zeros((2, N, steps + 1, 3))
    begin = perf_counter()
    for row in range(N):
        there = scenes.present[row]
        obstacles = _Obstacles(scenes.center[row, there], scenes.velocity[row, there])
        dmp = _imitated(float(scenes.baseline[row]))
        p, v = np.zeros(3), np.zeros(3)
        for step in range(steps):
            obstacles.move(step * STEP)
            p, v = dmp.step(p, v, coupling_term=obstacles)
            path[row, step + 1], velocity[row, step + 1] = p, v
    return Motions(path, velocity, np.full(N, DURATION), perf_counter() - begin)


def _imitated(baseline: float) -> Any:
    """The package's DMP of the straight minimum-jerk motion along x."""
    path, t = minimum_jerk(
        (0.0, 0.0, 0.0),
        (baseline, 0.0, 0.0),
        duration=DURATION,
        samples=round(DURATION / STEP) + 1,
    )
    dmp = _package.DMP(n_dims=3, execution_time=DURATION, dt=STEP)
    dmp.imitate(t, path)
    return dmp
