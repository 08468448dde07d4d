"""How long verified regulation takes online, for `drake_oa.benchmark.benchmark`."""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass, replace

import numpy as np

from drake_oa.common.messages import FloatArray
from drake_oa.geometry.ellipsoid import signed_distance
from drake_oa.policy.coupling import CouplingTerms
from drake_oa.policy.coupling_kernels import ALPHA, NORMAL
from drake_oa.policy.dmp import Dmp, step
from drake_oa.regulation.regressor import ChainWeights, load_chain
from drake_oa.regulation.rollout import (
    SpatialRollouts,
    SpatialScenes,
    default_dmp,
    spatial_rollouts,
)
from drake_oa.regulation.search import Search, roll_out
from drake_oa.regulation.verification import N_GENES, SearchParameters, avoidance_terms, verify
from drake_oa.scenario.loading import package_file
from drake_oa.studies.scenes.scenes import DURATION
from drake_oa.studies.scenes.suites import draw_scenes
from drake_oa.studies.scenes.verified import WEIGHTS, spatial_scenes

CANDIDATES = 64
"""Motions that are rolled out at once."""
OBSTACLES = 6
"""Of a scene of the suite `clutter`."""
CLEARANCE = 0.15
"""Asked of each [m]."""
MID_MOTION = 0.4
"""Normalised time from which the candidates are rolled out."""
_NOISE = 1e-3
"""Standard deviation of what a frame changes of the centres [m]."""


@dataclass(frozen=True)
class VerificationTimings:
    """Wall times of one run [ms].

    Attributes:
        rollouts: 64 candidates in one scene with 6 ellipsoids, from mid-motion until they
            arrive or the horizon ends; median.
        steps: how many steps a candidate takes of that on average.
        readable: the same by `readable_rollout`, scaled up from the first of them.
        readable_rows: how many those were.
        first: the whole decision for a motion from rest; median over the scenes.
        first_worst: the slowest of them.
        first_rollouts: median number of roll-outs of such a decision.
        frame: the whole decision at mid-motion when a frame has moved the obstacles a
            little, beginning with what is in use; median.
        frame_worst: the slowest of them.
        frame_rollouts: median number of roll-outs of such a decision.
        scenes: number of scenes.
        kept: in how many of them the first decision keeps the feasible clearance.
    """

    rollouts: float
    steps: float
    readable: float
    readable_rows: int
    first: float
    first_worst: float
    first_rollouts: float
    frame: float
    frame_worst: float
    frame_rollouts: float
    scenes: int
    kept: int


def time_verification(
    scenes: int = 20, repeats: int = 50, readable_rows: int = 4, seed: int = 0
) -> VerificationTimings:
    """Times decisions in scenes of the suite `clutter`, one scene at a time.

    Args:
        scenes: how many.
        repeats: how often the candidates are rolled out.
        readable_rows: how many of them by the readable reference, at most 64.
        seed: of the scenes and of what frames change.

    Returns:
        The times.

    Raises:
        ValueError: if a number is out of range.
    """
    if scenes < 1 or repeats < 1 or not 1 <= readable_rows <= CANDIDATES:
        raise ValueError(
            f"scenes and repeats must be positive and readable_rows from 1 to {CANDIDATES}, "
            f"not {scenes}, {repeats} and {readable_rows}"
        )
    rng = np.random.default_rng(seed)
    posed = spatial_scenes(draw_scenes("clutter", scenes, seed), CLEARANCE)
    weights, parameters = load_chain(package_file(WEIGHTS)), SearchParameters()
    first, later, counts, more, kept = [], [], [], [], 0
    # Compiles, or loads.
    verify(posed.rows([0]), weights, duration=DURATION, parameters=parameters)
    middle = posed.rows([0])
    for i in range(scenes):
        scene = posed.rows([i])
        begun = time.perf_counter()
        found = verify(scene, weights, duration=DURATION, parameters=parameters)
        first.append(time.perf_counter() - begun)
        counts.append(found.rollouts)
        kept += bool(found.kept[0])
        moved = under_way(scene, found.terms, parameters)
        if i == 0:
            middle = moved
        moved = replace(moved, p_WO=moved.p_WO + rng.normal(0.0, _NOISE, moved.p_WO.shape))
        begun = time.perf_counter()
        found = verify(
            moved, weights, duration=DURATION, previous=found.genes, parameters=parameters
        )
        later.append(time.perf_counter() - begun)
        more.append(found.rollouts)
    terms = candidates(middle, weights, parameters)
    times, rolled = [], candidate_rollouts(middle, terms, parameters)
    for _ in range(repeats):
        begun = time.perf_counter()
        rolled = candidate_rollouts(middle, terms, parameters)
        times.append(time.perf_counter() - begun)
    begun = time.perf_counter()
    for row in terms[:readable_rows]:
        readable_rollout(middle, row[0], parameters)
    readable = time.perf_counter() - begun
    steps = rolled.steps
    return VerificationTimings(
        rollouts=1e3 * statistics.median(times),
        steps=float(steps.mean()),
        # Rows differ in length: a step is what is alike.
        readable=1e3 * readable * float(steps.sum() / steps[:readable_rows].sum()),
        readable_rows=readable_rows,
        first=1e3 * statistics.median(first),
        first_worst=1e3 * max(first),
        first_rollouts=statistics.median(counts),
        frame=1e3 * statistics.median(later),
        frame_worst=1e3 * max(later),
        frame_rollouts=statistics.median(more),
        scenes=scenes,
        kept=kept,
    )


