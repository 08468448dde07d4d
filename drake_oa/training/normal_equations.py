"""The normal equations of a perceptron's least squares: on the CPU, or by torch.

Both classes give the same figures to rounding. The one on the CPU works on blocks of rows, one
a core, and adds the blocks up in their order: the result is the same to the last bit
whatever the number of cores. BLAS itself should be held to one thread.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import numpy as np

from drake_oa.common.messages import FloatArray
from drake_oa.training.perceptron import forward, jacobian, unflatten

if TYPE_CHECKING:
    import torch

_BLOCK = 2048
"""Rows a block: the derivatives of one (22 MB) take part in one matrix product."""

T = TypeVar("T")


class LeastSquares(Protocol):
    """Sum of w_i (y_i - network(x_i; parameters))^2 over the rows."""

    n_parameters: int

    def squared_error(self, parameters: FloatArray) -> float:
        """The sum at parameters (P,)."""

    def normal_equations(self, parameters: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """J^T W J (P, P), J^T W (y - network) (P,), and the sum."""


class CpuLeastSquares:
    """Least squares by NumPy and SciPy, on all cores that the process may use."""

    def __init__(
        self, sizes: list[int], x: FloatArray, y: FloatArray, weight: FloatArray | None = None
    ) -> None:
        """See `least_squares`."""
        self._sizes = sizes
        self._x, self._y = x, y
        self._root = None if weight is None else np.sqrt(weight)
        self._blocks = [slice(i, i + _BLOCK) for i in range(0, len(x), _BLOCK)]
        self.n_parameters = _count(sizes)

    def squared_error(self, parameters: FloatArray) -> float:
        """The sum at parameters (P,)."""
        layers = unflatten(parameters, self._sizes)

        def block(rows: slice) -> float:
            error = self._weighted(self._y[rows] - forward(layers, self._x[rows]), rows)
            return float(error @ error)

        return sum(self._each(block))

    def normal_equations(self, parameters: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """J^T W J (P, P), J^T W (y - network) (P,), and the sum."""
        layers = unflatten(parameters, self._sizes)

        def block(rows: slice) -> tuple[FloatArray, FloatArray, float]:
            output, J = jacobian(layers, self._x[rows])
            error = self._weighted(self._y[rows] - output, rows)
            if self._root is not None:
                J *= self._root[rows, None]
            # NumPy sees the symmetry and takes half the work (BLAS syrk).
            return J.T @ J, error @ J, float(error @ error)

        gram = np.zeros((self.n_parameters, self.n_parameters))
        gradient, total = np.zeros(self.n_parameters), 0.0
        for part, slope, squares in self._each(block):
            gram += part
            gradient += slope
            total += squares
        return gram, gradient, total

    def _weighted(self, error: FloatArray, rows: slice) -> FloatArray:
        return error if self._root is None else error * self._root[rows]

    def _each(self, block: Callable[[slice], T]) -> Iterator[T]:
        """The blocks' results in order; no more of them at once than there are cores."""
        cores = min(_cores(), len(self._blocks))
        with ThreadPoolExecutor(cores) as pool:
            waiting: deque[Any] = deque()
            for rows in self._blocks:
                if len(waiting) > cores:
                    yield waiting.popleft().result()
                waiting.append(pool.submit(block, rows))
            while waiting:
                yield waiting.popleft().result()


