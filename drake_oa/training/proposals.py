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
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from drake_oa.common.console import Column, TextTable
from drake_oa.common.files import provenance
from drake_oa.common.messages import BoolArray, FloatArray
from drake_oa.geometry.ellipsoid import signed_distance
from drake_oa.policy.coupling import N_COLUMNS
from drake_oa.regulation.config import SearchParameters
from drake_oa.regulation.proposal_network import (
    GENE_MEAN,
    GENE_SCALE,
    HALF,
    N_OBSTACLE,
    N_OUTPUTS,
    N_STATE,
    Floats32,
    Layers,
    ProposalNetwork,
    descriptors,
)
from drake_oa.regulation.proposals import (
    ALPHA,
    ANGLE,
    KAPPA,
    LOWER,
    N_GENES,
    NO_PRICE,
    PLACE,
    PSI,
    UPPER,
    avoidance_terms,
)
from drake_oa.regulation.rollout import SpatialScenes
from drake_oa.regulation.search import Search, SearchResult, roll_out
from drake_oa.training.checkpoint import Checkpoint, Report

DURATION = 3.0
"""T of the motions [s]; only velocities are counted by it."""
MOST = 7
"""Obstacles of a scene at most."""
_COARSE = SearchParameters(steps=100)
"""Roll-outs by which scenes are chosen."""
_STARTS = 4
"""Proposals of the network that a side is searched from."""
_PLACES, _LOG_ALPHAS = np.meshgrid((0.25, 0.5, 0.75), np.linspace(0.5, 11.5, 5))
_KAPPA, _PSI = 3.0, 1.4
"""Fixed candidates that every side is searched from: places along the baseline [L], ln alpha, and
kappa L^2 and psi [rad] of all."""


@dataclass(frozen=True)
class ProposalRecipe:
    """How the data is made and the network trained.

    Attributes:
        scenes: scenes of a round.
        chunk: scenes that are searched at once, all at the same normalised time.
        rounds: of searches and training.
        epochs: passes over the rows of a round and the one before.
        batch: rows a step.
        rate: greatest step length of AdamW, in one cycle.
        width: of the layers that see one obstacle; those that see all have twice as many.
        candidates, search_rounds, polish: of the searches, as `SearchParameters` has them.
        under_way, moving: shares of the scenes.
    """

    scenes: int = 50_000
    chunk: int = 2_000
    rounds: int = 5
    epochs: int = 40
    batch: int = 512
    rate: float = 4e-3
    width: int = 64
    candidates: int = 32
    search_rounds: int = 8
    polish: int = 4
    under_way: float = 0.3
    moving: float = 0.2

    def limited(self, scenes: int) -> ProposalRecipe:
        """A shorter trial: no more scenes a round, in two rounds of few passes."""
        return replace(
            self, scenes=scenes, chunk=min(self.chunk, scenes), rounds=2, epochs=min(self.epochs, 5)
        )


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


@dataclass(frozen=True)
class Given:
    """Proposes what it is given, genes (S, n, 7)."""

    genes: FloatArray
    spacing: float = 0.6

    def propose(
        self, scenes: SpatialScenes, duration: float, count: int, price: FloatArray = NO_PRICE
    ) -> tuple[FloatArray, BoolArray]:
        """Candidates, see `Proposer`."""
        return self.genes, np.ones(len(self.genes), dtype=bool)

    def weigh(self, scenes: SpatialScenes, duration: float) -> dict[str, FloatArray]:
        """Nothing."""
        return {}


class SideSearch(Search):
    """A search of motions on the side omega = y_L alone."""

    def bounded(self, genes: FloatArray) -> FloatArray:
        """Returns genes moved into their ranges, and to the side."""
        genes = np.clip(genes, LOWER, UPPER)
        genes[:, :, ANGLE] = np.clip(genes[:, :, ANGLE], -HALF, HALF)
        return genes


def turned(scenes: SpatialScenes, angle: FloatArray) -> SpatialScenes:
    """The scenes with their frames L turned about x, so that the side at an angle (S,) is y_L."""
    return replace(scenes, R_WL=scenes.R_WL @ Rotation.from_euler("x", angle[:, None]).as_matrix())


