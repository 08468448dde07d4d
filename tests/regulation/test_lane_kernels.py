"""Roll-outs by lanes against the kernel that takes row by row."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import FloatArray, IntArray
from drake_oa.policy.coupling_kernels import ALPHA, KAPPA, NORMAL, PSI
from drake_oa.regulation.lane_kernels import FEW_BLOCKS
from drake_oa.regulation.rollout import SpatialRollouts, SpatialScenes, spatial_rollouts

S, ROWS = 12, 21
FLAT = (0.025, 0.25)
SETTINGS: dict[str, Any] = {"end": 1.0, "horizon": 2.0, "fade": 0.3, "tolerance": 4e-4}


def _scenes(seed: int, M: int, speed: float = 0.0) -> SpatialScenes:
    """Random frames, goals and flat ellipsoids about the baselines, some hit, some grazed."""
    rng = np.random.default_rng(seed)
    L = rng.uniform(0.5, 2.0, S)
    R_WL = Rotation.random(S, random_state=seed).as_matrix()
    start = rng.normal(size=(S, 3))
    place = np.stack([rng.uniform(0.25, 0.75, (S, M)), *rng.normal(0.0, 0.08, (2, S, M))], axis=2)
    center = start[:, None] + L[:, None, None] * np.einsum("sij,smj->smi", R_WL, place)
    if M > 1:
        center[rng.random((S, M)) < 0.2] = np.nan
    return SpatialScenes(
        p_WE=start,
        z_W=0.05 * rng.normal(size=(S, 3)),
        p_WG=start + L[:, None] * R_WL[:, :, 0],
        R_WL=R_WL,
        baseline=L,
        p_WO=center,
        R_WO=Rotation.random(S * M, random_state=seed).as_matrix().reshape(S, M, 3, 3),
        semi_axes=rng.uniform(*FLAT, (S, M, 3)),
        v_WO=speed * rng.normal(size=(S, M, 3)),
        clearance=np.full((S, M), 0.15),
    )


def _terms(scenes: SpatialScenes, seed: int) -> tuple[IntArray, FloatArray]:
    rng = np.random.default_rng(seed)
    scene = np.repeat(np.arange(S), ROWS)
    L, R = scenes.baseline[scene], scenes.R_WL[scene]
    N = len(scene)
    angle = rng.uniform(0.0, 2.0 * math.pi, N)[:, None]
    terms = np.zeros((N, 1, 13))
    terms[:, 0, :3] = scenes.p_WS[scene] + (rng.uniform(0.2, 0.8, N) * L)[:, None] * R[:, :, 0]
    terms[:, 0, NORMAL : NORMAL + 3] = np.cos(angle) * R[:, :, 2] - np.sin(angle) * R[:, :, 1]
    terms[:, 0, ALPHA] = np.exp(rng.uniform(-0.7, 26.0, N)) * (rng.random(N) < 0.9)
    terms[:, 0, PSI] = np.exp(rng.uniform(math.log(0.2), math.log(4.0), N))
    terms[:, 0, KAPPA] = np.exp(rng.uniform(math.log(0.2), math.log(150.0), N)) / L**2
    return scene, terms


def _agree(a: SpatialRollouts, b: SpatialRollouts) -> None:
    np.testing.assert_array_less(np.abs(a.steps - b.steps), 1.5)
    for name in ("margin", "clearance", "goal_error", "path_length", "world_margin"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=0.0, atol=1e-5)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("M", [0, 1, 6])
@pytest.mark.parametrize("speed", [0.0, 0.2])
def test_lanes_agree_with_rows(seed: int, M: int, speed: float) -> None:
    scenes = _scenes(seed, M, speed)
    scene, terms = _terms(scenes, seed)
    seconds = np.random.default_rng(seed).uniform(1.0, 5.0, len(scene))
    both = [
        spatial_rollouts(scenes, scene, terms, seconds=seconds, lanes=by_lanes, **SETTINGS)
        for by_lanes in (True, False)
    ]
    _agree(both[0], both[1])


@pytest.mark.parametrize("annulus", [np.zeros((3, 0)), [[-5.0, 5.0], [0.1, 0.1], [2.5, 3.0]]])
def test_lanes_agree_about_table_and_workspace(annulus: FloatArray) -> None:
    scenes = _scenes(5, 1)
    plane = np.column_stack([np.tile([0.0, 0.0, 1.0], (S, 1)), scenes.p_WE[:, 2] - 0.1])
    scenes = dataclasses.replace(scenes, plane=plane, annulus=np.array(annulus))
    scene, terms = _terms(scenes, 5)
    _agree(
        spatial_rollouts(scenes, scene, terms, **SETTINGS),
        spatial_rollouts(scenes, scene, terms, lanes=False, **SETTINGS),
    )


def test_lanes_end_where_rows_do() -> None:
    scenes = _scenes(6, 3)
    scene, terms = _terms(scenes, 6)
    limits: dict[str, Any] = {"longest": 1.2 * scenes.baseline, "shortest": np.full(S, 0.05)}
    a = spatial_rollouts(scenes, scene, terms, **SETTINGS, **limits)
    b = spatial_rollouts(scenes, scene, terms, lanes=False, **SETTINGS, **limits)
    assert (b.steps < 500).sum() > 20
    np.testing.assert_array_less(np.abs(a.steps - b.steps), 1.5)
    same = a.steps == b.steps
    assert same.mean() > 0.95
    np.testing.assert_allclose(a.path_length[same], b.path_length[same], atol=1e-5)
    np.testing.assert_allclose(a.margin[same], b.margin[same], atol=1e-5)


def test_order_of_the_rows_does_not_matter() -> None:
    scenes = _scenes(7, 2)
    scene, terms = _terms(scenes, 7)
    order = np.random.default_rng(7).permutation(len(scene))
    a = spatial_rollouts(scenes, scene, terms, **SETTINGS)
    b = spatial_rollouts(scenes, scene[order], terms[order], **SETTINGS)
    np.testing.assert_allclose(b.margin, a.margin[order], atol=1e-9)
    np.testing.assert_array_equal(b.steps, a.steps[order])


def test_few_blocks_come_to_the_same_as_many() -> None:
    scenes = _scenes(8, 2)
    scene, terms = _terms(scenes, 8)
    whole = spatial_rollouts(scenes, scene, terms, **SETTINGS)
    for first, last in ((0, 1), (0, FEW_BLOCKS), (3, 4 + FEW_BLOCKS), (S, S)):
        rows = slice(first * ROWS, last * ROWS)
        some = spatial_rollouts(scenes, scene[rows], terms[rows], **SETTINGS)
        np.testing.assert_array_equal(some.margin, whole.margin[rows])
        np.testing.assert_array_equal(some.path_length, whole.path_length[rows])


def test_extreme_parameters() -> None:
    """Any finite ones: numbers come out, and those of the kernel that takes row by row."""
    alpha = (5e-324, 1.0, 1e4, 1e150, 1e300, 1.7e308)
    psi = (5e-324, 1e-300, 1e-160, 1e-20, 1.0, 1e12, 1e20, 1e160, 1.7e308)
    kappa = (0.0, 10.0, 1e20, 1.7e308)
    values = np.array(np.meshgrid(alpha, psi, kappa)).reshape(3, -1).T
    straight = _scenes(9, 1)
    # At rest, and moving at the middle of the term: no side, or none but by convention.
    z_W = np.array([np.zeros(3), 0.2 * straight.R_WL[1, :, 0], [0.1, 0.1, -0.1]])
    scenes = dataclasses.replace(
        straight, z_W=np.concatenate([z_W, straight.z_W[3:]]), clearance=np.full((S, 1), 0.05)
    )
    scene = np.repeat(np.arange(3), len(values))
    middle = 0.5 * (scenes.p_WE + scenes.p_WG)[scene]
    terms = np.zeros((len(scene), 1, 13))
    terms[:, 0, :3] = middle
    terms[:, 0, NORMAL : NORMAL + 3] = scenes.R_WL[scene, :, 2]
    terms[:, 0, [ALPHA, PSI, KAPPA]] = np.tile(values, (3, 1))
    a, b = (
        spatial_rollouts(scenes, scene, terms, lanes=by_lanes, **SETTINGS)
        for by_lanes in (True, False)
    )
    for name in ("margin", "clearance", "goal_error", "path_length"):
        assert np.isfinite(getattr(a, name)).all()
    _agree(a, b)
