"""The released code's motion without a compiled kernel, for timing against it.

Both do the work of `drake_oa.training.released_kernels.released_batch` step by step on whole
blocks: float32, in place, the distance to the ellipse by one warm-started curvature
iteration a step; rows that touched are dropped every `SIFT` steps. (NumPy's `hypot` and
`clip` take several times as long as what stands there for them.)
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

SingleArray = NDArray[np.float32]

NUMPY_BLOCK = 16384
"""Rows of a block for NumPy: its thirty arrays take 2 MiB, a second-level cache. In smaller
blocks the calls cost more than they save once most rows have touched."""

TORCH_BLOCK = 16384
"""Rows of a block for torch, whose calls cost more."""

SIFT = 16
"""Steps after which the rows that touched are dropped."""

LEAST_EXPONENT = -40.0
"""Of the turning rate: what is less turns nothing, but denormal numbers take most of the time."""

LEAST_SINE = 1e-11
"""Of the nearest point's parameter, for the same reason."""


def numpy_rollouts(
    semi_axes: SingleArray,
    parameters: SingleArray,
    drive: SingleArray,
    dt: float = 0.003,
    alpha_x: float = 10.0,
    beta_x: float = 2.5,
    block: int = NUMPY_BLOCK,
) -> SingleArray:
    """The roll-outs in NumPy, one block that fits the cache after another.

    Args:
        semi_axes: (N, 2) along and across the baseline of 1 m [m].
        parameters: (N, 3) alpha, psi, kappa.
        drive: (steps,) forcing term.
        dt: length of a step [s].
        alpha_x: spring constant.
        beta_x: spring constant.
        block: rows of a block.

    Returns:
        (3, N) clearance at the samples (0: touched), goal error and path length (inf).
    """
    out = np.empty((3, len(semi_axes)), np.float32)
    for first in range(0, len(semi_axes), block):
        rows = slice(first, first + block)
        _numpy_block(semi_axes[rows], parameters[rows], drive, dt, alpha_x, beta_x, out[:, rows])
    return out


