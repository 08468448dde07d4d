"""The regressor chain: forward pass, weights files, sections of ellipsoids."""

import copy
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors import safe_open
from safetensors.numpy import load_file, save_file
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import CouplingParameters, EllipsoidSet
from drake_oa.geometry.superquadric import log_inside_outside
from drake_oa.regulation.regressor import (
    TARGETS,
    ChainWeights,
    Network,
    load_chain,
    save_chain,
    section_extents,
)
from tests.reference.width_chain import load_width_chain

WEIGHTS = Path(__file__).resolve().parents[2] / "models" / "weights"


def network(n_inputs, rng, scale=0.3):
    sizes = [n_inputs, 24, 24, 24, 1]
    pairs = list(zip(sizes[1:], sizes[:-1], strict=True))
    return Network(
        tuple(scale * rng.standard_normal(shape) for shape in pairs),
        tuple(scale * rng.standard_normal(rows) for rows, _ in pairs),
        in_offset=rng.uniform(0.0, 0.1, n_inputs),
        in_gain=rng.uniform(2.0, 5.0, n_inputs),
        out_offset=0.3,
        out_gain=0.7,
    )


@pytest.fixture
def chain():
    rng = np.random.default_rng(3)
    networks = {name: network(3 + i, rng) for i, name in enumerate(TARGETS)}
    return ChainWeights(
        networks,
        np.array([0.02, 0.02, 0.02]),
        np.array([0.4, 0.5, 0.35]),
        np.ones(3),
        frozenset(("kappa", "alpha")),
        metadata={"recipe": "test", "seed": 3},
    )


def plain_forward(net, x):
    """The network as the docstring states it, row by row."""
    y = (x - net.in_offset) * net.in_gain + net.in_min
    for weight, bias in zip(net.weights[:-1], net.biases[:-1], strict=True):
        y = np.tanh(weight @ y + bias)
    y = net.weights[-1] @ y + net.biases[-1]
    return (y[0] - net.out_min) / net.out_gain + net.out_offset


def test_chain_is_the_plain_networks_one_after_the_other(chain):
    query = np.array([0.1, 0.2, 0.15])
    kappa = plain_forward(chain.networks["kappa"], query)
    psi = plain_forward(chain.networks["psi"], np.append(query, kappa))
    alpha = plain_forward(chain.networks["alpha"], np.append(query, (kappa, psi)))
    expected = (np.exp(alpha), psi, np.exp(kappa))
    np.testing.assert_allclose(chain.evaluate(query[None])[0], expected, rtol=1e-12)