class TorchLeastSquares:
    """Least squares by torch in float64, on a device of its own."""

    def __init__(
        self,
        sizes: list[int],
        x: FloatArray,
        y: FloatArray,
        weight: FloatArray | None = None,
        *,
        device: str = "cuda",
    ) -> None:
        """See `least_squares`."""
        import torch

        def tensor(values: FloatArray) -> torch.Tensor:
            return torch.tensor(values, dtype=torch.float64, device=device)

        self._tensor, self._sizes = tensor, sizes
        self._x, self._y = tensor(x), tensor(y)
        self._root = torch.ones_like(self._y) if weight is None else tensor(np.sqrt(weight))
        self.n_parameters = _count(sizes)
        # Blocks of about 1 GB of derivatives.
        self._block = max(1, 2**27 // self.n_parameters)

    def squared_error(self, parameters: FloatArray) -> float:
        """The sum at parameters (P,)."""
        layers = self._layers(parameters)
        total = 0.0
        for x, y, root in self._each():
            error = (y - self._activations(layers, x)[-1][:, 0]) * root
            total += float(error @ error)
        return total

    def normal_equations(self, parameters: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """J^T W J (P, P), J^T W (y - network) (P,), and the sum."""
        import torch

        layers = self._layers(parameters)
        gram = torch.zeros((self.n_parameters,) * 2, dtype=torch.float64, device=self._x.device)
        gradient, total = torch.zeros_like(gram[0]), 0.0
        for x, y, root in self._each():
            values = self._activations(layers, x)
            error = (y - values[-1][:, 0]) * root
            sensitivity = root[:, None]
            blocks: list[torch.Tensor] = []
            for i in range(len(layers) - 1, -1, -1):
                by_weights = sensitivity[:, :, None] * values[i][:, None, :]
                blocks += [sensitivity, by_weights.flatten(1)]
                if i:
                    sensitivity = (sensitivity @ layers[i][0]) * (1.0 - values[i] ** 2)
            J = torch.cat(blocks[::-1], dim=1)
            gram += J.T @ J
            gradient += error @ J
            total += float(error @ error)
        return gram.cpu().numpy(), gradient.cpu().numpy(), total

    def _layers(self, parameters: FloatArray) -> list[tuple[torch.Tensor, torch.Tensor]]:
        return [(self._tensor(w), self._tensor(b)) for w, b in unflatten(parameters, self._sizes)]

    def _activations(
        self, layers: list[tuple[torch.Tensor, torch.Tensor]], x: torch.Tensor
    ) -> list[torch.Tensor]:
        """The inputs of each layer, and the output."""
        values = [x]
        for weight, bias in layers[:-1]:
            values.append((values[-1] @ weight.T + bias).tanh())
        weight, bias = layers[-1]
        values.append(values[-1] @ weight.T + bias)
        return values

    def _each(self) -> Iterator[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
        for i in range(0, len(self._x), self._block):
            rows = slice(i, i + self._block)
            yield self._x[rows], self._y[rows], self._root[rows]


def choose_device(asked: str) -> str:
    """Where to train: "cpu" (NumPy) or "cuda" (torch).

    Args:
        asked: "cpu", "cuda", or "auto" for CUDA where torch has it.

    Returns:
        "cpu" or "cuda".

    Raises:
        ValueError: if CUDA is asked for and torch or a device is missing, or for any
            other name.
    """
    if asked not in ("auto", "cpu", "cuda"):
        raise ValueError(f"device must be auto, cpu or cuda, not {asked!r}")
    if asked == "cpu":
        return "cpu"
    try:
        import torch
    except ImportError:
        if asked == "auto":
            return "cpu"
        raise ValueError(
            "device cuda needs torch, which is not installed: pip install 'drake_oa[train]'"
        ) from None
    if torch.cuda.is_available():
        return "cuda"
    if asked == "cuda":
        raise ValueError(
            f"device cuda was asked for, but torch {torch.__version__} finds no CUDA device; "
            "use --device cpu"
        )
    return "cpu"


def least_squares(
    sizes: list[int],
    x: FloatArray,
    y: FloatArray,
    weight: FloatArray | None = None,
    *,
    device: str = "cpu",
) -> LeastSquares:
    """The least-squares problem of a network and rows.

    Args:
        sizes: widths of the network from input to output.
        x: (N, d) inputs, about within [-1, 1].
        y: (N,) targets, about within [-1, 1].
        weight: (N,) not negative; None: 1 for each.
        device: "cpu" for NumPy, else the name of a torch device.

    Returns:
        The problem.

    Raises:
        ValueError: if shapes do not fit, or values are not finite.
    """
    if x.ndim != 2 or y.shape != (len(x),) or x.shape[1] != sizes[0] or not len(x):
        raise ValueError(f"x must be (N, {sizes[0]}) and y (N,), not {x.shape} and {y.shape}")
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise ValueError("x and y must be finite")
    if weight is not None and (weight.shape != y.shape or not (weight >= 0.0).all()):
        raise ValueError("weight must be (N,) and not negative")
    if device == "cpu":
        return CpuLeastSquares(sizes, x, y, weight)
    return TorchLeastSquares(sizes, x, y, weight, device=device)


def _count(sizes: list[int]) -> int:
    return sum(n_out * (n_in + 1) for n_in, n_out in pairwise(sizes))


def _cores() -> int:
    """How many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
