"""The training of the proposal network: its scenes, its rows, and that what runs is what learnt."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from drake_oa.geometry.ellipsoid import signed_distance
from drake_oa.policy.coupling import N_COLUMNS
from drake_oa.regulation.proposal_network import (
    HALF,
    SIDES,
    ProposalNetwork,
    descriptors,
)
from drake_oa.regulation.proposals import ANGLE, N_GENES
from drake_oa.regulation.rollout import spatial_rollouts
from drake_oa.training.checkpoint import Checkpoint
from drake_oa.training.proposals import (
    DURATION,
    ProposalRecipe,
    SetNetwork,
    draw_scenes,
    train_proposals,
    turned,
)

FEW = ProposalRecipe(scenes=40, chunk=40, rounds=2, epochs=2, batch=16, width=8, search_rounds=2)


def test_scenes_have_something_in_the_way_and_their_ends_clear() -> None:
    scenes = draw_scenes(np.random.default_rng(0), 60, moving=True)
    unmodulated = spatial_rollouts(
        scenes, np.arange(60), np.zeros((60, N_COLUMNS)), seconds=DURATION, steps=1000
    )
    assert (unmodulated.margin < 0.0).all()
    for p in (scenes.p_WE, scenes.p_WG):
        distance = signed_distance(p[:, None], scenes.p_WO, scenes.R_WO, scenes.semi_axes)
        assert np.nanmin(distance) > 0.0


def test_the_network_that_runs_is_the_one_that_learns() -> None:
    torch.manual_seed(0)
    net = SetNetwork(16)
    scenes = draw_scenes(np.random.default_rng(1), 30, True)
    gone = scenes.p_WO[:, :, :1] > 0.4
    gone[:, 0] = False  # Where nothing is left, something stands in.
    scenes = replace(scenes, p_WO=np.where(gone, np.nan, scenes.p_WO))
    seen = turned(scenes, np.full(30, SIDES[5]))
    rows = torch.from_numpy(np.array(descriptors(seen, DURATION, np.zeros(30))))
    with torch.no_grad():
        said = net(rows).numpy()
    genes, length, likely = ProposalNetwork(net.arrays()).sides(scenes, DURATION)
    np.testing.assert_allclose(np.log(length[:, 5]), np.clip(said[:, N_GENES], 0.0, 3.0), atol=1e-5)
    np.testing.assert_allclose(likely[:, 5], 1.0 / (1.0 + np.exp(-said[:, -1])), atol=1e-5)
    side = np.clip(0.2 * said[:, ANGLE], -HALF, HALF) + SIDES[5]
    np.testing.assert_allclose(genes[:, 5, ANGLE], side, atol=1e-5)


def test_a_training_that_is_cut_short_goes_on_to_the_same(tmp_path: Path) -> None:
    settings = {"seed": 0}
    whole, scores = train_proposals(FEW, 0)
    assert len(scores) == FEW.rounds
    train_proposals(replace(FEW, rounds=1), 0, checkpoint=Checkpoint(tmp_path / "kept", settings))
    again = train_proposals(FEW, 0, checkpoint=Checkpoint(tmp_path / "kept", settings))[0]
    for ours, theirs in zip(whole.layers, again.layers, strict=True):
        np.testing.assert_array_equal(ours, theirs)
