"""The methods that can be compared, by name: functions of scenes and a setting.

`verified` is the project's own: a search among roll-outs.

`movement_primitives`: the package of that name, with its own obstacle term. Its `DMP` (10 weights a
dimension, steps of 0.01 s, its compiled Runge-Kutta: all its defaults) imitates the straight
minimum-jerk demonstration and is driven with its `CouplingTermObstacleAvoidance3D` at the published
gains (gamma 1000, beta 20/pi). That term takes the position of a point obstacle: here the
obstacle's center. It knows neither the obstacle's size nor a clearance, and the setting of an
evaluation does not change it. Needs the extra `baselines`: pip install 'drake_oa[baselines]'.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from drake_oa.common.config import check_choice
from drake_oa.common.files import import_extra
from drake_oa.common.messages import EllipsoidSet
from drake_oa.evaluation.scenes.paper_method import run as run_paper
from drake_oa.evaluation.scenes.paper_method import run_original
from drake_oa.evaluation.scenes.scenes import (
    DURATION,
    Motions,
    Scenes,
    Setting,
)
from drake_oa.inference.config import Verified
from drake_oa.planning.point_search import PointSearch
from drake_oa.policy.config import Policy
from drake_oa.policy.dmp import imitate, minimum_jerk
from drake_oa.policy.rollout import Scene

Method = Callable[[Scenes, Setting], Motions]

SAMPLES = 500
"""Intervals in which the motions are handed over."""
LEAST_CLEARANCE = 0.01
"""Clearance where none is requested: the minimum in the paper's training set [m]."""
PARAMETERS = Verified(candidates=64, generations=60, refinement_generations=6, slack=2e-4)
POLICY = Policy(period=DURATION / 500)
DMP = imitate(*minimum_jerk(np.zeros(3), (1.0, 0.0, 0.0), duration=DURATION))


def run_verified(scenes: Scenes, setting: Setting) -> Motions:
    """Decides once for each scene, from rest, and follows the motion that was verified.

    Args:
        scenes: N scenes.
        setting: without `constrained`, `LEAST_CLEARANCE` is kept; without `scale_time`
            tau is 1.

    Returns:
        The motions, from rest until they have arrived.
    """
    clearance = scenes.clearance if setting.constrained else np.full(len(scenes), LEAST_CLEARANCE)
    duration = np.empty(len(scenes))
    path, velocity = np.empty((2, len(scenes), SAMPLES + 1, 3))
    still = np.zeros((1, 3))
    for row, baseline in enumerate(scenes.baseline.tolist()):
        one = slice(row, row + 1)
        shape = scenes.center[one], scenes.R[one], scenes.semi_axes[one]
        seen = EllipsoidSet(0.0, *shape, still, np.arange(1))
        at_rest = still[0], still[0], scenes.goal[row], np.eye(3)
        scene = Scene(*at_rest, baseline, seen, clearance[one])
        search = PointSearch(scene, dmp=DMP, policy=POLICY, parameters=PARAMETERS)
        found = search.run()
        length = float(found.length[0]) / baseline
        tau = max(1.0, length) if setting.scale_time else 1.0
        tool = search.tool_paths(found.params[:1])
        taken = int(tool.steps[0]) + 1
        s = tool.ds * np.arange(taken)
        spline = CubicHermiteSpline(s, tool.path[0, :taken], tool.velocity[0, :taken])
        at = np.linspace(0.0, s[-1], SAMPLES + 1)
        path[row], velocity[row] = spline(at), spline(at, 1) / (DURATION * tau)
        duration[row] = DURATION * tau * s[-1]
    return Motions(path, velocity, duration)


STEP = 0.01
"""The package's default step [s]."""


def run_movement_primitives(scenes: Scenes, setting: Setting) -> Motions:
    """Computes the package's motion in N scenes; the setting does not change it.

    Raises:
        ValueError: if the package is not installed.
    """
    N, steps = len(scenes), round(DURATION / STEP)
    path, velocity = np.zeros((2, N, steps + 1, 3))
    package = import_extra("movement_primitives.dmp", "baselines")
    for row in range(N):
        term = package.CouplingTermObstacleAvoidance3D(scenes.center[row].copy())
        dmp = package.DMP(n_dims=3, execution_time=DURATION, dt=STEP)
        goal = (float(scenes.baseline[row]), 0.0, 0.0)
        demonstrated, t = minimum_jerk((0.0, 0.0, 0.0), goal, duration=DURATION, samples=steps + 1)
        dmp.imitate(t, demonstrated)
        p, v = np.zeros(3), np.zeros(3)
        for step in range(steps):
            p, v = dmp.step(p, v, coupling_term=term)
            path[row, step + 1], velocity[row, step + 1] = p, v
    return Motions(path, velocity, np.full(N, DURATION))


METHODS: dict[str, Method] = {
    "paper": run_paper,
    "verified": run_verified,
    "original": run_original,
    "movement_primitives": run_movement_primitives,
}
"""Methods by name."""


def load_methods(names: Sequence[str]) -> dict[str, Method]:
    """Returns the methods by name.

    Raises:
        ValueError: for an unknown name, or one whose package is not installed.
    """
    check_choice("method", METHODS, *names)
    if "movement_primitives" in names:
        import_extra("movement_primitives.dmp", "baselines")
    return {name: METHODS[name] for name in names}
