"""The motions of `drake_oa.regulation.rollout` in NumPy, step by step."""

from __future__ import annotations

import numpy as np

from drake_oa.common.messages import FloatArray, IntArray
from drake_oa.geometry.ellipsoid import signed_distance
from drake_oa.policy.coupling import ALPHA
from drake_oa.policy.dmp import Dmp
from drake_oa.regulation.rollout import SpatialRollouts, SpatialScenes, default_dmp
from tests.reference.coupling import turning
from tests.reference.dmp import step


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
    path, velocity = [], []
    for at, row in zip(scene, terms, strict=True):
        p, z, k = scenes.p_WE[at], scenes.z_W[at], float(dmp.phase(scenes.s))
        frame = {"frame": scenes.R_WL[at], "baseline": float(scenes.baseline[at])}
        samples = [(p, z)]
        for _ in range(round(((horizon or end) - scenes.s) * steps)):
            left = float(np.linalg.norm(scenes.p_WG[at] - p))
            faded = row.copy()
            faded[ALPHA] *= min(left / (fade * frame["baseline"]), 1.0) ** 4 if fade else 1.0
            turn = turning(faded[None], in_plane=True)
            p, z, k = step(dmp, p, z, k, 1.0 / steps, scenes.p_WG[at], **frame, turn=turn)
            samples.append((p, z))
        for column, values in zip((path, velocity), zip(*samples, strict=True), strict=True):
            column.append(np.array(values))
    return _account(
        scenes, scene, np.array(path), np.array(velocity), steps, end, tolerance, seconds
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
