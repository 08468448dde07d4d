"""The motions of `drake_oa.regulation.rollout` in NumPy, step by step."""

from __future__ import annotations

import numpy as np
from scipy.linalg import expm

from drake_oa.common.messages import FloatArray, IntArray
from drake_oa.geometry.ellipsoid import signed_distance
from drake_oa.policy.coupling import ALPHA, KAPPA, NORMAL, PSI
from drake_oa.policy.dmp import Dmp
from drake_oa.regulation.rollout import SpatialRollouts, SpatialScenes, default_dmp


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.einsum("ni,ni->n", a, b)


def turned(p: FloatArray, z: FloatArray, terms: FloatArray, step: float | FloatArray) -> FloatArray:
    """z (N, 3) after a step of one avoidance term each (N, 13), about its normal.

    The angle theta from the way to the point to z, in the term's plane, grows at
    alpha exp(-kappa d^2) exp(-theta^2 / psi^2); the growth over the step is taken in closed form
    (docs/equations.md) and ends straight away from the point.
    """
    n, alpha, psi = terms[:, NORMAL : NORMAL + 3], terms[:, ALPHA], terms[:, PSI]
    o = terms[:, :3] - p
    sine = _dot(n, np.cross(o, z))
    cosine = _dot(o, z) - _dot(o, n) * _dot(z, n)
    aligned = sine**2 <= 1e-18 * _dot(o, o) * _dot(z, z)
    sine = np.where(aligned, 0.0, sine)
    theta = np.arctan2(np.abs(sine), cosine)
    u = theta / psi
    c = alpha * step * np.exp(-terms[:, KAPPA] * _dot(o, o) - u**2) / psi
    grown = np.log1p(c * (2.0 * u + np.arcsinh(c / np.sqrt(1.0 + 2.0 * u * c))))
    turn = psi * grown / np.maximum(u + np.sqrt(u**2 + grown), 1e-300)
    turn = np.where(c < 1e-14, c * psi, np.minimum(turn, np.pi - theta))
    turn = np.where((c * psi < 1e-11) | (aligned & (cosine <= 0.0)), 0.0, turn)
    turn = np.where(sine < 0.0, -turn, turn)[:, None]
    along = _dot(z, n)[:, None] * n
    return along + np.cos(turn) * (z - along) + np.sin(turn) * np.cross(n, z)


def forcing(dmp: Dmp, k: float) -> FloatArray:
    """(3,) f(k) / (alpha_x beta_x) for a unit baseline along x."""
    basis = np.exp(-dmp.widths * (k - dmp.centers) ** 2)
    return dmp.weights @ basis * k / (basis.sum() * dmp.alpha_x * dmp.beta_x)


def rollouts(
    scenes: SpatialScenes,
    scene: IntArray,
    terms: FloatArray,
    *,
    seconds: float | FloatArray = 1.0,
    dmp: Dmp | None = None,
    steps: int = 500,
    end: float = 1.0,
    horizon: float | None = None,
    fade: float = 0.0,
    tolerance: float = 0.0,
) -> SpatialRollouts:
    """As `spatial_rollouts`, of paths that are looked at to their end."""
    dmp = dmp or default_dmp()
    N, ds = len(scene), 1.0 / steps
    L, R, goal = scenes.baseline[scene], scenes.R_WL[scene], scenes.p_WG[scene]
    half = expm(0.5 * ds * np.array([[0.0, 1.0], [-dmp.alpha_x * dmp.beta_x, -dmp.alpha_x]]))
    p, z = scenes.p_WE[scene], scenes.z_W[scene]
    path, velocity = [p], [z]
    for i in range(round(((horizon or end) - scenes.s) * steps)):
        k = float(dmp.phase(scenes.s + (i + 0.5) * ds))
        rest = goal + L[:, None] * (R @ forcing(dmp, k))
        left = np.linalg.norm(goal - p, axis=1)
        near = np.minimum(left / (fade * L), 1.0) ** 4 if fade else np.ones(N)
        p, z = (
            rest + half[0, 0] * (p - rest) + half[0, 1] * z,
            half[1, 0] * (p - rest) + half[1, 1] * z,
        )
        faded = terms.copy()
        faded[:, ALPHA] *= near
        z = turned(p, z, faded, ds)
        p, z = (
            rest + half[0, 0] * (p - rest) + half[0, 1] * z,
            half[1, 0] * (p - rest) + half[1, 1] * z,
        )
        path.append(p)
        velocity.append(z)
    return _account(
        scenes, scene, np.stack(path, 1), np.stack(velocity, 1), steps, end, tolerance, seconds
    )


def _account(
    scenes: SpatialScenes,
    scene: IntArray,
    path: FloatArray,
    velocity: FloatArray,
    steps: int,
    end: float,
    tolerance: float,
    seconds: float | FloatArray,
) -> SpatialRollouts:
    """What the paths (N, n + 1, 3) came to, each until it arrives."""
    N, last = len(scene), path.shape[1] - 1
    error = np.linalg.norm(path - scenes.p_WG[scene][:, None], axis=2)
    arrived = (error < tolerance) & (np.linalg.norm(velocity, axis=2) < 20.0 * tolerance)
    arrived[:, : round((end - scenes.s) * steps)] = False
    taken = np.where(arrived.any(axis=1), arrived.argmax(axis=1), last)
    after = np.arange(last + 1) > taken[:, None]
    length = np.linalg.norm(np.diff(path, axis=1), axis=2)
    length = np.where(after[:, 1:], 0.0, length).sum(axis=1)
    time = np.arange(last + 1) * np.broadcast_to(seconds, N)[:, None] / steps
    distance = distances(scenes, scene, path, time)
    at_end = np.take_along_axis(time, taken[:, None], 1)
    at_goal = distances(scenes, scene, scenes.p_WG[scene][:, None], at_end)[:, 0]
    feasible = np.minimum(scenes.asked_clearance[scene], np.minimum(distance[:, 0], at_goal))
    least = np.where(after[:, :, None], np.inf, distance).min(axis=1)
    return SpatialRollouts(
        margin=np.nanmin(least - feasible, axis=1, initial=np.inf),
        kept_clearance=np.nanmin(least, axis=1, initial=np.inf),
        goal_error=error[np.arange(N), taken],
        path_length=length,
        steps=taken.astype(float),
        path=np.where(after[:, :, None], np.nan, path),
        velocity=np.where(after[:, :, None], np.nan, velocity),
    )


def distances(
    scenes: SpatialScenes, scene: IntArray, points: FloatArray, time: FloatArray
) -> FloatArray:
    """(N, n, M) of points (N, n, 3) at times (N, n) [s]; inside minus a bound of the depth."""
    among = [a[scene][:, None] for a in (scenes.R_WO, scenes.semi_axes)]
    center = scenes.p_WO[scene][:, None] + time[:, :, None, None] * scenes.v_WO[scene][:, None]
    absent = np.isnan(center).any(axis=3)
    R = np.broadcast_to(among[0], (*center.shape, 3))
    axes = np.broadcast_to(among[1], center.shape)
    away = np.where(absent[..., None], 1e9, center) - points[:, :, None]
    distance = signed_distance(np.zeros(3), away, R, axes)
    gauge = np.linalg.norm(np.einsum("...ji,...j->...i", R, away) / axes, axis=-1)
    bound = (gauge - 1.0) * axes.min(axis=-1)
    return np.where(absent, np.nan, np.where(gauge <= 1.0, bound, distance))
