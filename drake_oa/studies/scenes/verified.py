"""The project's own method: a network's proposals, verified by roll-outs."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import cache

import numpy as np

from drake_oa.common.messages import FloatArray, IntArray
from drake_oa.regulation.config import SearchParameters
from drake_oa.regulation.proposal_network import ProposalNetwork, load_proposals
from drake_oa.regulation.rollout import SpatialScenes
from drake_oa.regulation.search import roll_out, verify
from drake_oa.scenario.shipped import package_file
from drake_oa.studies.scenes.methods import Motions, Setting
from drake_oa.studies.scenes.scenes import DURATION, Scenes, single_obstacle

WEIGHTS = "package://drake_oa/weights/proposals.safetensors"
SAMPLES = 500
"""Intervals in which the motions are handed over."""
LEAST_CLEARANCE = 0.01
"""Kept where no clearance is asked for: what the paper's training set calls free [m]."""
PARAMETERS = SearchParameters()
"""As the running system has them."""


def run(scenes: Scenes, setting: Setting) -> Motions:
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


def spatial_scenes(scenes: Scenes, clearance: FloatArray | float) -> SpatialScenes:
    """The scenes as roll-outs take them: at rest at the start, L = W.

    Args:
        scenes: N scenes.
        clearance: () or (N,) asked of every obstacle [m].
    """
    count = len(scenes)
    asked = np.broadcast_to(clearance, (count,))
    return SpatialScenes(
        p_WE=np.zeros((count, 3)),
        z_W=np.zeros((count, 3)),
        p_WG=scenes.goal,
        R_WL=np.tile(np.eye(3), (count, 1, 1)),
        baseline=scenes.baseline,
        p_WO=scenes.center,
        R_WO=scenes.R,
        semi_axes=scenes.semi_axes,
        v_WO=scenes.velocity,
        asked_clearance=np.repeat(asked[:, None], scenes.center.shape[1], axis=1),
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
