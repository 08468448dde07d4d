"""What a step of the whole action level keeps."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import (
    CouplingParameters,
    EllipsoidSet,
    FloatArray,
    PolicyState,
    Route,
)
from drake_oa.policy.action import (
    ActionLevel,
    Segment,
    Surroundings,
    initial_segment,
)
from drake_oa.policy.config import Policy
from drake_oa.policy.dmp import Dmp, imitate, local_frame, minimum_jerk
from drake_oa.policy.guidance import passing_normals

DMP = imitate(*minimum_jerk(np.zeros(3), (1.0, 0.0, 0.0)))
PARAMETERS = Policy()
LEVEL = ActionLevel(DMP, PARAMETERS)
seeds = st.integers(0, 2**32 - 1)
FEW = settings(max_examples=15, derandomize=True)
MANY = settings(max_examples=60, derandomize=True)


def unforced(alpha_x: float, ratio: float) -> Dmp:
    return Dmp(alpha_x, ratio * alpha_x, 4.6, np.ones(1), np.ones(1), np.zeros((3, 1)))


def random_coupling(rng: np.random.Generator, count: int, log_alpha: float) -> CouplingParameters:
    """Parameters up to a strength, about points of their own or about the obstacles."""
    rows = np.exp(rng.uniform([-3, -3, -2], [log_alpha, 1, 6], size=(count, 3)))
    centers = rng.normal(size=(count, 3)) if rng.integers(0, 2) else np.zeros((0, 3))
    return CouplingParameters(*rows.T.copy(), np.ones(count, dtype=bool), centers)


def random_ellipsoids(rng: np.random.Generator, count: int) -> EllipsoidSet:
    return EllipsoidSet(
        stamp=math.inf,
        p_WO=rng.normal(size=(count, 3)),
        R_WO=Rotation.random(count, random_state=int(rng.integers(1 << 31))).as_matrix(),
        semi_axes=rng.uniform(0.02, 0.3, size=(count, 3)),
        ids=np.arange(count),
    )


def random_route(rng: np.random.Generator, count: int, R_WL: FloatArray) -> Route:
    """Sides to pass on, and headings of its own or a clearance to lead at."""
    angles = rng.uniform(0.0, 6.28, count)
    direction = np.stack([np.zeros(count), np.cos(angles), np.sin(angles)], axis=1) @ R_WL.T
    own = rng.normal(size=(count, 3)) if rng.integers(0, 2) else np.zeros((0, 3))
    return Route(
        heading_W=own,
        direction_W=direction,
        normal_W=passing_normals(direction, R_WL),
        remaining_clearance=rng.uniform(0.0, 0.3, count),
        path_length=rng.uniform(0.5, 3.0),
    )


def energy(dmp: Dmp, p: FloatArray, z: FloatArray, goal: FloatArray) -> float:
    left = goal - p
    return float(0.5 * dmp.alpha_x * dmp.beta_x * left @ left + 0.5 * z @ z)


# The Lyapunov function.


@MANY
@given(
    seed=seeds,
    count=st.integers(0, 20),
    period=st.floats(1e-6, 10.0),
    alpha_x=st.floats(0.1, 200.0),
    ratio=st.sampled_from([0.01, 0.25, 4.0]),
    routed=st.booleans(),
    form=st.sampled_from(["counterphase", "printed"]),
)
def test_energy_never_rises_over_a_step(
    seed: int, count: int, period: float, alpha_x: float, ratio: float, routed: bool, form: str
) -> None:
    rng = np.random.default_rng(seed)
    dmp = unforced(alpha_x, ratio)
    level = ActionLevel(dmp, Policy(guidance=form))  # type: ignore[arg-type]
    p, z, start, goal = rng.normal(size=(4, 3))
    frame = local_frame(start, goal)
    segment = Segment.resting(
        PolicyState(p_WE=p, z_W=z, p_WS=start, p_WG=goal, R_WL=frame, speed=1.0)
    )
    around = Surroundings.of(
        random_ellipsoids(rng, count),
        random_coupling(rng, count, 30.0),
        random_route(rng, count, frame) if routed and count else None,
    )
    energies = [energy(dmp, p, z, goal)]
    for _ in range(5):
        segment = level.step(segment, goal, around, segment.end.stamp, period)
        energies.append(energy(dmp, segment.end.p_WE, segment.end.z_W, goal))
    assert (np.diff(energies) <= 1e-12 * energies[0]).all()


# Invariances of whole motions.


def scene(
    seed: int,
) -> tuple[FloatArray, FloatArray, EllipsoidSet, CouplingParameters, Route]:
    """One to three obstacles near the baseline that leave start and goal free, and a route."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 4))
    start = rng.normal(size=3)
    way = rng.normal(size=3)
    goal = start + way / np.linalg.norm(way)
    R_WL = local_frame(start, goal)
    angle = rng.uniform(0.0, 6.28) + rng.normal(scale=0.3, size=count)
    direction = np.stack([np.zeros(count), np.cos(angle), np.sin(angle)], axis=1) @ R_WL.T
    # Off the baseline: exactly on it the last bit of a sum says whether guidance acts at rest.
    feet = start + rng.uniform(0.35, 0.65, (count, 1)) * (goal - start)
    feet += rng.choice([-1.0, 1.0], (count, 1)) * rng.uniform(0.002, 0.02, (count, 1)) * direction
    ellipsoids = replace(
        random_ellipsoids(rng, count),
        p_WO=feet,
        semi_axes=rng.uniform(0.005, 0.03, (count, 3)),
    )
    rows = np.exp(rng.uniform(np.log([5, 0.4, 2]), np.log([200, 1.5, 30]), size=(count, 3)))
    coupling = CouplingParameters(*rows.T.copy(), np.ones(count, dtype=bool), feet)
    route = Route(
        direction_W=direction,
        normal_W=passing_normals(direction, R_WL),
        remaining_clearance=rng.uniform(0.05, 0.1, count),
        path_length=1.3,
    )
    return start, goal, ellipsoids, coupling, route