def test_reproduces_the_reference_samples(reference):
    chain = load_width_chain(reference("authors_rc.npz"))
    samples = np.load(reference("authors_rc_samples.npz"))
    inputs = np.column_stack((samples["widths"] / 2.0, samples["clearance"]))
    alpha, psi, kappa = chain.evaluate(inputs).T
    np.testing.assert_allclose(alpha, samples["alpha"], rtol=1e-9)
    np.testing.assert_allclose(psi, samples["psi"], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(kappa, samples["kappa"], rtol=0.0, atol=1e-9)


def test_a_query_outside_is_flagged_and_evaluated_at_the_border(chain):
    outside = chain.parameters([[0.1, 0.7], [0.1, 0.5], [0.001, 0.1]], 0.1, 1.0)
    assert outside.in_range.tolist() == [False, True, False]
    assert outside.alpha[0] == pytest.approx(outside.alpha[1], rel=1e-12)


def test_each_obstacle_may_have_its_own_clearance_and_none_needs_no_coupling(chain):
    extents = np.array([[0.1, 0.1], [0.2, 0.1], [0.1, 0.2]])
    found = chain.parameters(extents, np.array([0.1, 0.0, 0.2]), 1.0)
    assert found.alpha[1] == 0.0
    assert found.in_range.all()
    for row, clearance in ((0, 0.1), (2, 0.2)):
        alone = chain.parameters(extents[row : row + 1], clearance, 1.0)
        np.testing.assert_allclose(found.as_array()[row], alone.as_array()[0], rtol=1e-12)


def test_parameters_are_immutable_and_shared_on_copy():
    value = CouplingParameters(np.ones(2), np.ones(2), np.ones(2), np.ones(2, dtype=bool))
    assert copy.deepcopy(value) is value
    assert value.as_array().shape == (2, 3)
    with pytest.raises(ValueError, match="read-only"):
        value.alpha[0] = 2.0


@pytest.mark.parametrize("n_inputs", [2, 3])
def test_chains_of_fewer_inputs_load_and_ignore_the_rest(tmp_path, n_inputs):
    rng = np.random.default_rng(1)
    networks = {name: network(n_inputs + i, rng) for i, name in enumerate(TARGETS)}
    lower, upper = np.full(n_inputs, 0.02), np.full(n_inputs, 0.6)
    path = tmp_path / "chain.safetensors"
    save_chain(ChainWeights(networks, lower, upper, np.ones(n_inputs)), path)
    chain = load_chain(path)
    query = (np.array([[0.1, 0.2]]), 0.05, 2.0)
    base = chain.parameters(*query)
    assert base.in_range.all()
    expected = chain.evaluate(np.array([[0.05, 0.1, 0.025]])[:, :n_inputs])[0]
    np.testing.assert_allclose(base.as_array()[0], expected / (1.0, 1.0, 4.0), rtol=1e-12)
    other_clearance = chain.parameters(query[0], 0.3, 2.0).as_array()
    assert (other_clearance == base.as_array()).all() == (n_inputs < 3)
    # Without a clearance to keep, no coupling is needed.
    assert chain.parameters(query[0], 0.0, 2.0).alpha[0] == 0.0


def test_a_file_gives_back_the_chain(chain, tmp_path):
    path = tmp_path / "chain.safetensors"
    save_chain(chain, path)
    loaded = load_chain(path)
    inputs = np.random.default_rng(0).uniform(0.05, 0.3, (20, 3))
    np.testing.assert_array_equal(loaded.evaluate(inputs), chain.evaluate(inputs))
    assert loaded.log_targets == chain.log_targets
    assert loaded.metadata == chain.metadata
    np.testing.assert_array_equal(loaded.upper, chain.upper)


@pytest.mark.parametrize(
    ("name", "n_inputs", "printed"),
    [
        ("paper_chain", 3, {"kappa": 0.251, "psi": 0.244}),
        ("paper_chain_unconstrained", 2, {"kappa": 0.539, "psi": 0.802, "alpha": 0.893}),
    ],
)
def test_the_papers_chains_are_shipped_and_score_as_printed(name, n_inputs, printed):
    chain = load_chain(WEIGHTS / f"{name}.safetensors")
    assert chain.lower.size == n_inputs
    assert chain.metadata["recipe"] == "paper"
    assert chain.metadata["units"]["alpha"] == "rad/s"
    for target, value in printed.items():
        for part in ("train", "test"):
            assert chain.metadata["nmse"][target][part] == pytest.approx(value, abs=0.01)
    if n_inputs == 3:
        assert chain.metadata["nmse"]["alpha"]["test"] <= 5e-4


def test_a_missing_file_is_named_with_the_way_to_get_one(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere.safetensors.*drake-oa train --out"):
        load_chain(tmp_path / "nowhere.safetensors")


def test_a_file_that_is_no_weights_file_is_named(tmp_path):
    path = tmp_path / "noise.npz"
    path.write_bytes(b"not weights at all")
    with pytest.raises(ValueError, match=r"noise.npz cannot be read"):
        load_chain(path)


def header(**changes):
    own = {"log_targets": ["kappa"], "format": "drake_oa regressor chain 1"}
    return json.dumps({**own, **changes})


def _damaged(chain, path, key, value):
    save_chain(chain, path)
    with safe_open(path, "numpy") as file:
        arrays = {**load_file(path), **file.metadata()}
    if value is None:
        del arrays[key]
    else:
        arrays[key] = value
    text = arrays.pop("metadata", None)
    save_file(arrays, path, None if text is None else {"metadata": text})


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("psi_W2", None, "lacks the array 'psi_b1'|'psi_W1' has the shape"),
        ("alpha_in_gain", np.ones(4), r"'alpha_in_gain' has the shape \(4,\)"),
        ("kappa_b1", np.full(24, np.nan), "'kappa_b1' must hold finite numbers"),
        ("psi_out_gain", np.array(0.0), "scale of 'psi'"),
        ("lower", np.full(3, 9.0), "'upper' must exceed 'lower'"),
        ("input_scale", np.zeros(3), "'input_scale' not be zero"),
        ("metadata", None, "has no metadata"),
        ("metadata", header(log_targets=["beta"]), "valid are"),
        ("metadata", header(format="someone else's 3"), 'format "someone else\'s 3"'),
    ],
)
def test_a_damaged_file_is_named_with_what_is_wrong(chain, tmp_path, key, value, message):
    path = tmp_path / "chain.safetensors"
    _damaged(chain, path, key, value)
    with pytest.raises(ValueError, match=message):
        load_chain(path)


