"""The training of the proposal network: its scenes, its rows, and that what runs is what learnt."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from drake_oa.geometry.ellipsoid import signed_distance
from drake_oa.planning.point_search import PointSearch
from drake_oa.policy.config import Policy
from drake_oa.regulation.config import Verified
from drake_oa.regulation.proposals import ALPHA, ANGLE, HALF, N_GENES, SIDES, ProposalNetwork
from drake_oa.training.proposals import (
    DMP,
    DURATION,
    ProposalRecipe,
    SetNetwork,
    described,
    draw_scene,
    train_proposals,
    turned,
)

FEW = ProposalRecipe(scenes=40, chunk=40, rounds=2, epochs=2, batch=16, width=8, search_rounds=2)


def test_scenes_have_something_in_the_way_and_their_ends_clear() -> None:
    rng = np.random.default_rng(0)
    policy, nominal = Policy(period=DURATION / 1000), np.zeros((1, N_GENES))
    nominal[:, ALPHA] = -np.inf
    for _ in range(20):
        scene = draw_scene(rng, moving=True)
        search = PointSearch(scene, dmp=DMP, policy=policy, parameters=Verified())
        assert search.margins(nominal, search.tool_paths(nominal))[0] < 0.0
        seen = scene.ellipsoids
        for p in (scene.p_WE, scene.p_WG):
            assert signed_distance(p, seen.p_WO, seen.R_WO, seen.semi_axes).min() > 0.0


def test_the_network_that_runs_is_the_one_that_learns() -> None:
    torch.manual_seed(0)
    net, rng = SetNetwork(16), np.random.default_rng(1)
    network = ProposalNetwork(net.arrays())
    for _ in range(10):
        scene = draw_scene(rng, True)
        with torch.no_grad():
            rows = torch.from_numpy(described(turned(scene, SIDES[5]))[None])
            said = net(rows).numpy()[0]
        genes, length, likely = network.sides(scene, DURATION)
        np.testing.assert_allclose(np.log(length[5]), np.clip(said[N_GENES], 0.0, 3.0), atol=1e-5)
        np.testing.assert_allclose(likely[5], 1.0 / (1.0 + np.exp(-said[-1])), atol=1e-5)
        side = np.clip(0.2 * said[ANGLE], -HALF, HALF) + SIDES[5]
        np.testing.assert_allclose(genes[5, ANGLE], side, atol=1e-5)


def test_an_interrupted_training_resumes_to_the_same_network(tmp_path: Path) -> None:
    whole, scores = train_proposals(FEW, 0, tmp_path / "whole")
    assert len(scores) == FEW.rounds
    train_proposals(replace(FEW, rounds=1), 0, tmp_path / "resumed")
    again = train_proposals(FEW, 0, tmp_path / "resumed")[0]
    for ours, theirs in zip(whole.layers, again.layers, strict=True):
        np.testing.assert_array_equal(ours, theirs)