def path(
    start: FloatArray,
    goal: FloatArray,
    ellipsoids: EllipsoidSet,
    coupling: CouplingParameters,
    route: Route,
    *,
    tau: float = 1.0,
    steps: int = 200,
) -> FloatArray:
    """Positions of the compiled action level from s = 0 to 1.2, where nothing holds it."""
    state = replace(initial_segment(DMP, start, goal, 0.0).state, tau=tau, speed=1.0 / tau)
    segment = Segment.resting(state)
    around = Surroundings.of(ellipsoids, replace(coupling, tau=tau), route)
    found = [start]
    for _ in range(round(1.2 * steps)):
        segment = LEVEL.step(segment, goal, around, segment.end.stamp, tau / steps)
        assume(segment.note == "")
        found.append(segment.end.p_WE)
    return np.array(found)


@FEW
@given(seed=seeds, tau=st.floats(1.0, 20.0))
def test_the_path_is_that_of_any_tau(seed: int, tau: float) -> None:
    some = scene(seed)
    np.testing.assert_allclose(path(*some, tau=tau), path(*some), rtol=0.0, atol=1e-9)


def moved(
    some: tuple[FloatArray, FloatArray, EllipsoidSet, CouplingParameters, Route],
    Q: FloatArray,
    shift: FloatArray,
    scale: float = 1.0,
) -> tuple[FloatArray, FloatArray, EllipsoidSet, CouplingParameters, Route]:
    """The scene turned (or mirrored) by Q, shifted and scaled."""
    start, goal, ellipsoids, coupling, route = some

    def place(points: FloatArray) -> FloatArray:
        return scale * points @ Q.T + shift

    # A mirror leaves left-handed axes: one of them turned round is the same ellipsoid.
    axes = Q @ ellipsoids.R_WO
    axes[..., 2] *= np.linalg.det(Q)
    return (
        place(start),
        place(goal),
        replace(
            ellipsoids,
            p_WO=place(ellipsoids.p_WO),
            R_WO=axes,
            semi_axes=scale * ellipsoids.semi_axes,
        ),
        replace(coupling, kappa=coupling.kappa / scale**2, center_W=place(coupling.center_W)),
        replace(
            route,
            direction_W=route.direction_W @ Q.T,
            normal_W=np.linalg.det(Q) * route.normal_W @ Q.T,
            remaining_clearance=scale * route.remaining_clearance,
            path_length=scale * route.path_length,
        ),
    )


@FEW
@given(seed=seeds, power=st.floats(-3.0, 3.0))
def test_the_path_scales_with_the_scene(seed: int, power: float) -> None:
    some, scale = scene(seed), 10.0**power
    again = path(*moved(some, np.eye(3), np.zeros(3), scale))
    np.testing.assert_allclose(again / scale, path(*some), rtol=0.0, atol=1e-9)


@FEW
@given(seed=seeds, about=st.sampled_from(["vertical", "any axis"]), mirror=st.booleans())
def test_the_path_moves_and_mirrors_with_the_scene(seed: int, about: str, mirror: bool) -> None:
    rng = np.random.default_rng([seed, 1])
    # The demonstration is straight: nothing is left of the vertical but in the normals.
    rotation = Rotation.random(random_state=seed)
    if about == "vertical":
        rotation = Rotation.from_rotvec([0.0, 0.0, rng.uniform(-3.0, 3.0)])
    Q = rotation.as_matrix() @ np.diag([1.0, -1.0 if mirror else 1.0, 1.0])
    some, shift = scene(seed), rng.normal(size=3)
    again = path(*moved(some, Q, shift))
    # The turned numbers differ in their last bits, and three guided terms amplify that.
    np.testing.assert_allclose(again, path(*some) @ Q.T + shift, rtol=0.0, atol=1e-8)