def under_way(
    scene: SpatialScenes, terms: FloatArray, parameters: SearchParameters
) -> SpatialScenes:
    """One scene at `MID_MOTION` of the motion bent by a term (1, 13)."""
    motion = spatial_rollouts(
        scene,
        [0],
        terms[:, None],
        steps=parameters.steps,
        end=MID_MOTION,
        fade=parameters.fade,
        keep_path=True,
    )
    return replace(scene, p_WE=motion.path[:, -1], z_W=motion.velocity[:, -1], s=MID_MOTION)


def candidates(
    scene: SpatialScenes, weights: ChainWeights, parameters: SearchParameters
) -> FloatArray:
    """The terms (64, 1, 13) of the motions that a decision begins with."""
    previous = np.full((1, N_GENES), np.nan)
    genes, _ = Search(scene, DURATION, None, previous, parameters).proposals(weights)
    return avoidance_terms(scene, np.zeros(CANDIDATES, dtype=np.int64), genes[0])


def candidate_rollouts(
    scene: SpatialScenes, terms: FloatArray, parameters: SearchParameters
) -> SpatialRollouts:
    """Rolls candidates out as a decision does, each to its end."""
    rows = np.zeros(len(terms), dtype=np.int64)
    return roll_out(scene, rows, terms, parameters, seconds=DURATION)


def readable_rollout(
    scene: SpatialScenes, term: FloatArray, parameters: SearchParameters, dmp: Dmp | None = None
) -> tuple[FloatArray, float]:
    """One candidate by the readable NumPy functions of the action level.

    Args:
        scene: one scene whose obstacles rest.
        term: (13,) its avoidance term.
        parameters: steps, fade, tolerance and horizon.
        dmp: the primitive; None: a straight minimum-jerk motion.

    Returns:
        (n + 1, 3) positions [m], and the least distance to an obstacle at them [m].
    """
    dmp = default_dmp() if dmp is None else dmp
    p, z, k = scene.p_WE[0], scene.z_W[0], float(dmp.phase(scene.s))
    goal, baseline = scene.p_WG[0], float(scene.baseline[0])
    plain = _coupling(term, 1.0)
    path = [p]
    earliest = round((1.0 - scene.s) * parameters.steps)
    for count in range(1, round((parameters.horizon - scene.s) * parameters.steps) + 1):
        left = float(np.linalg.norm(goal - p)) / baseline
        near = left < parameters.fade
        coupling = _coupling(term, (left / parameters.fade) ** 4) if near else plain
        p, z, k = step(
            dmp,
            p,
            z,
            k,
            1.0 / parameters.steps,
            goal,
            frame=scene.R_WL[0],
            baseline=baseline,
            turn=coupling.turn,
        )
        path.append(p)
        arrived = np.linalg.norm(goal - p) < parameters.tolerance
        if count >= earliest and arrived and np.linalg.norm(z) < 20.0 * parameters.tolerance:
            break
    points = np.array(path)
    return points, float(
        signed_distance(points[:, None], scene.p_WO[0], scene.R_WO[0], scene.semi_axes[0]).min()
    )


def _coupling(term: FloatArray, fade: float) -> CouplingTerms:
    return CouplingTerms(
        term[None, :3],
        term[None, ALPHA : ALPHA + 3] * (fade, 1.0, 1.0),
        normal_W=term[None, NORMAL : NORMAL + 3],
        in_plane=True,
    )
