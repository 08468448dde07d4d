"""What the roll-outs in space keep, and that they are the motion that is executed.

They are held to the readable form (`tests/reference/rollout.py`) and to the DmpIntegrator in
Drake.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator

from drake_oa.common.messages import CouplingParameters, EllipsoidSet, FloatArray, IntArray
from drake_oa.geometry.ellipsoid import signed_distance
from drake_oa.policy.config import Policy
from drake_oa.policy.coupling import ALPHA, KAPPA, N_COLUMNS, NORMAL, PSI
from drake_oa.policy.dmp import imitate, minimum_jerk
from drake_oa.policy.dmp_integrator import DmpIntegrator
from drake_oa.regulation.rollout import (
    FEW_BLOCKS,
    SpatialRollouts,
    SpatialScenes,
    spatial_rollouts,
)
from tests.builders import read
from tests.reference.rollout import rollouts as readable_rollouts
from tests.regulation.scenes import random_scenes

seeds = st.integers(0, 2**32 - 1)
FEW = settings(max_examples=10)
MANY = settings(max_examples=40)
END, FADE = 1.2, 0.3

Scene = tuple[SpatialScenes, FloatArray]
"""One scene and its term (1, 13)."""


def one_scene(seed: int, **how: Any) -> Scene:
    """A term about a point on the baseline, and one ellipsoid in the way."""
    scenes = random_scenes(seed, 1, count=1, **how)
    return scenes, random_terms(scenes, seed, rows=1, log_alpha=7.0)[1]


def roll_out(scene: Scene, *, steps: int = 250, **options: object) -> SpatialRollouts:
    given_ = {"seconds": 1.5, "end": END, "fade": FADE, "keep_path": True} | options
    return spatial_rollouts(scene[0], [0], scene[1], steps=steps, **given_)  # type: ignore[arg-type]


def between(path: FloatArray, z: FloatArray, steps: int, parts: int) -> FloatArray:
    """The motion at `parts` instants a step, by cubic Hermite interpolation."""
    u = (np.arange(parts) / parts)[:, None]
    before, after = path[:-1, None], path[1:, None]
    slope, slope_after = z[:-1, None] / steps, z[1:, None] / steps
    curve = (
        (2.0 * u**3 - 3.0 * u**2 + 1.0) * before
        + (u**3 - 2.0 * u**2 + u) * slope
        + (3.0 * u**2 - 2.0 * u**3) * after
        + (u**3 - u**2) * slope_after
    )
    return np.vstack([curve.reshape(-1, 3), path[-1:]])


def distances(scenes: SpatialScenes, places: FloatArray, seconds: float) -> FloatArray:
    """(n, M) signed distances of places that are passed evenly over END."""
    time = seconds * END * np.linspace(0.0, 1.0, len(places))[:, None, None]
    return signed_distance(
        places[:, None],
        scenes.p_WO + time * scenes.v_WO,
        np.broadcast_to(scenes.R_WO, (len(places), *scenes.R_WO.shape[1:])),
        np.broadcast_to(scenes.semi_axes, (len(places), *scenes.semi_axes.shape[1:])),
    )


# Agreement.

S, ROWS = 6, 11
SETTINGS: dict[str, Any] = {
    "steps": 200,
    "end": 1.0,
    "horizon": 2.0,
    "fade": 0.3,
    "tolerance": 4e-4,
}


def random_terms(
    scenes: SpatialScenes, seed: int, rows: int = ROWS, log_alpha: float = 26.0
) -> tuple[IntArray, FloatArray]:
    """Terms of any strength, so many rows a scene, on every side."""
    rng = np.random.default_rng(seed)
    scene = np.repeat(np.arange(len(scenes.baseline)), rows)
    L, R = scenes.baseline[scene], scenes.R_WL[scene]
    N = len(scene)
    angle = rng.uniform(0.0, 2.0 * math.pi, N)[:, None]
    terms = np.zeros((N, N_COLUMNS))
    terms[:, :3] = scenes.p_WS[scene] + (rng.uniform(0.2, 0.8, N) * L)[:, None] * R[:, :, 0]
    terms[:, NORMAL : NORMAL + 3] = np.cos(angle) * R[:, :, 2] - np.sin(angle) * R[:, :, 1]
    terms[:, ALPHA] = np.exp(rng.uniform(-0.7, log_alpha, N)) * (rng.random(N) < 0.9)
    terms[:, PSI] = np.exp(rng.uniform(math.log(0.2), math.log(4.0), N))
    terms[:, KAPPA] = np.exp(rng.uniform(math.log(0.2), math.log(150.0), N)) / L**2
    return scene, terms


def assert_agree(found: SpatialRollouts, expected: SpatialRollouts) -> None:
    np.testing.assert_array_less(np.abs(found.steps - expected.steps), 1.5)
    for name in ("margin", "kept_clearance", "goal_error", "path_length"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-5)
    same = found.steps == expected.steps
    assert same.mean() > 0.95
    # Steps of strong terms amplify the rounding.
    for name, atol in (("path", 1e-7), ("velocity", 2e-6)):
        one, other = getattr(found, name)[same], getattr(expected, name)[same]
        np.testing.assert_allclose(one, other, rtol=0.0, atol=atol)


@pytest.mark.parametrize(("M", "speed"), [(0, 0.0), (1, 0.0), (6, 0.2)])
def test_it_is_the_motion_of_the_readable_form(M: int, speed: float) -> None:
    scenes = random_scenes(5, M, speed)
    scene, terms = (rows[::6] for rows in random_terms(scenes, 5))
    seconds = np.random.default_rng(5).uniform(1.0, 5.0, len(scene))
    how = SETTINGS | {"seconds": seconds, "steps": 250, "horizon": 1.4}
    expected = readable_rollouts(scenes, scene, terms, **how)
    assert_agree(spatial_rollouts(scenes, scene, terms, keep_path=True, **how), expected)


def test_rows_end_early_where_they_are_hopeless() -> None:
    scenes = random_scenes(6, 3)
    scene, terms = random_terms(scenes, 6)
    whole = spatial_rollouts(scenes, scene, terms, **SETTINGS)
    longest, shortest = 1.2 * scenes.baseline, np.full(S, 0.05)
    some = spatial_rollouts(scenes, scene, terms, longest=longest, shortest=shortest, **SETTINGS)
    short = some.steps < whole.steps
    assert short.sum() > 10
    least = whole.path_length + whole.goal_error
    hopeless = (least > longest[scene]) | (whole.margin < -0.05)
    assert hopeless[short].all()
    for name in ("margin", "path_length", "goal_error"):
        one, other = getattr(some, name)[~short], getattr(whole, name)[~short]
        np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-12)


def test_few_blocks_come_to_the_same_as_many() -> None:
    scenes = random_scenes(8, 2)
    scene, terms = random_terms(scenes, 8)
    whole = spatial_rollouts(scenes, scene, terms, **SETTINGS)
    for first, last in ((0, 1), (0, FEW_BLOCKS), (2, S), (S, S)):
        rows = slice(first * ROWS, last * ROWS)
        some = spatial_rollouts(scenes, scene[rows], terms[rows], **SETTINGS)
        np.testing.assert_array_equal(some.margin, whole.margin[rows])
        np.testing.assert_array_equal(some.path_length, whole.path_length[rows])


@MANY
@given(seed=seeds, seconds=st.floats(0.5, 5.0))
def test_between_its_steps_a_motion_comes_hardly_nearer(seed: int, seconds: float) -> None:
    scenes, terms = one_scene(seed, speed=0.1)
    found = roll_out((scenes, terms), steps=500, seconds=seconds)
    assume(not found.contact[0])
    path, kept, L = found.path[0], found.kept_clearance[0], float(scenes.baseline[0])
    assert kept == pytest.approx(distances(scenes, path, seconds).min(), abs=1e-6 * L)
    everywhere = distances(scenes, between(path, found.velocity[0], 500, 4), seconds).min()
    # Past the rim of a thin ellipsoid.
    assert everywhere > kept - (1e-4 if kept > 0.05 * L else 1e-3 * L)


@FEW
@given(seed=seeds)
def test_the_integrator_in_drake_follows_it(seed: int) -> None:
    (scenes, terms), steps, T = one_scene(seed, pace=0.0), 100, 2.0
    dmp = imitate(*minimum_jerk(np.zeros(3), (1.0, 0.0, 0.0), duration=T))
    coupling = CouplingParameters(
        *np.ascontiguousarray(terms[:, [ALPHA, PSI, KAPPA]].T),
        np.ones(1, dtype=bool),
        terms[:, :3],
        terms[:, NORMAL : NORMAL + 3],
        tau=1.0,
        verified=True,
    )
    found = roll_out((scenes, terms), steps=steps, dmp=dmp, seconds=T)
    system = DmpIntegrator(dmp, scenes.p_WE[0], config=Policy(period=T / steps))
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    system.GetInputPort("goal").FixValue(context, scenes.p_WG[0])
    system.GetInputPort("ellipsoids_W").FixValue(context, Value(EllipsoidSet(stamp=math.inf)))
    system.GetInputPort("coupling_parameters").FixValue(context, Value(coupling))
    places, velocities = [], []
    for step in range(round(END * steps) + 1):
        simulator.AdvanceTo(step * T / steps)
        places.append(read(system, context, "desired_position"))
        velocities.append(read(system, context, "desired_velocity"))
    np.testing.assert_allclose(places, found.path[0], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(velocities, found.velocity[0] / T, rtol=0.0, atol=1e-8)


# No input is too odd.

powers = st.one_of(st.just(0.0), st.floats(-300.0, 300.0).map(lambda power: 10.0**power))


@settings(max_examples=100)
@given(
    seed=seeds,
    size=st.sampled_from([1e-6, 1.0, 1e6]),
    alpha=powers,
    psi=powers.filter(lambda value: value > 0.0),
    kappa=powers,
    where=st.sampled_from([0.0, 1e-12, 0.5, 1.0]),
    moving=st.sampled_from([-1.0, 0.0, 1.0]),
    thin=st.sampled_from([1e-6, 1e-3, 1.0]),
    steps=st.sampled_from([1, 7, 100]),
    fade=st.sampled_from([0.0, 1e-12, 0.3, 1e3]),
    about_obstacle=st.booleans(),
)
def test_odd_but_finite_scenes_yield_finite_motions(
    seed: int,
    size: float,
    alpha: float,
    psi: float,
    kappa: float,
    where: float,
    moving: float,
    thin: float,
    steps: int,
    fade: float,
    about_obstacle: bool,
) -> None:
    scenes, terms = one_scene(seed, size=size)
    way = scenes.p_WG - scenes.p_WE
    p_WO = scenes.p_WO.copy()
    p_WO[0, 0] = scenes.p_WE[0] + where * way[0]
    scenes = replace(
        scenes,
        z_W=moving * way,
        p_WO=p_WO,
        semi_axes=scenes.semi_axes * [1.0, 1.0, thin],
    )
    terms[0, [ALPHA, PSI, KAPPA]] = alpha, psi, kappa
    if about_obstacle:
        terms[0, :3] = p_WO[0, 0]
    found = roll_out((scenes, terms), steps=steps, fade=fade, tolerance=1e-12)
    for name in ("path", "velocity"):
        assert np.isfinite(getattr(found, name)[0, : int(found.steps[0]) + 1]).all()
    for name in ("margin", "kept_clearance", "goal_error", "path_length"):
        assert np.isfinite(getattr(found, name)).all(), name
