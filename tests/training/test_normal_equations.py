"""The normal equations: against the plain formula, blocks, weights, torch, devices."""

import sys

import numpy as np
import pytest

from drake_oa.training import normal_equations
from drake_oa.training.normal_equations import choose_device, least_squares
from drake_oa.training.perceptron import flatten, initial_layers, jacobian

SIZES = [3, 6, 5, 1]


@pytest.fixture
def rows():
    rng = np.random.default_rng(0)
    x = rng.uniform(-1.0, 1.0, (50, 3))
    return x, np.sin(x.sum(axis=1)), rng.uniform(0.0, 2.0, 50)


@pytest.fixture
def layers():
    return initial_layers(SIZES, np.random.default_rng(1))


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("block", [7, 2048])
def test_on_the_cpu_they_are_the_plain_formula(rows, layers, weighted, block, monkeypatch):
    monkeypatch.setattr(normal_equations, "_BLOCK", block)
    x, y, weight = rows
    problem = least_squares(SIZES, x, y, weight if weighted else None)
    output, J = jacobian(layers, x)
    w = weight if weighted else np.ones(len(x))
    gram, gradient, squares = problem.normal_equations(flatten(layers))
    np.testing.assert_allclose(gram, J.T @ (w[:, None] * J), rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(gradient, J.T @ (w * (y - output)), rtol=1e-10, atol=1e-12)
    assert squares == pytest.approx(np.sum(w * (y - output) ** 2), rel=1e-12)
    assert problem.squared_error(flatten(layers)) == pytest.approx(squares, rel=1e-12)


@pytest.mark.parametrize("weighted", [False, True])
def test_torch_agrees_with_numpy(rows, layers, weighted):
    pytest.importorskip("torch")
    x, y, weight = rows
    arguments = (SIZES, x, y, weight if weighted else None)
    ours = least_squares(*arguments)
    # Torch's own CPU device stands in for CUDA: the same code runs there.
    theirs = normal_equations.TorchLeastSquares(*arguments, device="cpu")
    for a, b in zip(
        ours.normal_equations(flatten(layers)),
        theirs.normal_equations(flatten(layers)),
        strict=True,
    ):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-12)
    assert theirs.squared_error(flatten(layers)) == pytest.approx(
        ours.squared_error(flatten(layers)), rel=1e-12
    )


def test_the_number_of_cores_does_not_change_a_bit(rows, layers, monkeypatch):
    monkeypatch.setattr(normal_equations, "_BLOCK", 4)
    x, y, _ = rows
    found = []
    for cores in (1, 3):
        monkeypatch.setattr(normal_equations, "_cores", lambda n=cores: n)
        found.append(least_squares(SIZES, x, y).normal_equations(flatten(layers)))
    np.testing.assert_array_equal(found[0][0], found[1][0])
    np.testing.assert_array_equal(found[0][1], found[1][1])
    assert found[0][2] == found[1][2]


@pytest.mark.parametrize(
    ("x", "y", "weight", "message"),
    [
        (np.zeros((4, 2)), np.zeros(4), None, r"x must be \(N, 3\)"),
        (np.zeros((0, 3)), np.zeros(0), None, r"x must be \(N, 3\)"),
        (np.zeros((4, 3)), np.zeros(3), None, r"and y \(N,\)"),
        (np.full((4, 3), np.nan), np.zeros(4), None, "must be finite"),
        (np.zeros((4, 3)), np.zeros(4), -np.ones(4), "weight must be"),
        (np.zeros((4, 3)), np.zeros(4), np.ones(3), "weight must be"),
    ],
)
def test_rows_that_do_not_fit_are_refused(x, y, weight, message):
    with pytest.raises(ValueError, match=message):
        least_squares(SIZES, x, y, weight)


def test_the_cpu_is_always_there():
    assert choose_device("cpu") == "cpu"
    with pytest.raises(ValueError, match="auto, cpu or cuda, not 'tpu'"):
        choose_device("tpu")


def test_cuda_without_torch_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    assert choose_device("auto") == "cpu"
    with pytest.raises(ValueError, match=r"drake_oa\[train\]"):
        choose_device("cuda")


@pytest.mark.parametrize("present", [False, True])
def test_cuda_is_used_where_torch_finds_it(monkeypatch, present):
    torch = pytest.importorskip("torch")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: present)
    assert choose_device("auto") == ("cuda" if present else "cpu")
    if not present:
        with pytest.raises(ValueError, match="finds no CUDA device"):
            choose_device("cuda")