def draw_scenes(rng: np.random.Generator, count: int, moving: bool) -> SpatialScenes:
    """Scenes at rest at the start whose unmodulated motion comes too near; L = 1 m, and W = L.

    One to six ellipsoids of semi-axes 0.01 to 0.5, at most half as long along the baseline as it
    is; in a third of the scenes a large flat one besides, like a table. Start and goal are clear.
    """
    kept: list[tuple[FloatArray, ...]] = []
    found = 0
    while found < count:
        drawn = _candidates(rng, 4 * count, moving)
        center, R, axes = drawn[:3]
        ends = [signed_distance(p, center, R, axes) for p in (np.zeros(3), np.array([1.0, 0, 0]))]
        there = ~np.isnan(center[:, :, 0])
        clear = np.where(there, np.minimum(*ends), np.inf).min(axis=1) > rng.uniform(
            0.005, 0.08, len(center)
        )
        drawn = tuple(column[clear] for column in drawn)
        scenes = _at_rest(*drawn)
        rows = np.arange(len(scenes))
        unmodulated = roll_out(
            scenes, rows, np.zeros((len(rows), N_COLUMNS)), _COARSE, seconds=DURATION
        )
        in_way = unmodulated.margin < -_COARSE.slack
        kept.append(tuple(column[in_way] for column in drawn))
        found += int(in_way.sum())
    return _at_rest(*(np.concatenate(parts)[:count] for parts in zip(*kept, strict=True)))


def _candidates(rng: np.random.Generator, count: int, moving: bool) -> tuple[FloatArray, ...]:
    """Centres, rotations, semi-axes, velocities and asked clearances, before any is refused."""
    number = rng.choice([1, 1, 1, 2, 3, 4, 5, 6], count)
    table = rng.random(count) < 1.0 / 3.0
    size = np.where(number > 2, 0.12, 0.5)[:, None, None]
    axes = rng.uniform(0.01, 1.0, (count, MOST, 3)) * size
    quaternion = rng.standard_normal((count * MOST, 4))
    R = Rotation.from_quat(np.roll(quaternion, -1, axis=1)).as_matrix().reshape(count, MOST, 3, 3)
    R[rng.random(count) < 0.3] = np.eye(3)
    center = rng.uniform((0.0, -0.5, -0.5), (1.0, 0.5, 0.5), (count, MOST, 3))
    # One of them in the way, the others anywhere.
    center[:, 0, 1:] *= rng.random((count, 1)) ** 2 * (rng.random((count, 1)) < 0.7)
    velocity = np.zeros((count, MOST, 3))
    asked = np.where(rng.random((count, 1)) < 0.5, 0.15, rng.uniform(0.02, 0.32, (count, 1)))
    asked = np.repeat(asked, MOST, axis=1)
    if moving:
        direction = rng.standard_normal((count, MOST, 3))
        direction /= np.linalg.norm(direction, axis=2, keepdims=True)
        velocity = direction * rng.uniform(0.0, 0.5, (count, MOST, 1))
        velocity[rng.random((count, MOST)) < 0.4] = 0.0
        met = rng.uniform(0.2, 0.7, (count, MOST, 1)) * DURATION
        center -= met * velocity
    absent = np.arange(MOST) >= number[:, None]
    # The table is beneath the baseline, whichever way that is.
    roll = rng.uniform(-np.pi, np.pi, count)
    down = np.stack([np.zeros(count), np.cos(roll), np.sin(roll)], axis=1)
    thick = rng.uniform(0.005, 0.05, count)
    height = rng.uniform(0.05, 0.5, count)
    center[table, -1] = (np.array([0.5, 0, 0]) + (height + thick)[:, None] * down)[table]
    across = np.cross(down, [1.0, 0.0, 0.0])
    R[table, -1] = np.stack([np.tile([1.0, 0, 0], (count, 1)), across, down], axis=2)[table]
    wide = rng.uniform(0.6, 1.5, (count, 2))
    axes[table, -1] = np.column_stack([wide, thick])[table]
    velocity[table, -1] = 0.0
    asked[table, -1] = np.minimum(rng.uniform(0.01, 0.2, count), 0.9 * height)[table]
    absent[:, -1] = ~table
    center[absent] = np.nan
    return center, R, axes, velocity, asked


