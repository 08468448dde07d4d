"""Roll-outs of the tool: the motion that the integrator executes, and where they end."""

import math

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator

from drake_oa.common.messages import CouplingParameters, EllipsoidSet, FloatArray, Route
from drake_oa.policy.action import Surroundings
from drake_oa.policy.config import Policy
from drake_oa.policy.coupling import ALPHA, KAPPA, N_COLUMNS, NORMAL, PSI
from drake_oa.policy.dmp import imitate, local_frame, minimum_jerk
from drake_oa.policy.dmp_integrator import DmpIntegrator
from drake_oa.policy.guidance import Obstacles
from drake_oa.policy.rollout import Scene, roll_out_tool
from drake_oa.route.cost_rings import passing_normals
from tests.builders import balls, read

START, GOAL, T = np.zeros(3), np.array([0.8, 0.3, 0.1]), 2.0
DMP = imitate(*minimum_jerk(START, GOAL, duration=T))
POLICY = Policy(period=T / 200)
SCENE = Scene(START, np.zeros(3), GOAL, local_frame(START, GOAL), float(np.linalg.norm(GOAL)))


def random_terms(seed: int, count: int) -> FloatArray:
    """(count, 13) terms on every side of the baseline, not so strong that rounding decides."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0.0, 2.0 * math.pi, count)[:, None]
    R_WL = SCENE.R_WL
    terms = np.zeros((count, N_COLUMNS))
    terms[:, :3] = rng.uniform(0.3, 0.7, (count, 1)) * GOAL + rng.normal(0.0, 0.05, (count, 3))
    terms[:, NORMAL : NORMAL + 3] = np.cos(angle) * R_WL[:, 2] - np.sin(angle) * R_WL[:, 1]
    terms[:, ALPHA] = np.exp(rng.uniform(1.0, 5.0, count))
    terms[:, PSI], terms[:, KAPPA] = rng.uniform(0.3, 1.5, (2, count))
    return terms


def simulated(
    ellipsoids: EllipsoidSet, coupling: CouplingParameters, route: Route | None, end: float
) -> tuple[FloatArray, FloatArray]:
    """Positions and scaled velocities (n + 1, 3) of a DmpIntegrator in a Simulator."""
    system = DmpIntegrator(DMP, START, config=POLICY)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    system.GetInputPort("goal").FixValue(context, GOAL)
    given = {"ellipsoids_W": ellipsoids, "coupling_parameters": coupling, "route": route}
    for name, value in given.items():
        if value is not None:
            system.GetInputPort(name).FixValue(context, Value(value))
    places, velocities = [], []
    for step in range(round(end * T / POLICY.period) + 1):
        simulator.AdvanceTo(step * POLICY.period)
        places.append(read(system, context, "desired_position"))
        velocities.append(T * read(system, context, "desired_velocity"))
    return np.array(places), np.array(velocities)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("count", [1, 3])
def test_the_integrator_in_drake_executes_a_roll_out(seed: int, count: int) -> None:
    terms = random_terms(seed, count)
    coupling = CouplingParameters(
        *np.ascontiguousarray(terms[:, ALPHA : KAPPA + 1].T),
        np.ones(count, dtype=bool),
        terms[:, :3],
        terms[:, NORMAL : NORMAL + 3],
        tau=1.0,
        verified=True,
    )
    found = roll_out_tool(SCENE, terms[None], dmp=DMP, policy=POLICY, end=1.2, latest=1.2)
    p, z = simulated(EllipsoidSet(stamp=math.inf), coupling, None, 1.2)
    np.testing.assert_allclose(found.path[0, : len(p)], p, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(found.velocity[0, : len(z)], z, rtol=0.0, atol=1e-11)


@pytest.mark.parametrize("seed", range(4))
def test_the_integrator_executes_a_guided_roll_out(seed: int) -> None:
    rng, R_WL = np.random.default_rng(seed), SCENE.R_WL
    seen = balls(
        *(0.35 * GOAL - 0.03 * R_WL[:, 2], 0.7 * GOAL + 0.03 * R_WL[:, 1]),
        radius=0.01,
        stamp=math.inf,
    )
    parameters = np.array([[60.0, 40.0], [0.9, 0.7], [3.0, 8.0]]) * rng.uniform(0.7, 1.3, (3, 2))
    angle = rng.uniform(0.0, 2.0 * math.pi, 2)[:, None]
    direction = np.cos(angle) * R_WL[:, 1] + np.sin(angle) * R_WL[:, 2]
    route = Route(
        direction_W=direction,
        normal_W=passing_normals(direction, R_WL),
        remaining_clearance=np.full(2, 0.08),
        path_length=0.0,
    )
    coupling = CouplingParameters(*parameters, np.ones(2, dtype=bool))
    led: Obstacles = Surroundings.of(seen, coupling, route).obstacles
    how = {"dmp": DMP, "policy": POLICY, "end": 1.0, "latest": 1.0}
    found = roll_out_tool(SCENE, led.terms[None], obstacles=led, **how)
    p, _ = simulated(seen, coupling, route, 1.0)
    np.testing.assert_allclose(found.path[0, : len(p)], p, rtol=0.0, atol=1e-12)
    alone = roll_out_tool(SCENE, led.terms[None], **how)
    assert (alone.path[0, : len(p)] != found.path[0, : len(p)]).any()


def test_candidates_end_where_they_arrive_and_early_where_they_are_too_long() -> None:
    terms = np.stack([random_terms(seed, 1) for seed in range(20)])
    terms[0, 0, ALPHA] = 0.0
    how = {"dmp": DMP, "policy": POLICY}
    whole = roll_out_tool(SCENE, terms, **how)
    assert whole.path_length[0] == pytest.approx(SCENE.baseline, rel=1e-3)
    last = whole.steps.astype(int)
    assert (last >= 200).all()
    ends = whole.path[np.arange(20), last]
    np.testing.assert_allclose(np.linalg.norm(ends - GOAL, axis=1), whole.goal_error)
    for row, end in enumerate(last):
        steps = np.linalg.norm(np.diff(whole.path[row, : end + 1], axis=0), axis=1)
        assert whole.path_length[row] == pytest.approx(steps.sum())
        assert np.isnan(whole.path[row, end + 1 :]).all()
    longest = 1.02 * SCENE.baseline
    some = roll_out_tool(SCENE, terms, longest=longest, **how)
    early = some.steps < whole.steps
    assert early.any()
    np.testing.assert_array_equal(early, whole.path_length + whole.goal_error > longest)
    np.testing.assert_array_equal(some.path[~early], whole.path[~early])
    # From the middle of a motion on.
    half = 120
    later = Scene(
        whole.path[1, half],
        whole.velocity[1, half],
        GOAL,
        SCENE.R_WL,
        SCENE.baseline,
        s=half * whole.ds,
    )
    rest = roll_out_tool(later, terms[1:2], **how).path[0]
    np.testing.assert_allclose(rest[: 201 - half], whole.path[1, half:201], atol=1e-10)
