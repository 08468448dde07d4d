"""Tests of the regressor chain: forward pass, weights files, sections of ellipsoids."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from safetensors import safe_open
from safetensors.numpy import load_file, save_file
from scipy.spatial.transform import Rotation

from drake_oa.inference.regressor import (
    TARGETS,
    ChainWeights,
    Network,
    load_chain,
    network_of,
    save_chain,
    section_extents,
)
from tests.builders import balls


def random_chain(n_inputs=3):
    rng, networks = np.random.default_rng(3), {}
    for name, more in zip(TARGETS, range(3), strict=True):
        sizes = [n_inputs + more, 24, 24, 1]
        networks[name] = Network(
            tuple(
                0.3 * rng.standard_normal(shape) for shape in zip(sizes[1:], sizes, strict=False)
            ),
            tuple(0.3 * rng.standard_normal(rows) for rows in sizes[1:]),
            in_offset=rng.uniform(0.0, 0.1, sizes[0]),
            in_gain=rng.uniform(2.0, 5.0, sizes[0]),
            out_offset=0.3,
            out_gain=0.7,
        )
    return ChainWeights(networks, np.full(n_inputs, 0.02), np.full(n_inputs, 0.4), {"seed": 3})


CHAIN = random_chain()


def plain_forward(net, x):
    """Evaluates a network by the formula of its docstring, for one input."""
    y = (x - net.in_offset) * net.in_gain - 1.0
    for weight, bias in zip(net.weights[:-1], net.biases[:-1], strict=True):
        y = np.tanh(weight @ y + bias)
    y = net.weights[-1] @ y + net.biases[-1]
    return (y[0] + 1.0) / net.out_gain + net.out_offset


def test_the_chain_equals_its_networks_in_sequence():
    query = np.array([0.1, 0.2, 0.15])
    kappa = plain_forward(CHAIN.networks["kappa"], query)
    psi = plain_forward(CHAIN.networks["psi"], np.append(query, kappa))
    alpha = plain_forward(CHAIN.networks["alpha"], np.append(query, (kappa, psi)))
    np.testing.assert_allclose(CHAIN.evaluate(query[None])[0], (alpha, psi, kappa), rtol=1e-12)
    # In physical units, with a baseline of 2 m.
    rows = CHAIN.parameters(2.0 * query[None, :2], 0.3, 2.0).as_array()
    np.testing.assert_allclose(rows[0], (max(alpha, 0), psi, kappa / 4.0), rtol=1e-12)


def test_the_authors_chain_reproduces_their_samples(reference):
    """Evaluates the released chain, trained on full widths and a baseline of 1 m."""
    path, samples = reference("authors_rc.npz"), np.load(reference("authors_rc_samples.npz"))
    with np.load(path) as file:
        networks = {n: network_of(path, dict(file), n, 3 + i) for i, n in enumerate(TARGETS)}
    inputs = np.column_stack((samples["widths"], samples["clearance"]))
    outputs = replace(CHAIN, networks=networks).evaluate(inputs)
    expected = np.column_stack([samples[name] for name in ("alpha", "psi", "kappa")])
    np.testing.assert_allclose(outputs, expected, rtol=1e-9, atol=1e-9)


def test_an_input_outside_the_trained_range_is_flagged_and_clipped():
    extents = np.array([[0.1, 0.7], [0.1, 0.4], [0.001, 0.1]])
    outside = CHAIN.parameters(extents, 0.1, 1.0)
    assert outside.in_range.tolist() == [False, True, False]
    assert outside.alpha[0] == pytest.approx(outside.alpha[1], rel=1e-12)


@pytest.mark.parametrize("n_inputs", [2, 3])
def test_a_saved_chain_is_loaded_unchanged(tmp_path, n_inputs):
    path, chain = tmp_path / "chain.safetensors", random_chain(n_inputs)
    save_chain(chain, path)
    loaded = load_chain(path)
    ours, theirs = (one.parameters(np.full((1, 2), 0.1), 0.2, 1.0) for one in (chain, loaded))
    np.testing.assert_array_equal(ours.as_array(), theirs.as_array())
    assert ours.in_range.all()
    assert loaded.metadata == chain.metadata
    # A chain of two inputs does not depend on the clearance.
    other = loaded.parameters(np.full((1, 2), 0.1), 0.3, 1.0)
    assert (other.as_array() == theirs.as_array()).all() == (n_inputs == 2)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("psi_b1", None, "lacks the array 'psi_b1'"),
        ("alpha_in_gain", np.ones(4), r"'alpha_in_gain' has the shape \(4,\)"),
        ("kappa_b1", np.full(24, np.nan), "'kappa_b1' must contain only finite numbers"),
        ("metadata", None, "has the format None; it must be 'drake_oa regressor chain 1'"),
    ],
)
def test_the_error_of_a_damaged_file_names_file_and_problem(tmp_path, key, value, message):
    path = tmp_path / "chain.safetensors"
    save_chain(CHAIN, path)
    with safe_open(path, "numpy") as file:
        items = {**load_file(path), **file.metadata(), key: value}
    header = {"metadata": items.pop("metadata")}
    arrays = {name: array for name, array in items.items() if array is not None}
    save_file(arrays, path, header if header["metadata"] else None)
    with pytest.raises(ValueError, match=f"chain.safetensors.*{message}"):
        load_chain(path)


def test_the_error_of_a_missing_or_other_file_names_it(tmp_path):
    path = tmp_path / "noise.safetensors"
    with pytest.raises(FileNotFoundError, match=r"noise.safetensors.*--recipe paper_running"):
        load_chain(path)
    path.write_bytes(b"not weights at all")
    with pytest.raises(ValueError, match=r"noise.safetensors cannot be read"):
        load_chain(path)


@pytest.mark.parametrize(
    ("p", "z"),
    [
        ([0.0, 0.0, 0.0], [1.0, 0.0, 0.0]),
        ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0]),
        ([0.5, 0.0, 0.0], [1.0, 0.3, 0.0]),
    ],
    ids=["heading at the center", "at rest", "at the center"],
)
def test_parallel_vectors_select_the_local_vertical_plane(p, z):
    shape = balls((0.5, 0.0, 0.0), radius=[0.1, 0.2, 0.3])
    extents = section_extents(np.array(p), np.array(z), np.eye(3), shape)
    np.testing.assert_allclose(extents, [[0.1, 0.3]], rtol=1e-12)


@given(seed=st.integers(0, 10**6))
def test_half_extents_equal_those_of_sampled_points_of_the_section(seed):
    rng = np.random.default_rng(seed)
    p, z, center = rng.normal(size=(3, 3))
    R_WL, R_WO = Rotation.random(2, random_state=rng).as_matrix()
    shape = replace(balls(center, radius=rng.uniform(0.05, 0.5, 3)), R_WO=R_WO[None])
    extents = section_extents(p, z, R_WL, shape)[0]
    normal = np.cross(center - p, z)
    normal /= np.linalg.norm(normal)
    along = R_WL[:, 0] - (R_WL[:, 0] @ normal) * normal
    along /= np.linalg.norm(along)
    angle = np.linspace(0.0, 2.0 * np.pi, 4001)[:, None]
    rays = np.cos(angle) * along + np.sin(angle) * np.cross(normal, along)
    reach = 1.0 / np.linalg.norm(rays @ R_WO / shape.semi_axes, axis=1, keepdims=True)
    expected = np.abs(reach * np.hstack([np.cos(angle), np.sin(angle)])).max(axis=0)
    np.testing.assert_allclose(extents, expected, rtol=1e-3)
