"""The confidence: measured by roll-outs, fitted, and how well it is calibrated."""

from dataclasses import replace

import numpy as np
import pytest

from drake_oa.regulation.regressor import load_chain, section_rows
from drake_oa.scenario.shipped import package_file
from drake_oa.training.confidence import (
    LOWER,
    UPPER,
    ConfidenceRecipe,
    _with_sections,
    calibration,
    draw_scenes,
    fit_confidence,
    with_confidence,
)

FEW = ConfidenceRecipe(scenes=800, held_out=300, epochs=10, batch=50)


def _shipped(name: str):
    return load_chain(package_file(f"package://drake_oa/weights/{name}.safetensors"))


@pytest.fixture(scope="module")
def chain():
    return _shipped("paper_chain_running")


@pytest.fixture(scope="module")
def told(chain):
    return with_confidence(chain, FEW, seed=3)


def test_little_training_tells_more_than_the_bare_range(told):
    _, found = told
    assert found["confidence"].brier < 0.5 * found["in_range"].brier
    for scores in found.values():
        assert scores.scenes.sum() <= FEW.held_out
        assert ((scores.stated >= 0.0) & (scores.stated <= 1.0)).all()


def test_the_networks_stay_as_they_are(chain, told):
    inputs = np.random.default_rng(0).uniform(chain.lower, chain.upper, (20, 3))
    np.testing.assert_array_equal(told[0].evaluate(inputs), chain.evaluate(inputs))
    assert told[0].metadata["nmse"] == chain.metadata["nmse"]
    assert told[0].metadata["confidence"]["scenes"] == FEW.scenes


def test_the_same_seed_gives_the_same_weights(chain, told):
    descriptor = np.random.default_rng(0).uniform(LOWER, UPPER, (20, 5))
    scenes = draw_scenes(chain, FEW.scenes, (3, 0))
    again = fit_confidence(scenes, FEW, 3)
    np.testing.assert_array_equal(
        again.probability(descriptor), told[0].confidence.probability(descriptor)
    )


def test_scenes_lie_inside_and_outside_of_the_range(chain):
    scenes = draw_scenes(chain, 400, (0,))
    assert 0.15 < scenes.in_range.mean() < 0.8
    assert 0.05 < scenes.kept.mean() < 0.95
    assert (scenes.descriptor >= LOWER).all()
    assert (scenes.descriptor <= UPPER).all()


def test_without_a_term_only_what_is_out_of_the_way_keeps_what_is_asked(chain):
    still = replace(chain, networks={**chain.networks, "alpha": _silent(chain)})
    scenes = draw_scenes(still, 400, (1,))
    lambda1, lambda2, asked, along, beside = scenes.descriptor.T
    assert not scenes.kept[(beside < lambda2) & (along > lambda1) & (along + lambda1 < 1.0)].any()
    # What stands out of the plane may be nearer.
    assert scenes.kept[beside - lambda2 > asked + 0.1].mean() > 0.8


def _silent(chain):
    network = chain.networks["alpha"]
    weights = (*network.weights[:-1], 0.0 * network.weights[-1])
    nothing = (0.0 - network.out_offset) * network.out_gain + network.out_min
    return replace(network, weights=weights, biases=(*network.biases[:-1], np.array([nothing])))


def test_ellipsoids_are_drawn_to_their_sections():
    rng = np.random.default_rng(0)
    extents = rng.uniform(0.01, 0.6, (30, 2))
    R_WO, semi_axes = _with_sections(extents, rng)
    np.testing.assert_allclose(np.linalg.det(R_WO), 1.0)
    x, eye = np.array([1.0, 0.0, 0.0]), np.eye(3)
    for row in range(30):
        body = (np.zeros((1, 3)), np.ascontiguousarray(R_WO[row : row + 1]), semi_axes[row][None])
        found, _ = section_rows(np.array([-1.0, -0.3, 0.0]), x, eye, *body)
        np.testing.assert_allclose(found[0], extents[row])


def test_calibration_of_what_is_known():
    rng = np.random.default_rng(0)
    stated = rng.random(100_000)
    true = calibration(stated, rng.random(100_000) < stated)
    assert true.error < 0.01
    assert true.brier == pytest.approx(1.0 / 6.0, abs=0.005)
    sure = calibration(np.array([1.0, 1.0, 0.0, 0.0]), np.array([True, False, False, False]))
    assert (sure.error, sure.brier) == (0.25, 0.25)
    np.testing.assert_array_equal(sure.scenes, [2, 2])


@pytest.mark.parametrize("name", ["paper_chain", "paper_chain_unconstrained"])
def test_a_chain_of_another_action_level_is_refused(name):
    with pytest.raises(ValueError, match="--recipe paper_running or project"):
        draw_scenes(_shipped(name), 10, (0,))