def test_a_curved_demonstration_turns_about_the_vertical_only() -> None:
    t = np.linspace(0.0, 1.0, 50)
    curved = np.stack([t, 0.1 * np.sin(3.0 * t), 0.2 * np.sin(np.pi * t)], axis=1)
    level = ActionLevel(imitate(curved), PARAMETERS)
    start, goal = np.array([0.1, 0.2, 0.3]), np.array([0.9, -0.4, 0.6])

    def end_of(start: FloatArray, goal: FloatArray) -> FloatArray:
        begin = initial_segment(DMP, start, goal, 0.0)
        return level.step(begin, goal, Surroundings(), 0.0, 0.005, 80).end.p_WE

    for axis, same in (((0.0, 0.0, 1.1), True), ((0.7, 0.0, 0.0), False)):
        Q = Rotation.from_rotvec(axis).as_matrix()
        difference = np.abs(end_of(Q @ start, Q @ goal) - Q @ end_of(start, goal)).max()
        assert bool(difference < 1e-9) == same


# No input is too odd.


@MANY
@given(
    seed=seeds,
    size=st.sampled_from([1e-6, 1.0, 1e6]),
    alpha=st.sampled_from([0.0, 1e-300, 1.0, 1e300]),
    psi=st.sampled_from([1e-300, 1e-3, 1.0, 1e300]),
    kappa=st.sampled_from([0.0, 1.0, 1e300]),
    where=st.sampled_from(["start", "goal", "near the start", "middle"]),
    moving=st.sampled_from([-1.0, 0.0, 1.0]),
    period=st.sampled_from([1e-300, 1e-3, 1.0, 1e3]),
    about_route=st.booleans(),
)
def test_odd_but_finite_scenes_yield_finite_motions(
    seed: int,
    size: float,
    alpha: float,
    psi: float,
    kappa: float,
    where: str,
    moving: float,
    period: float,
    about_route: bool,
) -> None:
    rng = np.random.default_rng(seed)
    way = rng.normal(size=3)
    start, goal = np.zeros(3), size * way
    place = {"start": 0.0, "goal": 1.0, "near the start": 1e-12, "middle": 0.5}[where]
    R_WL = local_frame(start, goal)
    state = PolicyState(z_W=moving * goal, p_WG=goal, R_WL=R_WL, speed=rng.choice([0.0, 1e-9, 1.0]))
    centers = np.repeat(place * goal[None], 2, axis=0)
    ellipsoids = replace(random_ellipsoids(rng, 2), p_WO=centers)
    coupling = CouplingParameters(
        *(np.full(2, value) for value in (alpha, psi, kappa)),
        np.ones(2, dtype=bool),
        centers if about_route else np.zeros((0, 3)),
    )
    route = replace(random_route(rng, 2, R_WL), heading_W=np.zeros((0, 3)))
    around = Surroundings.of(ellipsoids, coupling, route)
    segment = Segment.resting(state)
    for _ in range(3):
        segment = LEVEL.step(segment, goal, around, segment.end.stamp, period)
        motion = segment.motion
        for bundle in (motion.begin, motion.end, motion.course):
            assert all(np.isfinite(value).all() for value in bundle)


@pytest.mark.parametrize("in_plane", [False, True])
@FEW
@given(seed=seeds, log_alpha=st.floats(0.0, 9.0))
def test_a_head_on_motion_passes_on_the_chosen_side(
    in_plane: bool, seed: int, log_alpha: float
) -> None:
    rng = np.random.default_rng(seed)
    start, way = rng.normal(size=(2, 3))
    goal = start + way / np.linalg.norm(way)
    R_WL = local_frame(start, goal)
    angle = rng.uniform(0.0, 6.28)
    side = R_WL @ np.array([0.0, math.cos(angle), math.sin(angle)])
    middle = 0.5 * (start + goal)
    ellipsoids = replace(
        random_ellipsoids(rng, 1), p_WO=middle[None], semi_axes=np.full((1, 3), 0.1)
    )
    coupling = CouplingParameters(
        np.array([math.exp(log_alpha)]),
        np.array([0.6]),
        np.array([5.0]),
        np.ones(1, dtype=bool),
        middle[None] if in_plane else np.zeros((0, 3)),
        np.cross(R_WL[:, 0], side)[None],
    )
    around = Surroundings.of(ellipsoids, coupling, None)
    segment = initial_segment(DMP, start, goal, 0.0)
    sides = []
    for _ in range(25):
        segment = LEVEL.step(segment, goal, around, segment.end.stamp, 0.004)
        sides.append((segment.end.p_WE - start) @ side)
    assert sides[-1] > 0.0
    assert min(sides) > -1e-12