def shapes(p_WO, R_WO, semi_axes, exponents=()):
    return EllipsoidSet(
        p_WO=np.array(p_WO),
        R_WO=np.array(R_WO),
        semi_axes=np.array(semi_axes),
        exponents=np.array(exponents).reshape(-1, 2),
    )


@pytest.mark.parametrize(
    ("p", "z"),
    [
        ([0.0, 0.0, 0.0], [1.0, 0.0, 0.0]),
        ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0]),
        ([0.5, 0.0, 0.0], [1.0, 0.3, 0.0]),
    ],
    ids=["heading at the centre", "at rest", "at the centre"],
)
def test_without_a_plane_the_local_vertical_one_is_cut(p, z):
    extents = section_extents(
        np.array(p),
        np.array(z),
        np.eye(3),
        shapes([[0.5, 0.0, 0.0]], np.eye(3)[None], [[0.1, 0.2, 0.3]]),
    )
    np.testing.assert_allclose(extents, [[0.1, 0.3]], rtol=1e-12)


def test_section_extents_do_not_jump_when_the_obstacle_turns():
    angles = np.linspace(0.0, np.pi, 721)
    R_WO = Rotation.from_rotvec(angles[:, None] * (0.0, 0.0, 1.0)).as_matrix()
    n = len(angles)
    extents = section_extents(
        np.zeros(3),
        np.array([1.0, 0.1, 0.0]),
        np.eye(3),
        shapes(np.tile([0.5, 0.0, 0.0], (n, 1)), R_WO, np.tile([0.05, 0.25, 0.1], (n, 1))),
    )
    assert np.abs(np.diff(extents, axis=0)).max() < 2e-3


@settings(max_examples=25)
@given(
    seed=st.integers(0, 10**6),
    exponents=st.one_of(st.just((1.0, 1.0)), st.tuples(*[st.floats(0.1, 2.0)] * 2)),
)
def test_a_section_is_as_wide_as_its_points_in_the_plane(seed, exponents):
    rng = np.random.default_rng(seed)
    p, z, center = rng.normal(size=(3, 3))
    R_WL, R_WO = Rotation.random(2, random_state=rng).as_matrix()
    axes = rng.uniform(0.05, 0.5, 3)
    found = section_extents(p, z, R_WL, shapes([center], [R_WO], [axes], [exponents]))[0]
    normal = np.cross(center - p, z)
    normal /= np.linalg.norm(normal)
    along = R_WL[:, 0] - (R_WL[:, 0] @ normal) * normal
    along /= np.linalg.norm(along)
    across = np.cross(normal, along)
    angle = np.linspace(0.0, 2.0 * np.pi, 4001)
    rays = np.outer(np.cos(angle), along) + np.outer(np.sin(angle), across)
    # Where a ray leaves the shape: F^(lambda_4 / 2) is homogeneous.
    reach = np.exp(-0.5 * exponents[0] * log_inside_outside(rays @ R_WO, axes, exponents))
    expected = [np.abs(reach * np.cos(angle)).max(), np.abs(reach * np.sin(angle)).max()]
    np.testing.assert_allclose(found, expected, rtol=1e-3 if exponents == (1.0, 1.0) else 0.03)
    ellipse = section_extents(p, z, R_WL, shapes([center], [R_WO], [axes], [(1.0, 1.0)]))
    np.testing.assert_array_equal(
        ellipse, section_extents(p, z, R_WL, shapes([center], [R_WO], [axes]))
    )
