"""One network: what its layers compute, that training goes on as before, devices."""

import numpy as np
import pytest
import torch

from drake_oa.training.checkpoint import Checkpoint
from drake_oa.training.networks import (
    Perceptron,
    Round,
    Schedule,
    choose_device,
    nmse,
    predict,
    train_network,
)

ROUNDS = (Round(3, 100), Round(2, 300))


@pytest.fixture(scope="module")
def rows():
    x = np.random.default_rng(0).uniform(0.0, 5.0, (300, 2))
    return x, np.exp(0.3 * x[:, 0]) + x[:, 1]


def trained(rows, **options):
    return train_network("y", *rows, Schedule(), seed=(1, 2), rounds=ROUNDS, **options)


def test_the_layers_are_drawn_by_seed_and_computed_in_float64():
    first, again, other = (Perceptron(3, np.random.default_rng(seed)) for seed in (0, 0, 1))
    x = torch.rand(5, 3, dtype=torch.float64)
    y = x.numpy().T
    weights, biases = first.arrays()
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        y = np.tanh(weight @ y + bias[:, None])
    expected = (weights[-1] @ y)[0] + biases[-1]
    np.testing.assert_allclose(first(x).detach().numpy(), expected, rtol=1e-12)
    assert torch.equal(first(x), again(x))
    assert not torch.equal(first(x), other(x))


def test_a_network_predicts_what_it_was_trained_on(rows):
    x, y = rows
    assert nmse(y, predict(trained(rows), x)) < 5e-3


@pytest.mark.parametrize("stop", [2, 4])
def test_after_an_interruption_the_network_is_the_same(rows, tmp_path, stop):
    told = []

    def interrupt(stage, fraction):
        told.append(fraction)
        if len(told) == stop:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        trained(rows, checkpoint=Checkpoint(tmp_path, {}), report=interrupt)
    again = trained(
        rows, checkpoint=Checkpoint(tmp_path, {}), report=lambda _, fraction: told.append(fraction)
    )
    assert told == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0])
    for ours, theirs in zip(trained(rows).weights, again.weights, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_the_cpu_is_always_there():
    assert choose_device("cpu") == "cpu"
    with pytest.raises(ValueError, match="auto, cpu or cuda, not 'tpu'"):
        choose_device("tpu")


@pytest.mark.parametrize("present", [False, True])
def test_cuda_is_used_where_torch_finds_it(monkeypatch, present):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: present)
    assert choose_device("auto") == ("cuda" if present else "cpu")
    if present:
        assert choose_device("cuda") == "cuda"
    else:
        with pytest.raises(ValueError, match="finds no CUDA device"):
            choose_device("cuda")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_cuda_trains_the_same_network(rows):
    ours, theirs = (predict(trained(rows, device=device), rows[0]) for device in ("cpu", "cuda"))
    np.testing.assert_allclose(ours, theirs, rtol=1e-6)
