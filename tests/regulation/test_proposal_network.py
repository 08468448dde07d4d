"""The proposal network: what it sees, what it says, and the file it is kept in."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drake_oa.common.files import package_file
from drake_oa.common.messages import EllipsoidSet
from drake_oa.policy.rollout import Scene
from drake_oa.regulation.proposals import (
    ANGLE,
    HALF,
    N_GENES,
    N_SIDES,
    ProposalNetwork,
    describe,
    load_proposals,
    save_proposals,
)


def some_scene(seed: int, M: int = 4) -> Scene:
    """A motion under way among ellipsoids that turn and move."""
    rng = np.random.default_rng(seed)
    L, R_WL = rng.uniform(0.5, 2.0), Rotation.random(random_state=seed).as_matrix()
    start = rng.normal(size=3)
    place = L * np.column_stack([rng.uniform(0.25, 0.75, M), rng.normal(0.0, 0.08, (M, 2))])
    seen = EllipsoidSet(
        p_WO=start + place @ R_WL.T,
        R_WO=Rotation.random(M, random_state=seed).as_matrix(),
        semi_axes=rng.uniform(0.025, 0.25, (M, 3)),
        v_WO=0.2 * rng.normal(size=(M, 3)),
        ids=np.arange(M),
    )
    return Scene(
        p_WE=start + 0.1,
        z_W=0.5 * rng.normal(size=3),
        p_WG=start + L * R_WL[:, 0],
        R_WL=R_WL,
        baseline=L,
        ellipsoids=seen,
        clearance=np.full(M, 0.15),
        s=0.3,
    )


@given(st.integers(0, 50))
def test_a_scene_that_is_moved_turned_scaled_or_permuted_is_the_same(
    proposer: ProposalNetwork, seed: int
) -> None:
    scene = some_scene(seed)
    rng = np.random.default_rng(seed)
    Q = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    Q *= np.linalg.det(Q)
    p, k, seen = rng.standard_normal(3), 1.7, scene.ellipsoids
    other = replace(
        scene,
        p_WE=k * scene.p_WE @ Q.T + p,
        z_W=k * scene.z_W @ Q.T,
        p_WG=k * scene.p_WG @ Q.T + p,
        R_WL=Q @ scene.R_WL,
        baseline=k * scene.baseline,
        ellipsoids=replace(
            seen,
            p_WO=k * seen.p_WO @ Q.T + p,
            R_WO=Q @ seen.R_WO,
            semi_axes=k * seen.semi_axes,
            v_WO=k * seen.v_WO @ Q.T,
        ),
        clearance=k * scene.clearance,
    )
    angles = np.array([0.7, 2.0])
    for ours, theirs in zip(
        describe(scene, 3.0, angles), describe(other, 3.0, angles), strict=True
    ):
        np.testing.assert_allclose(ours, theirs, atol=1e-5)
    order = rng.permutation(4)
    columns = {n: getattr(seen, n)[order] for n in ("p_WO", "R_WO", "semi_axes", "v_WO", "ids")}
    mixed = replace(scene, ellipsoids=replace(seen, **columns))
    for ours, theirs in zip(proposer.sides(scene, 3.0), proposer.sides(mixed, 3.0), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-4)


def test_every_side_has_a_proposal(proposer: ProposalNetwork) -> None:
    genes, length, likely = proposer.sides(some_scene(1), 3.0)
    assert genes.shape == (N_SIDES, N_GENES)
    assert np.isfinite(genes).all()
    assert (length >= 1.0).all()
    assert ((likely >= 0.0) & (likely <= 1.0)).all()
    off = genes[:, ANGLE] - 2.0 * HALF * np.arange(N_SIDES)
    assert np.abs(off).max() <= HALF + 1e-12
    # Without obstacles there is none.
    assert len(proposer.rows(some_scene(1, 0), 3.0)) == 0


def test_a_file_holds_it_whole(proposer: ProposalNetwork, tmp_path: Path) -> None:
    path = tmp_path / "mine.safetensors"
    save_proposals(proposer, path)
    again = load_proposals(path)
    ours, theirs = (one.ranked(some_scene(3), 3.0) for one in (proposer, again))
    np.testing.assert_array_equal(ours, theirs)
    assert again.metadata["seed"] == proposer.metadata["seed"]


def test_what_does_not_fit_is_named(proposer: ProposalNetwork, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="is of the format 'drake_oa regressor chain 1'"):
        load_proposals(package_file("package://drake_oa/weights/paper_chain_running.safetensors"))
    path = tmp_path / "mine.safetensors"
    layers = (*proposer.layers[:2], np.zeros((3, 64), np.float32), *proposer.layers[3:])
    save_proposals(replace(proposer, layers=layers), path)
    with pytest.raises(ValueError, match=r"'each_2' has the shape \(3, 64\)"):
        load_proposals(path)