def _numpy_block(
    semi_axes: SingleArray,
    parameters: SingleArray,
    drive: SingleArray,
    dt: float,
    alpha_x: float,
    beta_x: float,
    out: SingleArray,
) -> None:
    h, zero, one = np.float32(dt), np.float32(0.0), np.float32(1.0)
    least_exponent, least_sine = np.float32(LEAST_EXPONENT), np.float32(LEAST_SINE)
    a, b = semi_axes.T
    state = np.zeros((10, len(a)), np.float32)  # x y vx vy length least depth tx ty row
    state[5:7] = np.inf
    state[7:9] = math.sqrt(0.5)
    state[9] = np.arange(len(a))
    tau2 = np.square(np.sqrt(1.0 + 4.0 * b * b) + np.float32(0.1))
    alpha, psi, kappa = parameters.T
    facts = np.stack(
        (
            alpha, -1.0 / (psi * psi), kappa, tau2 * np.float32(alpha_x * beta_x),
            tau2 * np.float32(alpha_x), a, b, (a * a - b * b) / a, (b * b - a * a) / b,
            1.0 / a, 1.0 / b,
        )
    ).astype(np.float32)  # fmt: skip
    out[0], out[1:] = 0.0, np.inf
    work = np.empty((10, len(a)), np.float32)
    for step, push in enumerate(drive):
        if step % SIFT == 0:
            alive = state[6] > 1.0
            if not alive.all():
                state, facts = state[:, alive], facts[:, alive]
                work = np.empty((10, state.shape[1]), np.float32)
            if not state.shape[1]:
                return
        x, y, vx, vy, length, least, depth, tx, ty, _ = state
        alpha, shape, kappa, stiffness, damping, a, b, ea, eb, inverse_a, inverse_b = facts
        dx, cross, dot, rate, ax, ay, px, py, u, w = work
        np.subtract(np.float32(0.5), x, out=dx)
        # The way to the centre is (dx, -y).
        np.multiply(vx, y, out=cross)
        np.multiply(vy, dx, out=u)
        cross += u
        np.multiply(vx, dx, out=dot)
        np.multiply(vy, y, out=u)
        dot -= u
        np.abs(cross, out=u)
        np.arctan2(u, dot, out=rate)
        rate *= rate
        rate *= shape
        np.multiply(dx, dx, out=u)
        np.multiply(y, y, out=w)
        u += w
        u *= kappa
        rate -= u
        np.maximum(rate, least_exponent, out=rate)
        np.exp(rate, out=rate)
        rate *= alpha
        # cross is that of (dx, -y) and v, of the other sign.
        np.copysign(rate, cross, out=rate)
        np.subtract(np.float32(1.0), x, out=ax)
        ax *= stiffness
        ax += push
        np.multiply(damping, vx, out=u)
        ax -= u
        np.multiply(rate, vy, out=u)
        ax -= u
        np.multiply(rate, vx, out=ay)
        np.multiply(stiffness, y, out=u)
        ay -= u
        np.multiply(damping, vy, out=u)
        ay -= u
        ax *= h
        vx += ax
        ay *= h
        vy += ay
        np.multiply(vx, h, out=ax)
        x += ax
        np.multiply(vy, h, out=ay)
        y += ay
        ax *= ax
        ay *= ay
        np.add(ax, ay, out=u)
        np.sqrt(u, out=u)
        length += u
        # One curvature iteration; evolute in (ax, ay), radius in rate, distance in u.
        np.subtract(x, np.float32(0.5), out=px)
        np.abs(px, out=px)
        np.abs(y, out=py)
        np.multiply(tx, tx, out=ax)
        ax *= tx
        ax *= ea
        np.multiply(ty, ty, out=ay)
        ay *= ty
        ay *= eb
        tx *= a
        tx -= ax
        ty *= b
        ty -= ay
        tx *= tx
        ty *= ty
        np.add(tx, ty, out=rate)
        np.subtract(px, ax, out=tx)
        np.subtract(py, ay, out=ty)
        np.multiply(tx, tx, out=u)
        np.multiply(ty, ty, out=w)
        u += w
        rate /= u
        np.sqrt(rate, out=rate)
        tx *= rate
        tx += ax
        tx *= inverse_a
        ty *= rate
        ty += ay
        ty *= inverse_b
        np.maximum(tx, zero, out=tx)
        np.minimum(tx, one, out=tx)
        np.maximum(ty, least_sine, out=ty)
        np.minimum(ty, one, out=ty)
        np.multiply(tx, tx, out=u)
        np.multiply(ty, ty, out=w)
        u += w
        np.sqrt(u, out=u)
        tx /= u
        ty /= u
        np.multiply(px, inverse_a, out=ax)
        np.multiply(py, inverse_b, out=ay)
        ax *= ax
        ay *= ay
        ax += ay
        np.minimum(depth, ax, out=depth)
        np.multiply(a, tx, out=u)
        px -= u
        np.multiply(b, ty, out=u)
        py -= u
        px *= px
        py *= py
        np.add(px, py, out=u)
        np.sqrt(u, out=u)
        np.minimum(least, u, out=least)
    state = state[:, state[6] > 1.0]
    rows = state[9].astype(np.intp)
    out[0, rows], out[1, rows] = state[5], np.hypot(state[0] - 1.0, state[1])
    out[2, rows] = state[4]


def torch_rollouts(
    semi_axes: SingleArray,
    parameters: SingleArray,
    drive: SingleArray,
    dt: float = 0.003,
    alpha_x: float = 10.0,
    beta_x: float = 2.5,
    block: int = TORCH_BLOCK,
) -> SingleArray:
    """As `numpy_rollouts` by torch's eager operations.

    Args:
        semi_axes: (N, 2) along and across the baseline of 1 m [m].
        parameters: (N, 3) alpha, psi, kappa.
        drive: (steps,) forcing term.
        dt: length of a step [s].
        alpha_x: spring constant.
        beta_x: spring constant.
        block: rows of a block.

    Returns:
        (3, N) clearance at the samples (0: touched), goal error and path length (inf).

    Raises:
        ImportError: if torch is not installed.
    """
    import torch

    out = torch.empty((3, len(semi_axes)))
    with torch.inference_mode():
        for first in range(0, len(semi_axes), block):
            rows = slice(first, first + block)
            _torch_block(
                torch, torch.tensor(semi_axes[rows]), torch.tensor(parameters[rows]),
                drive.tolist(), dt, alpha_x, beta_x, out[:, rows],
            )  # fmt: skip
    return np.asarray(out.numpy())


