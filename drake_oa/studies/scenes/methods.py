"""The methods that can be compared, by name: functions of scenes and a setting.

`verified` is the project's own: a network's proposals, verified by roll-outs.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from drake_oa.common.files import package_file
from drake_oa.common.messages import FloatArray
from drake_oa.planning.point_search import PointSearch
from drake_oa.planning.search import Ranked
from drake_oa.policy.config import Policy
from drake_oa.policy.dmp import imitate, minimum_jerk
from drake_oa.policy.rollout import Scene, ToolRollouts
from drake_oa.regulation.config import Verified
from drake_oa.regulation.proposals import ProposalNetwork, load_proposals
from drake_oa.studies.scenes.paper_method import run as run_paper
from drake_oa.studies.scenes.paper_method import run_original
from drake_oa.studies.scenes.scenes import (
    DURATION,
    Motions,
    Scenes,
    Setting,
    make_scenes,
    posed_scenes,
)

Method = Callable[[Scenes, Setting], Motions]

WEIGHTS = "package://drake_oa/weights/proposals.safetensors"
SAMPLES = 500
"""Intervals in which the motions are handed over."""
LEAST_CLEARANCE = 0.01
"""Kept where no clearance is asked for: what the paper's training set calls free [m]."""
PARAMETERS = Verified(candidates=64, rounds=60, polish=6, slack=2e-4)
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
    network = _warmed_up()
    begun = time.perf_counter()
    clearance = scenes.clearance if setting.constrained else LEAST_CLEARANCE
    duration = np.empty(len(scenes))
    path, velocity = np.empty((2, len(scenes), SAMPLES + 1, 3))
    for row, scene in enumerate(posed_scenes(scenes, clearance)):
        search, found = _searched(scene, network)
        length = float(found.length[0]) / scene.baseline
        tau = max(1.0, length) if setting.scale_time else 1.0
        tool = search.tool_paths(found.genes[:1])
        p, z = _resampled(tool)
        path[row], velocity[row] = p, z / (DURATION * tau)
        duration[row] = DURATION * tau * tool.steps[0] * tool.ds
    return Motions(path, velocity, duration, seconds=time.perf_counter() - begun)


def _searched(scene: Scene, network: ProposalNetwork) -> tuple[PointSearch, Ranked]:
    """Returns the search in a scene, and its result."""
    search = PointSearch(scene, dmp=DMP, policy=POLICY, parameters=PARAMETERS)
    return search, search.run(network.ranked(scene, DURATION))


def _resampled(tool: ToolRollouts) -> tuple[FloatArray, FloatArray]:
    """Returns the first path and z at `SAMPLES` + 1 instants from its first to its last step."""
    taken = int(tool.steps[0])
    s = tool.ds * np.arange(taken + 1)
    spline = CubicHermiteSpline(s, tool.path[0, : taken + 1], tool.velocity[0, : taken + 1])
    at = np.linspace(0.0, s[-1], SAMPLES + 1)
    return spline(at), spline(at, 1)


@cache
def _warmed_up() -> ProposalNetwork:
    """Loads the network and the kernels, so that it does not count as computing time."""
    network = load_proposals(package_file(WEIGHTS))
    scenes = make_scenes(1.0, [[0.5, 0.0, 0.0]], [[0.05, 0.05, 0.05]])
    _searched(posed_scenes(scenes, 0.05)[0], network)
    return network


METHODS: dict[str, Method] = {
    "paper": run_paper,
    "verified": run_verified,
    "original": run_original,
}
"""Methods by name."""


def load_methods(names: Sequence[str]) -> dict[str, Method]:
    """Returns the methods by name.

    Raises:
        ValueError: for an unknown name.
    """
    for name in names:
        if name not in METHODS:
            raise ValueError(f"unknown method {name!r}; valid: {', '.join(METHODS)}")
    return {name: METHODS[name] for name in names}
