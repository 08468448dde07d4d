"""What the roll-outs in space keep, and that they are the motion that is executed.

They are held to the readable step (`dmp.step`, `CouplingTerms.turn` and the fade near the
goal), to a dense measurement in double precision, and to the DmpIntegrator in Drake.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import CouplingParameters, EllipsoidSet, FloatArray
from drake_oa.geometry.ellipsoid import signed_distance
from drake_oa.policy.coupling import CouplingTerms
from drake_oa.policy.coupling_kernels import ALPHA, KAPPA, N_COLUMNS, NORMAL, PSI
from drake_oa.policy.dmp import Dmp, imitate, local_frame, minimum_jerk
from drake_oa.policy.dmp import step as dmp_step
from drake_oa.policy.dmp_integrator import DmpIntegrator
from drake_oa.regulation.rollout import (
    SpatialRollouts,
    SpatialScenes,
    default_dmp,
    spatial_rollouts,
)

seeds = st.integers(0, 2**32 - 1)
FEW = settings(max_examples=10, derandomize=True)
MANY = settings(max_examples=40, derandomize=True)
END, FADE = 1.2, 0.3

Scene = tuple[SpatialScenes, FloatArray]
"""One scene and its terms (1, K, 13)."""


def random_scene(seed: int, *, moving: bool = True, log_alpha: float = 7.0) -> Scene:
    """One to three terms about points near the baseline among one to six ellipsoids."""
    rng = np.random.default_rng(seed)
    K, M = int(rng.integers(1, 4)), int(rng.integers(1, 7))
    start, way = rng.normal(size=(2, 3))
    L = math.exp(rng.uniform(math.log(0.3), math.log(2.0)))
    goal = start + L * way / np.linalg.norm(way)
    R_WL = local_frame(start, goal)
    across = rng.uniform(-0.3, 0.3, (M, 3)) * [0.0, 1.0, 1.0]
    along = rng.uniform(0.15, 0.85, (M, 1)) * [1.0, 0.0, 0.0]
    scenes = SpatialScenes(
        p_WE=start[None],
        z_W=np.zeros((1, 3)),
        p_WG=goal[None],
        R_WL=R_WL[None],
        baseline=np.array([L]),
        p_WO=(start + L * (along + across) @ R_WL.T)[None],
        R_WO=Rotation.random(M, random_state=seed).as_matrix()[None],
        semi_axes=(L * np.exp(rng.uniform(math.log(0.02), math.log(0.25), (M, 3))))[None],
        v_WO=(0.15 * L * moving * rng.normal(size=(M, 3)) * rng.integers(0, 2, (M, 1)))[None],
        clearance=np.full((1, M), 0.1 * L),
    )
    terms = np.zeros((1, K, N_COLUMNS))
    feet = np.zeros((K, 3))
    feet[:, 0] = rng.uniform(0.2, 0.8, K)
    # On the baseline, where the motion sets out straight at them, or off it.
    feet[:, 1:] = rng.uniform(-0.1, 0.1, (K, 2)) * rng.integers(0, 2)
    terms[0, :, :3] = start + L * feet @ R_WL.T
    terms[0, :, ALPHA] = np.exp(rng.uniform(1.0, log_alpha, K))
    terms[0, :, PSI] = rng.uniform(0.4, 2.0, K)
    terms[0, :, KAPPA] = np.exp(rng.uniform(0.0, 4.0, K)) / L**2
    angle = rng.uniform(0.0, 6.28) + rng.normal(scale=0.3, size=K)
    side = np.stack([np.zeros(K), -np.sin(angle), np.cos(angle)], axis=1)
    terms[0, :, NORMAL : NORMAL + 3] = side @ R_WL.T
    return scenes, terms


def roll_out(scene: Scene, *, steps: int = 250, **options: object) -> SpatialRollouts:
    given_ = {"seconds": 1.5, "end": END, "fade": FADE, "keep_path": True} | options
    return spatial_rollouts(scene[0], [0], scene[1], steps=steps, **given_)  # type: ignore[arg-type]


def readable_motion(scene: Scene, steps: int) -> tuple[FloatArray, FloatArray]:
    """Positions and scaled velocities by the readable step."""
    scenes, (rows,) = scene
    p, z, k = scenes.p_WE[0], scenes.z_W[0], 1.0
    goal, L = scenes.p_WG[0], float(scenes.baseline[0])
    found = [(p, z)]
    for _ in range(round(END * steps)):
        fade = min(1.0, np.linalg.norm(goal - p) / (FADE * L)) ** 4
        terms = CouplingTerms(
            p_WO=rows[:, :3],
            parameters=rows[:, ALPHA : KAPPA + 1] * [fade, 1.0, 1.0],
            normal_W=rows[:, NORMAL : NORMAL + 3],
            guidance_alpha=np.zeros(len(rows)),
            in_plane=True,
        )
        p, z, k = dmp_step(
            default_dmp(),
            *(p, z, k, 1.0 / steps, goal),
            frame=scenes.R_WL[0],
            baseline=L,
            turn=terms.turn,
        )
        found.append((p, z))
    return np.array([p for p, _ in found]), np.array([z for _, z in found])


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


@FEW
@given(seed=seeds)
def test_it_is_the_motion_of_the_readable_step(seed: int) -> None:
    scene, steps = random_scene(seed), 200
    path, z = readable_motion(scene, steps)
    found, L = roll_out(scene, steps=steps), float(scene[0].baseline[0])
    np.testing.assert_allclose(found.path[0], path, rtol=0.0, atol=1e-9 * L)
    np.testing.assert_allclose(found.velocity[0], z, rtol=0.0, atol=1e-8 * L)
    length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    assert found.path_length[0] == pytest.approx(length, abs=1e-9 * L)
    left = np.linalg.norm(path[-1] - scene[0].p_WG[0])
    assert found.goal_error[0] == pytest.approx(left, abs=1e-9 * L)


@MANY
@given(seed=seeds, seconds=st.floats(0.5, 5.0))
def test_the_clearance_is_that_of_a_dense_measurement(seed: int, seconds: float) -> None:
    scene = random_scene(seed)
    scenes, L = scene[0], float(scene[0].baseline[0])
    found = roll_out(scene, steps=500, seconds=seconds)
    path, z = found.path[0], found.velocity[0]
    at_steps = distances(scenes, path, seconds)
    everywhere = distances(scenes, between(path, z, 500, 4), seconds).min()
    assert found.contact[0] == (at_steps.min() <= 0.0)
    if found.contact[0]:
        # Minus a lower bound of the depth.
        assert at_steps.min() - 1e-12 <= found.clearance[0] <= 0.0
        return
    assert found.clearance[0] == pytest.approx(at_steps.min(), abs=1e-9)
    # Between two steps it may come nearer, past the rim of a thin ellipsoid.
    assert everywhere > found.clearance[0] - (1e-4 if found.clearance[0] > 0.05 * L else 1e-3 * L)
    feasible = np.minimum(at_steps[0], distances(scenes, scenes.p_WG, 0.0)[0])
    if not scenes.v_WO.any():
        margin = (at_steps.min(axis=0) - np.minimum(scenes.clearance[0], feasible)).min()
        if feasible.min() > 0.0:
            assert found.margin[0] == pytest.approx(margin, abs=1e-9)


@FEW
@given(seed=seeds)
def test_the_integrator_in_drake_follows_it(seed: int) -> None:
    scene, steps, T = random_scene(seed, moving=False), 100, 2.0
    scenes, (rows,) = scene
    dmp = imitate(*minimum_jerk(np.zeros(3), (1.0, 0.0, 0.0), duration=T))
    K, M = len(rows), scenes.p_WO.shape[1]
    count = max(K, M)
    # One row an ellipsoid: far ones and terms without strength make up the numbers.
    far = scenes.p_WE + 100.0
    ellipsoids = EllipsoidSet(
        stamp=math.inf,
        p_WO=np.vstack([scenes.p_WO[0], np.repeat(far, count - M, axis=0)]),
        R_WO=np.vstack([scenes.R_WO[0], np.repeat(np.eye(3)[None], count - M, axis=0)]),
        semi_axes=np.vstack([scenes.semi_axes[0], np.ones((count - M, 3))]),
        v_WO=np.zeros((count, 3)),
        ids=np.arange(count),
    )
    spare = np.zeros((count - K, N_COLUMNS))
    spare[:, PSI], spare[:, NORMAL] = 1.0, 1.0
    full = np.vstack([rows, spare])
    coupling = CouplingParameters(
        full[:, ALPHA].copy(),
        full[:, PSI].copy(),
        full[:, KAPPA].copy(),
        np.ones(count, dtype=bool),
        full[:, :3],
        full[:, NORMAL : NORMAL + 3],
        tau=1.0,
    )
    found = roll_out(scene, steps=steps, dmp=dmp, seconds=T)
    # Inside an ellipsoid the integrator holds.
    assume(not found.contact[0] and distances(scenes, scenes.p_WG, 0.0).min() > 0.0)
    system = DmpIntegrator(dmp, scenes.p_WE[0], period=T / steps)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    system.GetInputPort("goal").FixValue(context, scenes.p_WG[0])
    system.GetInputPort("ellipsoids_W").FixValue(context, Value(ellipsoids))
    system.GetInputPort("coupling_parameters").FixValue(context, Value(coupling))
    position = system.GetOutputPort("desired_position")
    velocity = system.GetOutputPort("desired_velocity")
    places, velocities = [], []
    for step in range(round(END * steps) + 1):
        simulator.AdvanceTo(step * T / steps)
        places.append(position.Eval(context))
        velocities.append(velocity.Eval(context))
    np.testing.assert_allclose(places, found.path[0], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(velocities, found.velocity[0] / T, rtol=0.0, atol=1e-8)


# The Lyapunov function.


@MANY
@given(
    seed=seeds,
    log_alpha=st.floats(1.0, 30.0),
    steps=st.integers(1, 300),
    alpha_x=st.floats(1.0, 200.0),
    ratio=st.sampled_from([0.01, 0.25, 4.0]),
    fade=st.sampled_from([0.0, 0.3]),
)
def test_energy_never_rises_over_a_step(
    seed: int, log_alpha: float, steps: int, alpha_x: float, ratio: float, fade: float
) -> None:
    dmp = Dmp(alpha_x, ratio * alpha_x, 4.6, np.ones(1), np.ones(1), np.zeros((3, 1)))
    scene = random_scene(seed, log_alpha=log_alpha)
    rng = np.random.default_rng(seed)
    scenes = replace(scene[0], z_W=10.0 * rng.normal(size=(1, 3)))
    found = roll_out((scenes, scene[1]), steps=steps, dmp=dmp, fade=fade)
    left = scenes.p_WG - found.path[0]
    energy = 0.5 * dmp.alpha_x * dmp.beta_x * (left**2).sum(axis=1)
    energy += 0.5 * (found.velocity[0] ** 2).sum(axis=1)
    assert (np.diff(energy) <= 1e-12 * energy[0]).all()


# Invariances.


@FEW
@given(seed=seeds, seconds=st.floats(0.01, 100.0))
def test_among_obstacles_at_rest_the_duration_does_not_matter(seed: int, seconds: float) -> None:
    scene = random_scene(seed, moving=False)
    one, other = roll_out(scene), roll_out(scene, seconds=seconds)
    for name in ("path", "velocity", "clearance", "margin", "goal_error", "path_length"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def moved(scene: Scene, Q: FloatArray, shift: FloatArray, scale: float = 1.0) -> Scene:
    """The scene turned (or mirrored) by Q, shifted and scaled."""
    scenes, terms = scene
    sense = np.linalg.det(Q)

    def place(points: FloatArray) -> FloatArray:
        return scale * points @ Q.T + shift

    def proper(axes: FloatArray) -> FloatArray:
        # A mirror leaves left-handed axes. One turned round is the same ellipsoid, and the
        # same motion of a straight demonstration.
        return Q @ axes * [1.0, 1.0, sense]

    plane = scenes.plane.copy()
    if len(plane):
        plane[:, :3] = plane[:, :3] @ Q.T
        plane[:, 3] = scale * plane[:, 3] + plane[:, :3] @ shift
    again = terms.copy()
    again[..., :3] = place(terms[..., :3])
    again[..., KAPPA] /= scale**2
    again[..., NORMAL : NORMAL + 3] = sense * terms[..., NORMAL : NORMAL + 3] @ Q.T
    return (
        replace(
            scenes,
            p_WE=place(scenes.p_WE),
            z_W=scale * scenes.z_W @ Q.T,
            p_WG=place(scenes.p_WG),
            R_WL=proper(scenes.R_WL),
            baseline=scale * scenes.baseline,
            p_WO=place(scenes.p_WO),
            R_WO=proper(scenes.R_WO),
            semi_axes=scale * scenes.semi_axes,
            v_WO=scale * scenes.v_WO @ Q.T,
            clearance=scale * scenes.clearance,
            plane=plane,
            annulus=scale * scenes.annulus,
        ),
        again,
    )


def assert_same(
    one: SpatialRollouts, other: SpatialRollouts, Q: FloatArray, shift: FloatArray, scale: float
) -> None:
    """`other` is `one` moved; inside an ellipsoid the clearance is a bound that moves alike."""
    assert one.steps[0] == other.steps[0]
    np.testing.assert_allclose(
        (other.path[0] - shift) / scale, one.path[0] @ Q.T, rtol=0.0, atol=1e-9
    )
    for name in ("clearance", "margin", "goal_error", "path_length", "world_margin"):
        np.testing.assert_allclose(
            getattr(other, name) / scale, getattr(one, name), rtol=0.0, atol=1e-8
        )


@MANY
@given(seed=seeds, power=st.floats(-3.0, 3.0))
def test_it_scales_with_the_scene(seed: int, power: float) -> None:
    scene, scale = random_scene(seed), 10.0**power
    again = moved(scene, np.eye(3), np.zeros(3), scale)
    assert_same(roll_out(scene), roll_out(again), np.eye(3), np.zeros(3), scale)


@MANY
@given(seed=seeds, mirror=st.booleans())
def test_it_moves_and_mirrors_with_the_scene(seed: int, mirror: bool) -> None:
    rng = np.random.default_rng([seed, 1])
    scene, shift = random_scene(seed), rng.normal(size=3)
    normal = rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    above = replace(scene[0], plane=np.array([[*normal, rng.uniform(-2.0, 2.0)]]))
    Q = Rotation.random(random_state=seed).as_matrix()
    Q = Q @ np.diag([1.0, -1.0 if mirror else 1.0, 1.0])
    again = moved((above, scene[1]), Q, shift)
    assert_same(roll_out((above, scene[1])), roll_out(again), Q, shift, 1.0)


@FEW
@given(seed=seeds, angle=st.floats(-3.1, 3.1), power=st.floats(-3.0, 3.0))
def test_the_workspace_turns_about_the_vertical(seed: int, angle: float, power: float) -> None:
    scene, scale = random_scene(seed), 10.0**power
    limits = np.array([[-4.0, 0.0, 1.0, 4.0], [0.1, 0.3, 0.2, 0.1], [3.0, 6.0, 4.0, 2.0]])
    within = replace(scene[0], annulus=limits), scene[1]
    Q = Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()
    again = moved(within, Q, np.zeros(3), scale)
    assert_same(roll_out(within), roll_out(again), Q, np.zeros(3), scale)


@FEW
@given(seed=seeds)
def test_absent_obstacles_change_nothing(seed: int) -> None:
    scenes, terms = random_scene(seed)
    more = {
        name: np.concatenate([getattr(scenes, name), np.full_like(getattr(scenes, name), fill)], 1)
        for name, fill in (("p_WO", np.nan), ("R_WO", 0.0), ("semi_axes", np.nan))
    }
    more |= {name: np.concatenate([getattr(scenes, name)] * 2, 1) for name in ("v_WO", "clearance")}
    one, other = roll_out((scenes, terms)), roll_out((replace(scenes, **more), terms))
    for name in ("path", "clearance", "margin", "goal_error"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


# Straight at the centre.


@MANY
@given(
    seed=seeds,
    log_alpha=st.floats(0.0, 5.5),
    psi=st.floats(0.2, 4.0),
    share=st.floats(0.05, 0.95),
    power=st.floats(-6.0, 6.0),
    count=st.integers(1, 3),
)
def test_straight_at_the_centre_it_passes_on_the_side_of_the_normal(
    seed: int, log_alpha: float, psi: float, share: float, power: float, count: int
) -> None:
    scenes, terms = random_scene(seed)
    row = terms[:, :1].copy()
    row[0, 0, :3] = scenes.p_WE[0] + share * (scenes.p_WG[0] - scenes.p_WE[0])
    row[0, 0, ALPHA], row[0, 0, PSI] = math.exp(log_alpha), psi
    row[0, 0, KAPPA] = 2.0 / scenes.baseline[0] ** 2
    scene = moved((scenes, row.repeat(count, axis=1)), np.eye(3), np.zeros(3), 10.0**power)
    n = row[0, 0, NORMAL : NORMAL + 3]
    side = np.cross(n, scenes.R_WL[0, :, 0])
    found = roll_out(scene)
    away = (found.path[0] - scene[0].p_WE) / scene[0].baseline
    # Where it first leaves the baseline by more than rounding. (Terms that together turn by
    # pi in a step would lead straight back along it.)
    off = np.abs(away @ side) > 1e-12
    assert off.any()
    assert (away @ side)[off.argmax()] > 0.0
    np.testing.assert_allclose(away @ n, 0.0, atol=1e-9)
    np.testing.assert_array_equal(roll_out(scene).path, found.path)
    back = scene[1].copy()
    back[..., NORMAL : NORMAL + 3] *= -1.0
    other = (roll_out((scene[0], back)).path[0] - scene[0].p_WE) / scene[0].baseline
    assert (other @ side)[off.argmax()] < 0.0


# No input is too odd.

powers = st.one_of(st.just(0.0), st.floats(-300.0, 300.0).map(lambda power: 10.0**power))


@settings(max_examples=100, derandomize=True)
@given(
    seed=seeds,
    size=st.sampled_from([1e-6, 1.0, 1e6]),
    alpha=powers,
    psi=powers.filter(lambda value: value > 0.0),
    kappa=powers,
    count=st.integers(1, 3),
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
    count: int,
    where: float,
    moving: float,
    thin: float,
    steps: int,
    fade: float,
    about_obstacle: bool,
) -> None:
    scenes, terms = moved(random_scene(seed), np.eye(3), np.zeros(3), size)
    way = scenes.p_WG - scenes.p_WE
    p_WO = scenes.p_WO.copy()
    p_WO[0, 0] = scenes.p_WE[0] + where * way[0]
    scenes = replace(
        scenes,
        z_W=moving * way,
        p_WO=p_WO,
        semi_axes=scenes.semi_axes * [1.0, 1.0, thin],
        plane=np.array([[0.0, 0.0, 1.0, 0.0]]),
        annulus=size * np.array([[0.0, 1.0], [0.1, 0.1], [1.0, 1.0]]),
    )
    rows = terms[:, :1].repeat(count, axis=1)
    rows[..., ALPHA], rows[..., PSI], rows[..., KAPPA] = alpha, psi, kappa
    if about_obstacle:
        rows[..., :3] = p_WO[0, 0]
    found = roll_out((scenes, rows), steps=steps, fade=fade, tolerance=1e-12)
    for name in ("path", "velocity"):
        assert np.isfinite(getattr(found, name)[0, : int(found.steps[0]) + 1]).all()
    for name in ("margin", "clearance", "goal_error", "path_length", "world_margin"):
        assert np.isfinite(getattr(found, name)).all(), name
