"""Methods of obstacle avoidance for synthetic scenes by name: functions of scenes and a setting.

`verified`: this project's method for a point, a search among simulated candidate motions.

`paper` and `original`: see `drake_oa.evaluation.scenes.paper_method`.

`movement_primitives`: the package of that name. Its `DMP`, with default parameters (10 weights per
dimension, steps of 0.01 s, compiled Runge-Kutta integration), imitates the straight minimum-jerk
demonstration. It is executed with the package's `CouplingTermObstacleAvoidance3D` at the published
gains (gamma 1000, beta 20/pi). That term avoids a point, here the obstacle's center.
The obstacle's size and the setting, including the requested clearance, have no effect. The method
requires the extra `baselines`: pip install 'drake_oa[baselines]'.
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
from drake_oa.evaluation.scenes.scenes import DURATION, Motions, Scenes, Setting
from drake_oa.inference.config import Verified
from drake_oa.planning.point_search import PointSearch
from drake_oa.policy.config import Policy
from drake_oa.policy.dmp import imitate, minimum_jerk
from drake_oa.policy.rollout import Scene

Method = Callable[[Scenes, Setting], Motions]
"""Method of obstacle avoidance: function from N scenes and a setting to a motion for each scene.

The setting is the requested clearance, and whether the duration is multiplied by the temporal
scaling tau, which grows with the length of the avoiding path."""

SAMPLES = 500
"""Number of equal time intervals in which the method `verified` samples its motions."""
MIN_CLEARANCE = 0.01
"""Clearance that the method `verified` requires in settings without a requested clearance [m].

It is the minimum clearance in the training set of Pairet et al., RA-L 2019."""
PARAMETERS = Verified(candidates=64, generations=60, refinement_generations=6, slack=2e-4)
"""Parameters of the search by the method `verified` for a motion in a synthetic scene."""
POLICY = Policy(period=DURATION / 500)
"""Configuration of the movement primitive of the method `verified` in synthetic scenes.

The time step is 1/500 of the demonstrated duration."""
DMP = imitate(*minimum_jerk(np.zeros(3), (1.0, 0.0, 0.0), duration=DURATION))
"""Movement primitive of the method `verified`, learned from a straight minimum-jerk motion."""


def run_verified(scenes: Scenes, setting: Setting) -> Motions:
    """Computes a motion for each scene by this project's search among roll-outs (simulations).

    Args:
        scenes: N scenes.
        setting: if not `constrained` (without a requested clearance), the required clearance is
            `MIN_CLEARANCE`. With `scale_time`, the duration is scaled by the length of the path
            over that of the straight line, at least 1.

    Returns:
        The motions, from rest until arrival at the goal.
    """
    clearance = scenes.clearance if setting.constrained else np.full(len(scenes), MIN_CLEARANCE)
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
        result = search.run()
        length = float(result.length[0]) / baseline
        tau = max(1.0, length) if setting.scale_time else 1.0
        tool = search.tool_paths(result.params[:1])
        count = int(tool.steps[0]) + 1
        s = tool.ds * np.arange(count)
        spline = CubicHermiteSpline(s, tool.path[0, :count], tool.velocity[0, :count])
        at = np.linspace(0.0, s[-1], SAMPLES + 1)
        path[row], velocity[row] = spline(at), spline(at, 1) / (DURATION * tau)
        duration[row] = DURATION * tau * s[-1]
    return Motions(path, velocity, duration)


STEP = 0.01
"""Time step with which motions of the package movement_primitives are computed, its default [s]."""


def run_movement_primitives(scenes: Scenes, setting: Setting) -> Motions:
    """Computes a motion for each scene by the package movement_primitives.

    Args:
        scenes: N scenes.
        setting: setting, which has no effect.

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
"""Name of a method of obstacle avoidance -> function that computes its motions."""


def load_methods(names: Sequence[str]) -> dict[str, Method]:
    """Returns the methods of obstacle avoidance with given names, and checks their packages.

    Args:
        names: keys of `METHODS`.

    Returns:
        Name of a method -> function that computes its motions.

    Raises:
        ValueError: if a name is unknown, or the package of a method is not installed.
    """
    check_choice("method", METHODS, *names)
    if "movement_primitives" in names:
        import_extra("movement_primitives.dmp", "baselines")
    return {name: METHODS[name] for name in names}
