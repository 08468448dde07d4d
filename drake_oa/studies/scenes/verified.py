"""The project's own method: a network's proposals, verified by roll-outs."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from drake_oa.common.messages import BoolArray, FloatArray, IntArray
from drake_oa.regulation.config import SearchParameters
from drake_oa.regulation.proposal_network import Layers, ProposalNetwork, load_proposals
from drake_oa.regulation.proposals import NO_PRICE, TAU, ChainProposals, Proposer, draws
from drake_oa.regulation.regressor import ChainWeights, load_chain
from drake_oa.regulation.rollout import SpatialScenes
from drake_oa.regulation.search import SearchResult, roll_out, verify
from drake_oa.scenario.shipped import package_file
from drake_oa.studies.scenes.methods import Motions, Setting
from drake_oa.studies.scenes.scenes import DURATION, Scenes, single_obstacle

WEIGHTS = "package://drake_oa/weights/proposals.safetensors"
CHAIN = "package://drake_oa/weights/regressor_chain.safetensors"
SAMPLES = 500
"""Intervals in which the motions are handed over."""
LEAST_CLEARANCE = 0.01
"""Kept where no clearance is asked for: what the paper's training set calls free [m]."""
PARAMETERS = SearchParameters()
"""As the running system has them."""


CONSTANT = {"alpha": 30.0, "psi": 1.4, "kappa": 3.0}
"""What `run_constant` proposes; kappa is kappa L^2."""


def run(scenes: Scenes, setting: Setting) -> Motions:
    """Decides once for each scene, from rest, and follows the motion that was verified.

    Args:
        scenes: N scenes.
        setting: without `constrained`, `LEAST_CLEARANCE` is kept; without `scale_time`
            tau is 1, which changes the path among moving obstacles only.

    Returns:
        The motions, from rest until they have arrived.
    """
    return run_led(scenes, setting, PROPOSERS["trained"]())


def run_constant(scenes: Scenes, setting: Setting) -> Motions:
    """`run` led by a chain that always proposes `CONSTANT`: what the trained networks add."""
    return run_led(scenes, setting, PROPOSERS["constant"]())


def constant_chain(chain: ChainWeights) -> ChainWeights:
    """A chain of the same inputs that gives `CONSTANT` whatever they are."""
    networks = {}
    for target, network in chain.networks.items():
        value = CONSTANT[target]
        handled = math.log(value) if target in chain.log_targets else value
        last = np.full(1, (handled - network.out_offset) * network.out_gain + network.out_min)
        networks[target] = replace(
            network,
            weights=(*network.weights[:-1], np.zeros_like(network.weights[-1])),
            biases=(*network.biases[:-1], last),
        )
    return replace(chain, networks=networks)


@dataclass(frozen=True)
class Anything:
    """Proposes what is drawn all over the ranges of the genes, the same for every scene."""

    spacing: float = 1.5

    def propose(
        self, scenes: SpatialScenes, duration: float, count: int, price: FloatArray = NO_PRICE
    ) -> tuple[FloatArray, BoolArray]:
        """Candidates, see `Proposer`."""
        genes = np.repeat(draws(0, count).fresh[None], len(scenes), axis=0)
        genes[~(np.nan_to_num(scenes.v_WO) != 0.0).any(axis=(1, 2)), :, TAU] = 0.0
        return genes, np.ones(len(scenes), dtype=bool)

    def weigh(self, scenes: SpatialScenes, duration: float) -> dict[str, FloatArray]:
        """Nothing."""
        return {}


def _untrained() -> ProposalNetwork:
    """The shipped network's layers with random matrices as large as its own, and its biases 0."""
    shipped = load_proposals(package_file(WEIGHTS))
    rng = np.random.default_rng(0)
    layers = [
        (rng.standard_normal(one.shape) * one.std() * (one.ndim == 2)).astype(np.float32)
        for one in shipped.layers
    ]
    return replace(shipped, layers=Layers(*layers))


PROPOSERS: dict[str, Callable[[], Proposer]] = {
    "trained": lambda: load_proposals(package_file(WEIGHTS)),
    "chain": lambda: ChainProposals(load_chain(package_file(CHAIN))),
    "constant": lambda: ChainProposals(constant_chain(load_chain(package_file(CHAIN)))),
    "random": _untrained,
    "none": Anything,
}
"""What may lead the search, by name: the network, the chain, the chain with `CONSTANT` for what it
says, the network before any training, and nothing."""


def run_led(
    scenes: Scenes,
    setting: Setting,
    proposer: Proposer,
    parameters: SearchParameters = PARAMETERS,
    *,
    each: bool = False,
) -> Motions:
    """`run`, led by a proposer, as far as parameters say; with `each`, one decision after another.

    With `each`, `Motions.decisions` has what every one took.
    """
    _warm_up()
    begun = time.perf_counter()
    posed = spatial_scenes(scenes, scenes.clearance if setting.constrained else LEAST_CLEARANCE)
    decisions, found = np.zeros(0), None
    if each:
        decisions, results = np.empty(len(scenes)), []
        for row in range(len(scenes)):
            one, since = posed.rows([row]), time.perf_counter()
            results.append(verify(one, proposer, duration=DURATION, parameters=parameters))
            decisions[row] = time.perf_counter() - since
        found = SearchResult.joined(results)
    else:
        found = verify(posed, proposer, duration=DURATION, parameters=parameters)
    tau = found.tau if setting.scale_time else np.ones(len(scenes))
    path, z = np.empty((2, len(scenes), SAMPLES + 1, 3))
    duration = np.empty(len(scenes))
    for steps in np.unique(found.steps):
        rows = np.flatnonzero(found.steps == steps)
        rolled = roll_out(
            posed,
            rows,
            found.terms[rows],
            replace(parameters, steps=int(steps)),
            seconds=DURATION * tau[rows],
            keep_path=True,
        )
        taken = rolled.steps.astype(np.int64)
        path[rows], z[rows] = _resampled(rolled.path, rolled.velocity, taken, 1.0 / steps)
        duration[rows] = DURATION * tau[rows] * taken / steps
    return Motions(
        path=path,
        velocity=z / (DURATION * tau)[:, None, None],
        duration=duration,
        seconds=time.perf_counter() - begun,
        in_range=found.in_range,
        decisions=decisions,
        rollouts=found.rollouts,
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
def _warm_up() -> None:
    """Compiles or loads the kernels, so that it does not count as computing time."""
    scene = spatial_scenes(single_obstacle(1.0, [[0.5, 0.0, 0.0]], [[0.05, 0.05, 0.05]]), 0.05)
    for name in ("trained", "chain"):
        rounds = SearchParameters(rounds=1)
        verify(scene, PROPOSERS[name](), duration=DURATION, parameters=rounds)