def _at_rest(
    center: FloatArray, R: FloatArray, axes: FloatArray, velocity: FloatArray, asked: FloatArray
) -> SpatialScenes:
    count = len(center)
    return SpatialScenes(
        p_WE=np.zeros((count, 3)),
        z_W=np.zeros((count, 3)),
        p_WG=np.tile([1.0, 0.0, 0.0], (count, 1)),
        R_WL=np.tile(np.eye(3), (count, 1, 1)),
        baseline=np.ones(count),
        p_WO=center,
        R_WO=R,
        semi_axes=axes,
        v_WO=velocity,
        asked_clearance=asked,
    )


def _under_way(
    scenes: SpatialScenes, s: float, genes: FloatArray, parameters: SearchParameters
) -> SpatialScenes:
    """The scenes once motions with other scenes' genes (S, 7) have gone until s."""
    found = roll_out(
        scenes.without_obstacles(),
        np.arange(len(scenes)),
        avoidance_terms(scenes, np.arange(len(scenes)), genes),
        parameters,
        seconds=DURATION,
        keep_path=True,
    )
    at = round(s * parameters.steps)
    later = replace(
        scenes,
        p_WE=found.path[:, at],
        z_W=found.velocity[:, at],
        p_WO=scenes.p_WO + s * DURATION * scenes.v_WO,
        s=at / parameters.steps,
    )
    distance = signed_distance(later.p_WE[:, None], later.p_WO, later.R_WO, later.semi_axes)
    clear = np.where(np.isnan(distance), np.inf, distance).min(axis=1) > 0.01
    return later.rows(np.flatnonzero(clear & np.isfinite(later.p_WE).all(axis=1)))


def make_rows(
    recipe: ProposalRecipe,
    seed: tuple[int, ...],
    network: ProposalNetwork | None,
) -> Rows:
    """Draws a chunk of scenes and searches one side of each.

    Args:
        recipe: how.
        seed: of the scenes.
        network: of the round before, which proposes besides the fixed candidates; None: none yet.
    """
    rng = np.random.default_rng(seed)
    parameters = SearchParameters(
        candidates=recipe.candidates, rounds=recipe.search_rounds, polish=recipe.polish
    )
    scenes = draw_scenes(rng, recipe.chunk, bool(rng.random() < recipe.moving))
    if rng.random() < recipe.under_way:
        genes = _elsewhere(rng, scenes, network)
        scenes = _under_way(scenes, rng.uniform(0.02, 0.75), genes, parameters)
    count = len(scenes)
    scenes = turned(scenes, _sides(rng, scenes, network))
    first = np.repeat(_fixed()[None], count, axis=0)
    if network is not None:
        genes = network.sides(scenes, DURATION, np.zeros(1))[0]
        genes = np.repeat(genes, _STARTS, axis=1)
        genes[:, :, ALPHA] += np.linspace(-0.8, 1.0, _STARTS)
        first = np.concatenate([genes, first], axis=1)
    search = SideSearch(scenes, DURATION, None, np.full((count, N_GENES), np.nan), parameters)
    return _rows(scenes, search.run(Given(first)))


def _sides(
    rng: np.random.Generator, scenes: SpatialScenes, network: ProposalNetwork | None
) -> FloatArray:
    """(S,) a side of each: one of those that the network ranks first, or any."""
    count = len(scenes)
    anywhere = rng.uniform(-np.pi, np.pi, count)
    if network is None:
        return anywhere
    best = network.propose(scenes, DURATION, _STARTS)[0][:, :, ANGLE]
    best = best[np.arange(count), rng.integers(0, best.shape[1], count)]
    near = best + rng.uniform(-1.5, 1.5, count) * HALF
    return np.where(rng.random(count) < 0.3, anywhere, near)


def _fixed() -> FloatArray:
    """Returns the fixed candidates (15, 7) on the side y_L."""
    genes = np.zeros((_PLACES.size, N_GENES))
    genes[:, PLACE], genes[:, ALPHA] = _PLACES.ravel(), _LOG_ALPHAS.ravel()
    genes[:, KAPPA], genes[:, PSI] = np.log(_KAPPA), np.log(_PSI)
    return genes


def _elsewhere(
    rng: np.random.Generator, scenes: SpatialScenes, network: ProposalNetwork | None
) -> FloatArray:
    """Returns genes (S, 7) for other scenes of the chunk, or the unmodulated motion's."""
    if network is None:
        genes = rng.choice(_fixed(), len(scenes))
        genes[:, ANGLE] = rng.uniform(-np.pi, np.pi, len(scenes))
    else:
        genes = network.propose(scenes, DURATION, 1)[0][:, 0]
    genes = genes[rng.permutation(len(genes))]
    genes[rng.random(len(genes)) < 0.3, ALPHA] = -np.inf
    return genes


