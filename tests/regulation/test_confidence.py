"""The probability that the chain's motion keeps what is asked."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from drake_oa.regulation.confidence import N_INPUTS, Confidence
from drake_oa.regulation.network import Network, read_arrays, write_arrays
from drake_oa.regulation.regressor import load_chain, save_chain
from drake_oa.scenario.shipped import package_file

LOWER, UPPER = np.array([0.0, 0.0, 0.0, -0.2, 0.0]), np.array([0.6, 0.6, 0.5, 1.2, 0.6])


def _network(seed: int) -> Network:
    rng = np.random.default_rng(seed)
    weights = (rng.normal(size=(6, N_INPUTS)), 3.0 * rng.normal(size=(1, 6)))
    biases = (rng.normal(size=6), rng.normal(size=1))
    return Network(weights, biases, LOWER, 2.0 / (UPPER - LOWER), 0.0, 1.0, out_min=0.0)


CONFIDENCE = Confidence(_network(3), LOWER, UPPER)


@pytest.fixture(scope="module")
def chain():
    return load_chain(package_file("package://drake_oa/weights/paper_chain_running.safetensors"))


@given(
    arrays(float, (4, N_INPUTS), elements=st.floats(width=64)),
    st.integers(0, 20),
)
def test_is_a_probability_and_nothing_where_the_descriptor_is_not_finite(descriptor, seed):
    found = Confidence(_network(seed), LOWER, UPPER).probability(descriptor)
    assert ((found >= 0.0) & (found <= 1.0)).all()
    assert (found[~np.isfinite(descriptor).all(axis=1)] == 0.0).all()


@given(st.integers(0, 2**32 - 1))
def test_falls_off_away_from_what_was_measured(seed):
    rng = np.random.default_rng(seed)
    rim = rng.uniform(LOWER, UPPER)
    rim[0] = UPPER[0]
    steps = np.array([0.0, 0.01, 0.1, 0.3, 1.0, 100.0])
    found = CONFIDENCE.probability(rim + steps[:, None] * np.eye(N_INPUTS)[0])
    assert (np.diff(found) <= 0.0).all()
    assert found[2] == pytest.approx(found[0] / np.e)
    assert found[-1] < 1e-12


def test_inside_it_is_the_networks_odds():
    descriptor = np.random.default_rng(0).uniform(LOWER, UPPER, (50, N_INPUTS))
    odds = CONFIDENCE.network.evaluate(np.vstack((descriptor.T, np.ones(50))))
    np.testing.assert_allclose(CONFIDENCE.probability(descriptor), 1.0 / (1.0 + np.exp(-odds)))


def test_the_file_gives_back_what_was_kept(chain, tmp_path):
    path = tmp_path / "told.safetensors"
    save_chain(replace(chain, confidence=CONFIDENCE), path)
    descriptor = np.random.default_rng(1).uniform(LOWER - 0.1, UPPER + 0.1, (50, N_INPUTS))
    again = load_chain(path)
    np.testing.assert_array_equal(
        again.confidence.probability(descriptor), CONFIDENCE.probability(descriptor)
    )
    extents, place = [[0.1, 0.12]], 0.4
    found = again.parameters(extents, 0.05, 1.0, place, 0.1)
    np.testing.assert_array_equal(
        found.confidence, CONFIDENCE.probability(np.array([[0.1, 0.12, 0.05, place, 0.1]]))
    )
    # Counted in baselines; no clearance asked is always kept.
    larger = again.parameters(2.0 * np.array(extents), 0.1, 2.0, 2.0 * place, 0.2)
    np.testing.assert_allclose(larger.confidence, found.confidence)
    assert again.parameters(extents, 0.0, 1.0, place, 0.1).confidence.tolist() == [1.0]


def test_weights_without_one_load_and_tell_none(chain, tmp_path):
    path = tmp_path / "old.safetensors"
    save_chain(replace(chain, confidence=None), path)
    old = load_chain(path)
    assert old.confidence is None
    found = old.parameters([[0.1, 0.1]], 0.05, 1.0)
    assert len(found) == 1
    assert len(found.confidence) == 0


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"confidence_lower": np.zeros(4)}, "'confidence_lower' has the shape"),
        ({"confidence_W1": np.zeros((6, 3))}, "'confidence_W1' has the shape"),
        ({"confidence_b2": np.array([np.nan])}, "'confidence_b2' must hold finite numbers"),
        ({"confidence_upper": LOWER}, "'confidence_upper' must exceed 'confidence_lower'"),
        ({"confidence_upper": None}, "lacks the array 'confidence_upper'"),
    ],
)
def test_what_is_wrong_with_a_file_is_named(chain, changed, message, tmp_path):
    path = tmp_path / "wrong.safetensors"
    save_chain(replace(chain, confidence=CONFIDENCE), path)
    held, header = read_arrays(path)
    held = {key: value for key, value in (held | changed).items() if value is not None}
    write_arrays(path, held, header)
    with pytest.raises(ValueError, match=message) as raised:
        load_chain(path)
    assert str(path) in str(raised.value)
