"""The proposal network: what it sees, what it says, and the file it is kept in."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from safetensors.numpy import load_file, save_file

from drake_oa.regulation.proposal_network import (
    HALF,
    N_SIDES,
    N_STATE,
    ProposalNetwork,
    descriptors,
    load_proposals,
    save_proposals,
)
from drake_oa.regulation.proposals import (
    ALPHA,
    ANGLE,
    N_GENES,
    ladder,
    strengths,
)
from drake_oa.regulation.regressor import load_chain
from drake_oa.regulation.rollout import SpatialScenes
from drake_oa.scenario.shipped import package_file
from tests.regulation.scenes import random_scenes

WEIGHTS = "package://drake_oa/weights"


def some_scenes(seed: int, count: int = 3, obstacles: int = 4) -> SpatialScenes:
    """Scenes under way among ellipsoids that turn and move, some of which are not there."""
    scenes = random_scenes(seed, obstacles, 0.2, count=count, pace=0.5)
    return replace(scenes, p_WE=scenes.p_WE + 0.1, s=0.3)


@given(st.integers(0, 50))
def test_a_scene_that_is_moved_turned_and_scaled_is_described_alike(seed: int) -> None:
    scenes = some_scenes(seed)
    rng = np.random.default_rng(seed)
    Q = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    Q *= np.linalg.det(Q)
    p, k = rng.standard_normal(3), 1.7
    other = replace(
        scenes,
        p_WE=k * scenes.p_WE @ Q.T + p,
        z_W=k * scenes.z_W @ Q.T,
        p_WG=k * scenes.p_WG @ Q.T + p,
        R_WL=Q @ scenes.R_WL,
        baseline=k * scenes.baseline,
        p_WO=k * scenes.p_WO @ Q.T + p,
        R_WO=Q @ scenes.R_WO,
        semi_axes=k * scenes.semi_axes,
        v_WO=k * scenes.v_WO @ Q.T,
        asked_clearance=k * scenes.asked_clearance,
    )
    angle = np.full(3, 0.7)
    ours, theirs = descriptors(scenes, 3.0, angle), descriptors(other, 3.0, angle)
    np.testing.assert_allclose(ours, theirs, atol=1e-5)


def test_a_descriptor_holds_what_it_says() -> None:
    scenes = replace(
        some_scenes(0, 1, 1),
        p_WE=np.array([[0.5, 0.1, 0.0]]),
        z_W=np.array([[1.0, 0.0, 0.4]]),
        p_WG=np.array([[2.0, 0.0, 0.0]]),
        R_WL=np.eye(3)[None],
        baseline=np.array([2.0]),
        p_WO=np.array([[[1.0, 0.2, 0.4]]]),
        R_WO=np.eye(3)[None, None],
        semi_axes=np.array([[[0.2, 0.4, 0.6]]]),
        v_WO=np.array([[[0.1, 0.0, 0.0]]]),
        asked_clearance=np.array([[0.1]]),
    )
    obstacle, state = descriptors(scenes, 4.0, np.full(1, np.pi / 2.0))[0]
    # Seen from the side z, which is y of the turned frame; its z is -y of the world.
    expected = [0.5, 0.2, -0.1, 0.1, 0.3, 0.2, 0.0, 0.0, 0.0, 0.05, 0.2, 0.0, 0.0]
    np.testing.assert_allclose(obstacle[:-N_STATE], expected, atol=1e-7)
    np.testing.assert_allclose(state[-N_STATE:], [0.3, 0.25, 0, -0.05, 0.5, 0.2, 0], atol=1e-7)


@given(st.integers(0, 20))
def test_the_order_of_obstacles_and_those_that_are_not_there_count_for_nothing(
    proposer: ProposalNetwork, seed: int
) -> None:
    scenes = some_scenes(seed)
    order = np.random.default_rng(seed).permutation(4)
    columns = ("p_WO", "R_WO", "semi_axes", "v_WO", "asked_clearance")
    mixed = replace(scenes, **{name: getattr(scenes, name)[:, order] for name in columns})
    for ours, theirs in zip(proposer.sides(scenes, 3.0), proposer.sides(mixed, 3.0), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-4)


def test_it_says_something_of_every_side_even_of_nothing(proposer: ProposalNetwork) -> None:
    for scenes in (some_scenes(1), some_scenes(1).without_obstacles()):
        genes, length, likely = proposer.sides(scenes, 3.0)
        assert genes.shape == (3, N_SIDES, N_GENES)
        assert np.isfinite(genes).all()
        assert (length >= 1.0).all()
        assert ((likely >= 0.0) & (likely <= 1.0)).all()
        off = genes[:, :, ANGLE] - 2.0 * HALF * np.arange(N_SIDES)
        assert np.abs(off).max() <= HALF + 1e-12


@given(st.integers(1, 300), st.integers(1, 16))
def test_a_ladder_has_as_many_rungs_as_it_is_asked_for_and_more_for_the_first(
    count: int, sides: int
) -> None:
    rank, share = ladder(count, sides)
    assert len(rank) == len(share) == count
    assert rank.max() < sides
    assert ((share >= 0.0) & (share <= 1.0)).all()
    assert (np.diff(np.bincount(rank)) <= 0).all()


def test_weaker_ones_of_what_keeps_it_and_stronger_ones_of_what_does_not() -> None:
    genes = np.zeros((2, N_GENES))
    line = strengths(genes, np.array([True, False]), 0.5, 4)
    assert ((line[0, :, ALPHA] > -0.5) & (line[0, :, ALPHA] < 0.0)).all()
    assert (line[1, :, ALPHA] > 0.0).all()
    np.testing.assert_array_equal(np.delete(line, ALPHA, axis=2), 0.0)


def test_a_file_holds_it_whole(proposer: ProposalNetwork, tmp_path: Path) -> None:
    path = tmp_path / "mine.safetensors"
    save_proposals(proposer, path)
    again = load_proposals(path)
    ours, theirs = (one.propose(some_scenes(3), 3.0, 15)[0] for one in (proposer, again))
    np.testing.assert_array_equal(ours, theirs)
    assert again.metadata["seed"] == proposer.metadata["seed"]


def test_a_chain_is_no_proposal_network_nor_the_other_way_about() -> None:
    with pytest.raises(ValueError, match="no proposal network"):
        load_proposals(package_file(f"{WEIGHTS}/paper_chain_running.safetensors"))
    with pytest.raises(ValueError, match="is of the format 'drake_oa proposal network 1'"):
        load_chain(package_file(f"{WEIGHTS}/proposals.safetensors"))


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"each_1": None}, "lacks the array 'each_1'"),
        ({"each_2": np.zeros((3, 64))}, r"'each_2' has the shape \(3, 64\)"),
        ({"out_bias": np.zeros(3)}, r"'out_bias' has the shape \(3,\)"),
        ({"out": np.full((128, 9), np.nan)}, "'out' must hold finite numbers"),
    ],
)
def test_what_does_not_fit_is_named(
    proposer: ProposalNetwork, tmp_path: Path, wrong: dict[str, np.ndarray | None], said: str
) -> None:
    path = tmp_path / "mine.safetensors"
    save_proposals(proposer, path)
    arrays = load_file(path) | {name: value for name, value in wrong.items() if value is not None}
    for name in [name for name, value in wrong.items() if value is None]:
        del arrays[name]
    save_file(arrays, path, {"metadata": '{"format": "drake_oa proposal network 1"}'})
    with pytest.raises(ValueError, match=said):
        load_proposals(path)