def _rows(scenes: SpatialScenes, found: SearchResult) -> Rows:
    used = np.flatnonzero(np.isfinite(found.genes[:, ALPHA]))
    each = descriptors(scenes, DURATION, np.zeros(len(scenes)))
    genes = (found.genes[used] - GENE_MEAN) / GENE_SCALE
    return Rows(
        each[used],
        genes.astype(np.float32),
        np.log(np.maximum(found.path_length[used], 1e-3)).astype(np.float32),
        found.kept[used],
    )


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
        return Layers(*found)


class Scores(NamedTuple):
    """How a network does on rows that it has not seen.

    Attributes:
        genes: (7,) mean absolute error of each gene, of those that keep what is asked.
        length: root mean square error of ln length, of the same.
        kept: share of the rows of which it says rightly whether what is asked is kept.
    """

    genes: FloatArray
    length: float
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
    adam = torch.optim.AdamW(net.parameters(), lr=recipe.rate, weight_decay=1e-5)
    batches = max(len(used) // recipe.batch, 1)
    cycle = torch.optim.lr_scheduler.OneCycleLR(
        adam, recipe.rate, total_steps=recipe.epochs * batches
    )
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
        part = tuple(column[held] for column in tensors)
        said, good = net(part[0]), part[3] > 0.5
        off = (said[good, :N_GENES] - part[1][good]).abs().mean(dim=0).cpu().numpy()
        length = (said[good, N_GENES] - part[2][good]).square().mean().sqrt()
        right = ((said[:, N_GENES + 1] > 0.0) == good).float().mean()
    return Scores(off * GENE_SCALE, float(length), float(right))


def train_proposals(
    recipe: ProposalRecipe,
    seed: int,
    *,
    device: str = "cpu",
    checkpoint: Checkpoint | None = None,
    report: Report = lambda stage, done: None,
) -> tuple[ProposalNetwork, list[Scores]]:
    """Searches and trains, round by round.

    Args:
        recipe: how.
        seed: of scenes and first weights.
        device: where the network is trained.
        checkpoint: keeps each chunk and each round.
        report: told how far it is.

    Returns:
        The network, and its scores after each round.
    """
    torch.manual_seed(seed)
    # Small layers: more threads only wait for each other.
    torch.set_num_threads(1)
    net = SetNetwork(recipe.width).to(device)
    network: ProposalNetwork | None = None
    before: list[Rows] = []
    scores: list[Scores] = []
    chunks = -(-recipe.scenes // recipe.chunk)
    for number in range(recipe.rounds):
        made: list[Rows] = []
        for k in range(chunks):
            name = f"rows_{number}_{k}"
            kept = checkpoint.load(name) if checkpoint else None
            if kept is None:
                rows = make_rows(recipe, (seed, number, k), network)
                if checkpoint:
                    checkpoint.save(name, **rows._asdict())
            else:
                rows = Rows(**kept)
            made.append(rows)
            report(f"round {number + 1}: search", (number + (k + 1) / chunks) / recipe.rounds)
        rows = Rows(*map(np.concatenate, zip(*before, *made, strict=True)))
        before = made
        scores.append(fit(net, rows, recipe, seed + number, device, report))
        network = ProposalNetwork(net.arrays())
    told = {
        "recipe": "proposals",
        "seed": seed,
        **provenance(),
        **asdict(recipe),
        "scores": [score._asdict() | {"genes": score.genes.tolist()} for score in scores],
    }
    return ProposalNetwork(net.arrays(), told), scores


def proposal_table(scores: Sequence[Scores]) -> TextTable:
    """Returns the scores of each round as a table."""
    genes = ("side [rad]", "place", "aside", "ln kappa", "ln psi", "ln alpha", "ln tau")
    columns = [
        Column("round"),
        *(Column(name, form="{:.3f}") for name in genes),
        Column("length", "ln length", "{:.3f}"),
        Column("kept", "kept told", "{:.3f}"),
    ]
    rows = [
        {"round": number, **dict(zip(genes, score.genes, strict=True)), **score._asdict()}
        for number, score in enumerate(scores, 1)
    ]
    note = "mean absolute errors, of ln length root mean square, on a twentieth that is held out"
    return TextTable(columns, rows, [note])