def _torch_block(
    torch: Any,
    semi_axes: Any,
    parameters: Any,
    drive: list[float],
    dt: float,
    alpha_x: float,
    beta_x: float,
    out: Any,
) -> None:
    a, b = semi_axes.T.contiguous()
    alpha, psi, kappa = parameters.T.contiguous()
    state = torch.zeros((9, len(a)))  # x y vx vy length least depth tx ty
    state[5:7] = math.inf
    state[7:9] = math.sqrt(0.5)
    row = torch.arange(len(a))
    tau2 = ((1.0 + 4.0 * b * b).sqrt() + 0.1) ** 2
    facts = torch.stack(
        (
            alpha, -1.0 / (psi * psi), kappa, tau2 * alpha_x * beta_x, tau2 * alpha_x, a, b,
            (a * a - b * b) / a, (b * b - a * a) / b, 1.0 / a, 1.0 / b,
        )
    )  # fmt: skip
    out[0], out[1:] = 0.0, math.inf
    for step, push in enumerate(drive):
        if step % SIFT == 0:
            alive = state[6] > 1.0
            if not bool(alive.all()):
                state, facts, row = state[:, alive], facts[:, alive], row[alive]
            if not len(row):
                return
        x, y, vx, vy, length, least, depth, tx, ty = state
        alpha, shape, kappa, stiffness, damping, a, b, ea, eb, inverse_a, inverse_b = facts
        dx = 0.5 - x
        # The way to the centre is (dx, -y); cross is of the other sign.
        cross = torch.addcmul(vx * y, vy, dx)
        dot = torch.addcmul(vx * dx, vy, y, value=-1.0)
        theta = torch.atan2(cross.abs(), dot)
        distance2 = torch.addcmul(dx.square(), y, y)
        exponent = theta.square_().mul_(shape).addcmul_(kappa, distance2, value=-1.0)
        rate = exponent.clamp_(min=LEAST_EXPONENT).exp_().mul_(alpha).copysign_(cross)
        ax = (1.0 - x).mul_(stiffness).add_(push)
        ax.addcmul_(damping, vx, value=-1.0).addcmul_(rate, vy, value=-1.0)
        ay = (rate * vx).addcmul_(stiffness, y, value=-1.0)
        ay.addcmul_(damping, vy, value=-1.0)
        vx.add_(ax, alpha=dt)
        vy.add_(ay, alpha=dt)
        x.add_(vx, alpha=dt)
        y.add_(vy, alpha=dt)
        length.add_(torch.hypot(vx, vy), alpha=dt)
        px, py = (x - 0.5).abs_(), y.abs()
        ex, ey = tx.pow(3).mul_(ea), ty.pow(3).mul_(eb)
        radius = torch.hypot(tx.mul_(a).sub_(ex), ty.mul_(b).sub_(ey))
        qx, qy = px - ex, py - ey
        radius.div_(torch.hypot(qx, qy))
        torch.addcmul(ex, qx, radius, out=tx)
        torch.addcmul(ey, qy, radius, out=ty)
        tx.mul_(inverse_a).clamp_(0.0, 1.0)
        ty.mul_(inverse_b).clamp_(LEAST_SINE, 1.0)
        size = torch.hypot(tx, ty)
        tx.div_(size)
        ty.div_(size)
        inside = (px * inverse_a).square_().add_((py * inverse_b).square_())
        torch.minimum(depth, inside, out=depth)
        px.addcmul_(a, tx, value=-1.0)
        py.addcmul_(b, ty, value=-1.0)
        torch.minimum(least, torch.hypot(px, py), out=least)
    kept = state[6] > 1.0
    state, row = state[:, kept], row[kept]
    out[0, row], out[1, row] = state[5], torch.hypot(state[0] - 1.0, state[1])
    out[2, row] = state[4]
