"""Training of the proposal network on the results of the search: `drake-oa train`.

Scenes of ellipsoids are drawn, some of them under way and some moving, and for one side of each the
search looks for the best motion there. The network learns its genes, its length, and whether it
keeps what is asked. Many genes do about equally well, so that what a search finds first lies
scattered along a valley; each further round therefore searches from what the network of the round
before proposes, mostly on the sides that it ranks first (expert iteration: T. Anthony et al.,
NeurIPS 2017).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from joblib import Memory, Parallel, delayed
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from drake_oa.common.compiled import CORES
from drake_oa.common.console import Column, TextTable
from drake_oa.common.files import provenance
from drake_oa.common.messages import BoolArray, EllipsoidSet, FloatArray, IntArray
from drake_oa.planning.point_search import PointSearch, ellipsoid_solids, path_distances
from drake_oa.planning.search import SEARCH
from drake_oa.policy.config import Policy
from drake_oa.policy.dmp import imitate, minimum_jerk
from drake_oa.policy.rollout import Scene
from drake_oa.regulation.config import Verified
from drake_oa.regulation.proposals import (
    ALPHA,
    ANGLE,
    GENE_MEAN,
    GENE_SCALE,
    HALF,
    KAPPA,
    N_GENES,
    N_OBSTACLE,
    N_OUTPUTS,
    N_STATE,
    PLACE,
    PSI,
    Floats32,
    Layers,
    ProposalNetwork,
    describe,
)
from drake_oa.training.networks import Report

DURATION = 3.0
"""T of the motions [s]; only velocities are counted by it."""
MOST = 7
"""Obstacles of a scene at most."""
DMP = imitate(*minimum_jerk(np.zeros(3), (1.0, 0.0, 0.0), duration=DURATION))
_POLICY, _COARSE = Policy(period=DURATION / 250), Policy(period=DURATION / 100)
"""Time steps of the searches, and of the roll-outs by which scenes are chosen."""
_STARTS = 4
"""Proposals of the network that a side is searched from."""
_PLACES, _LOG_ALPHAS = np.meshgrid((0.25, 0.5, 0.75), np.linspace(0.5, 11.5, 5))
_KAPPA, _PSI = 3.0, 1.4
"""Fixed candidates that every side is searched from: places along the baseline [L], ln alpha, and
kappa L^2 and psi [rad] of all."""


_SEARCH: dict[str, Any] = {"candidates": 32, "polish": 4}
"""Parameters of the searches, as of `Verified`."""
_UNDER_WAY, _MOVING = 0.3, 0.2
"""Fractions of the scenes that begin on the way, and in which obstacles move."""
_RATE = 4e-3
"""Maximum step length of AdamW, in one cycle."""


@dataclass(frozen=True)
class ProposalRecipe:
    """Sizes of the data and of the network.

    Attributes:
        scenes: number of scenes in a round.
        chunk: number of scenes that are stored together.
        rounds: number of rounds of searches and training.
        epochs: passes over the rows of a round and the one before.
        batch: number of rows in a step.
        width: of the layers that see one obstacle; those that see all have twice as many.
        search_rounds: rounds of each search, as of `Verified`.
    """

    scenes: int = 50_000
    chunk: int = 2_000
    rounds: int = 5
    epochs: int = 40
    batch: int = 512
    width: int = 64
    search_rounds: int = 8

    @staticmethod
    def short(scenes: int) -> ProposalRecipe:
        """Returns a shorter trial: two rounds of few passes over that many scenes."""
        return ProposalRecipe(scenes, min(scenes, ProposalRecipe.chunk), rounds=2, epochs=5)


class Rows(NamedTuple):
    """N sides of scenes, and what the search found there.

    Attributes:
        each: (N, MOST + 1, 20) descriptors.
        genes: (N, 7) scaled.
        length: (N,) ln of the motion's length over L.
        kept: (N,) whether it keeps what is asked.
    """

    each: Floats32
    genes: Floats32
    length: Floats32
    kept: BoolArray


class SideSearch(PointSearch):
    """Search for motions on the side omega = y_L alone."""

    def bounded(self, genes: FloatArray) -> FloatArray:
        """Returns genes moved into their ranges, and to the side."""
        genes = super().bounded(genes)
        genes[:, ANGLE] = np.clip(genes[:, ANGLE], -HALF, HALF)
        return genes

    def seeded(self, sides: FloatArray) -> tuple[FloatArray, IntArray]:
        """Returns the given candidates."""
        return self.bounded(sides), np.full(len(sides), SEARCH)


def turned(scene: Scene, angle: float) -> Scene:
    """Returns the scene with its frame L turned about x, so that the side at an angle is y_L."""
    return replace(scene, R_WL=scene.R_WL @ Rotation.from_euler("x", angle).as_matrix())


def draw_scene(rng: np.random.Generator, moving: bool) -> Scene:
    """Draws a scene at rest at the start whose nominal motion is too close; L = 1 m, and W = L.

    One to six ellipsoids of semi-axes 0.01 to 0.5, at most half as long along the baseline as it
    is; in a third of the scenes a large flat one besides, like a table. Start and goal are clear.
    """
    nominal = np.zeros((1, N_GENES))
    nominal[:, ALPHA] = -np.inf
    while True:
        scene = _candidate(rng, moving)
        search = PointSearch(scene, dmp=DMP, policy=_COARSE, parameters=Verified())
        goal = path_distances(search.solids, scene.p_WG[None, None], np.zeros(1))
        start = path_distances(search.solids, scene.p_WE[None, None], np.zeros(1))
        if min(start.min(), goal.min()) <= rng.uniform(0.005, 0.08):
            continue
        margin, _ = search.margins(nominal, search.tool_paths(nominal))
        if margin[0] < -search.parameters.slack:
            return scene


def _candidate(rng: np.random.Generator, moving: bool) -> Scene:
    """Draws a scene, which may be too easy or impossible."""
    number = int(rng.choice([1, 1, 1, 2, 3, 4, 5, 6]))
    axes = rng.uniform(0.01, 1.0, (number, 3)) * (0.12 if number > 2 else 0.5)
    R = Rotation.from_quat(rng.standard_normal((number, 4))).as_matrix()
    if rng.random() < 0.3:
        R[:] = np.eye(3)
    center = rng.uniform((0.0, -0.5, -0.5), (1.0, 0.5, 0.5), (number, 3))
    # One of them in the way, the others anywhere.
    center[0, 1:] *= rng.random() ** 2 * (rng.random() < 0.7)
    clearance = np.full(number, 0.15 if rng.random() < 0.5 else rng.uniform(0.02, 0.32))
    velocity = np.zeros((number, 3))
    if moving:
        direction = rng.standard_normal((number, 3))
        velocity = direction / np.linalg.norm(direction, axis=1, keepdims=True)
        velocity *= rng.uniform(0.0, 0.5, (number, 1)) * (rng.random((number, 1)) >= 0.4)
        center -= rng.uniform(0.2, 0.7, (number, 1)) * DURATION * velocity
    if rng.random() < 1.0 / 3.0:
        # A table beneath the baseline, whichever way that is.
        roll = rng.uniform(-np.pi, np.pi)
        down = np.array([0.0, np.cos(roll), np.sin(roll)])
        thick, height = rng.uniform(0.005, 0.05), rng.uniform(0.05, 0.5)
        across = np.cross(down, [1.0, 0.0, 0.0])
        center = np.vstack([center, np.array([0.5, 0.0, 0.0]) + (height + thick) * down])
        R = np.concatenate([R, np.stack([[1.0, 0.0, 0.0], across, down], axis=1)[None]])
        axes = np.vstack([axes, [*rng.uniform(0.6, 1.5, 2), thick]])
        velocity = np.vstack([velocity, np.zeros(3)])
        clearance = np.append(clearance, min(rng.uniform(0.01, 0.2), 0.9 * height))
    seen = EllipsoidSet(0.0, center, R, axes, v_WO=velocity, ids=np.arange(len(center)))
    goal = np.array([1.0, 0.0, 0.0])
    return Scene(np.zeros(3), np.zeros(3), goal, np.eye(3), 1.0, seen, clearance)


def _under_way(scene: Scene, s: float, genes: FloatArray) -> Scene | None:
    """Returns the scene once a motion with genes (7,) has gone on until s; None: too close."""
    search = PointSearch(scene, dmp=DMP, policy=_POLICY, parameters=Verified())
    tool = search.tool_paths(genes[None])
    at = round(s / tool.ds)
    p_WE, z_W, seen = tool.path[0, at], tool.velocity[0, at], scene.ellipsoids
    later = replace(seen, p_WO=seen.p_WO + s * DURATION * seen.v_WO)
    distance = path_distances(ellipsoid_solids(later), p_WE[None, None], np.zeros(1))
    if not distance.min() > 0.01 or not np.isfinite(p_WE).all():
        return None
    return replace(scene, p_WE=p_WE, z_W=z_W, ellipsoids=later, s=at * tool.ds)


def make_rows(count: int, rounds: int, seed: tuple[int, ...], layers: Layers | None) -> Rows:
    """Draws scenes and searches one side of each.

    Args:
        count: number of scenes.
        rounds: of each search.
        seed: of the scenes.
        layers: network of the round before, which proposes candidates besides the fixed ones; None
            in the first round.
    """
    rng, network = np.random.default_rng(seed), None if layers is None else ProposalNetwork(layers)
    rows = [_make_row(rounds, rng, network) for _ in range(count)]
    return Rows(*(np.array(column) for column in zip(*filter(None, rows), strict=True)))


def _make_row(
    rounds: int, rng: np.random.Generator, network: ProposalNetwork | None
) -> tuple[Floats32, Floats32, np.float32, bool] | None:
    """Searches one side of a random scene; None: the nominal motion is the best there."""
    scene = draw_scene(rng, bool(rng.random() < _MOVING))
    if rng.random() < _UNDER_WAY:
        genes = rng.choice(_fixed())
        genes[ANGLE] = rng.uniform(-np.pi, np.pi)
        if rng.random() < 0.3:
            genes[ALPHA] = -np.inf
        elif network is not None:
            # Of another scene.
            genes = network.ranked(draw_scene(rng, False), DURATION)[0]
        scene = _under_way(scene, rng.uniform(0.02, 0.75), genes) or scene
    scene = turned(scene, _side(rng, scene, network))
    first = _fixed()
    if network is not None:
        genes = np.repeat(network.sides(scene, DURATION, np.zeros(1))[0], _STARTS, axis=0)
        genes[:, ALPHA] += np.linspace(-0.8, 1.0, _STARTS)
        first = np.concatenate([genes, first])
    parameters = Verified(rounds=rounds, **_SEARCH)
    found = SideSearch(scene, dmp=DMP, policy=_POLICY, parameters=parameters).run(first)
    if not np.isfinite(found.genes[0, ALPHA]):
        return None
    genes = ((found.genes[0] - GENE_MEAN) / GENE_SCALE).astype(np.float32)
    return described(scene), genes, np.float32(np.log(found.length[0])), found.solved


def described(scene: Scene) -> Floats32:
    """Returns the descriptors (MOST + 1, 20) of a scene from the side y_L.

    NaN for an obstacle that does not exist; the last row is the state alone.
    """
    each, state = describe(scene, DURATION, np.zeros(1))
    rows = np.full((MOST + 1, N_OBSTACLE + N_STATE), np.nan, np.float32)
    rows[: each.shape[1]], rows[-1, N_OBSTACLE:] = each[0], state[0]
    return rows


def _side(rng: np.random.Generator, scene: Scene, network: ProposalNetwork | None) -> float:
    """Draws a side: one of those that the network ranks first, or any [rad]."""
    if network is None or rng.random() < 0.3:
        return float(rng.uniform(-np.pi, np.pi))
    best = rng.choice(network.ranked(scene, DURATION)[:3, ANGLE])
    return float(best + rng.uniform(-1.5, 1.5) * HALF)


def _fixed() -> FloatArray:
    """Returns the fixed candidates (15, 7) on the side y_L."""
    genes = np.zeros((_PLACES.size, N_GENES))
    genes[:, PLACE], genes[:, ALPHA] = _PLACES.ravel(), _LOG_ALPHAS.ravel()
    genes[:, KAPPA], genes[:, PSI] = np.log(_KAPPA), np.log(_PSI)
    return genes


class SetNetwork(nn.Module):
    """The network as torch trains it; `ProposalNetwork` runs it."""

    def __init__(self, width: int) -> None:
        super().__init__()
        n_each, n_all = N_OBSTACLE + N_STATE, 2 * width + N_STATE
        self.each = nn.ModuleList([nn.Linear(n_each, width), nn.Linear(width, width)])
        sizes = (n_all, 2 * width, 2 * width, N_OUTPUTS)
        self.all = nn.ModuleList([nn.Linear(*pair) for pair in pairwise(sizes)])

    def forward(self, rows: Tensor) -> Tensor:
        """Descriptors (N, MOST + 1, 20), NaN for no obstacle -> (N, 9)."""
        obstacles, state = rows[:, :-1], rows[:, -1, N_OBSTACLE:]
        there = ~torch.isnan(obstacles[:, :, :1])
        y = torch.nan_to_num(obstacles)
        for layer in self.each:
            y = torch.relu(layer(y))
        y = torch.where(there, y, torch.zeros(()))
        y = torch.cat([y.sum(dim=1), y.amax(dim=1), state], dim=1)
        for layer in self.all[:-1]:
            y = torch.relu(layer(y))
        return self.all[-1](y)

    def arrays(self) -> Layers:
        """The matrices and biases."""
        found: list[Any] = []
        for layer in (*self.each, *self.all):
            found.append(np.ascontiguousarray(layer.weight.detach().cpu().numpy().T))
            found.append(np.array(layer.bias.detach().cpu().numpy()))
        return tuple(found)


class Scores(NamedTuple):
    """Errors of a network on rows that it has not seen.

    Attributes:
        genes: mean absolute error of the scaled genes, where the requested clearance is kept.
        kept: fraction of the rows for which the network says rightly whether it is.
    """

    genes: float
    kept: float


def _loss(said: Tensor, rows: tuple[Tensor, ...]) -> Tensor:
    """Of genes and length where what is asked was kept, and of whether it was."""
    _, genes, length, kept = rows
    of_genes = nn.functional.smooth_l1_loss(said[:, :N_GENES], genes, reduction="none", beta=0.3)
    of_length = nn.functional.smooth_l1_loss(
        5.0 * said[:, N_GENES], 5.0 * length, reduction="none", beta=0.3
    )
    of_kept = nn.functional.binary_cross_entropy_with_logits(said[:, N_GENES + 1], kept)
    return ((of_genes.mean(dim=1) + 4.0 * of_length) * kept).mean() + of_kept


def fit(
    net: SetNetwork, rows: Rows, recipe: ProposalRecipe, seed: int, device: str, report: Report
) -> Scores:
    """Trains a network on rows, a twentieth of which are kept out; the same seed, the same."""
    tensors = [torch.from_numpy(np.asarray(column, np.float32)).to(device) for column in rows]
    order = torch.from_numpy(np.random.default_rng((seed, 1)).permutation(len(rows.kept)))
    held, used = order[: len(order) // 20], order[len(order) // 20 :]
    generator = torch.Generator().manual_seed(seed)
    adam = torch.optim.AdamW(net.parameters(), lr=_RATE, weight_decay=1e-5)
    batches = max(len(used) // recipe.batch, 1)
    cycle = torch.optim.lr_scheduler.OneCycleLR(adam, _RATE, total_steps=recipe.epochs * batches)
    for epoch in range(recipe.epochs):
        shuffled = used[torch.randperm(len(used), generator=generator)]
        for batch in shuffled.tensor_split(batches):
            part = tuple(column[batch] for column in tensors)
            adam.zero_grad()
            _loss(net(part[0]), part).backward()
            adam.step()
            cycle.step()
        report("train", (epoch + 1) / recipe.epochs)
    with torch.no_grad():
        each, genes, _, kept = (column[held] for column in tensors)
        said, good = net(each), kept > 0.5
        error = (said[good, :N_GENES] - genes[good]).abs().mean()
        right = ((said[:, N_GENES + 1] > 0.0) == good).float().mean()
    return Scores(float(error), float(right))


def train_proposals(
    recipe: ProposalRecipe,
    seed: int,
    folder: Path,
    *,
    device: str = "cpu",
    report: Report = lambda stage, done: None,
) -> tuple[ProposalNetwork, list[Scores]]:
    """Searches, on all cores, and trains, round by round.

    Args:
        recipe: sizes.
        seed: of scenes and first weights.
        folder: of the searches, from which an interrupted training resumes.
        device: where the network is trained.
        report: receives the stage and the completed fraction.

    Returns:
        The network, and its scores after each round.
    """
    torch.manual_seed(seed)
    # Small layers: more threads only wait for each other.
    torch.set_num_threads(1)
    net = SetNetwork(recipe.width).to(device)
    search = delayed(Memory(folder, verbose=0).cache(make_rows))
    before: list[Rows] = []
    scores: list[Scores] = []
    chunks = -(-recipe.scenes // recipe.chunk)
    pool = Parallel(min(CORES, chunks), return_as="generator")
    for number in range(recipe.rounds):
        layers, made = net.arrays() if number else None, list[Rows]()
        seeds = ((seed, number, k) for k in range(chunks))
        for rows in pool(search(recipe.chunk, recipe.search_rounds, s, layers) for s in seeds):
            made.append(rows)
            done = number + len(made) / chunks
            report(f"round {number + 1}: search", done / recipe.rounds)
        rows = Rows(*map(np.concatenate, zip(*before, *made, strict=True)))
        before = made
        scores.append(fit(net, rows, recipe, seed + number, device, report))
    metadata = {
        "recipe": "proposals",
        "seed": seed,
        **provenance(),
        **asdict(recipe),
        "scores": [score._asdict() for score in scores],
    }
    return ProposalNetwork(net.arrays(), metadata), scores


def proposal_table(scores: Sequence[Scores]) -> TextTable:
    """Tabulates the scores of each round."""
    columns = (
        Column("round"),
        Column("genes", "error of scaled genes", "{:.3f}"),
        Column("kept", "clearance predicted", "{:.3f}"),
    )
    rows = [{"round": number, **score._asdict()} for number, score in enumerate(scores, 1)]
    return TextTable(columns, rows, ["on a twentieth of the rows that is held out"])
