"""Tests of the tool's roll-outs: equality with the integrator, and conditions of their end."""

import math
from dataclasses import replace

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from drake_oa.common.messages import CouplingParameters, EllipsoidSet, FloatArray, Route
from drake_oa.policy.action import CouplingInputs
from drake_oa.policy.config import Policy
from drake_oa.policy.coupling import ALPHA, KAPPA, N_COLUMNS, NORMAL, PSI
from drake_oa.policy.dmp import imitate, local_frame, minimum_jerk
from drake_oa.policy.dmp_integrator import DmpIntegrator
from drake_oa.policy.rollout import Scene, roll_out_tool
from tests.builders import balls, fix, read

START, GOAL, T = np.zeros(3), np.array([0.8, 0.3, 0.1]), 2.0
DMP = imitate(*minimum_jerk(START, GOAL, duration=T))
POLICY = Policy(period=T / 200)
SCENE = Scene(START, np.zeros(3), GOAL, local_frame(START, GOAL), float(np.linalg.norm(GOAL)))
HOW = {"dmp": DMP, "policy": POLICY}


def random_terms(seed: int, count: int) -> FloatArray:
    """Draws (count, 12) terms near the baseline, too weak to amplify rounding errors."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0.0, 2.0 * math.pi, count)[:, None]
    terms = np.zeros((count, N_COLUMNS))
    terms[:, :3] = rng.uniform(0.3, 0.7, (count, 1)) * GOAL + rng.normal(0.0, 0.05, (count, 3))
    terms[:, NORMAL:] = np.cos(angle) * SCENE.R_WL[:, 2] - np.sin(angle) * SCENE.R_WL[:, 1]
    terms[:, ALPHA] = np.exp(rng.uniform(1.0, 5.0, count))
    terms[:, PSI], terms[:, KAPPA] = rng.uniform(0.3, 1.5, (2, count))
    return terms


@pytest.mark.parametrize("guided", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_the_integrator_executes_the_roll_out(seed: int, guided: bool) -> None:
    terms = random_terms(seed, 3)
    coupling = CouplingParameters(
        *terms[:, ALPHA : KAPPA + 1].T, np.ones(3, dtype=bool), terms[:, :3], tau=1.0, verified=True
    )
    if guided:
        side = np.cross(terms[:, NORMAL:], SCENE.R_WL[:, 0])
        shapes = balls(*terms[:, :3], radius=0.01, stamp=math.inf)
        route = Route(
            direction_W=side, normal_W=terms[:, NORMAL:], remaining_clearance=np.full(3, 0.08)
        )
        coupling = replace(coupling, ellipsoids=shapes)
        obstacles = CouplingInputs.of(shapes, coupling, route).obstacles
    else:
        coupling, route, obstacles = replace(coupling, normal_W=terms[:, NORMAL:]), None, None
    rolled = roll_out_tool(SCENE, terms[None], obstacles=obstacles, end=1.2, latest=1.2, **HOW)

    system = DmpIntegrator(DMP, START, config=POLICY)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    # Verified terms do not require ellipsoids.
    more = {"route": route, "ellipsoids_W": EllipsoidSet(stamp=math.inf)} if guided else {}
    fix(system, context, goal=GOAL, coupling_parameters=coupling, **more)
    for step in range(round(1.2 * T / POLICY.period) + 1):
        simulator.AdvanceTo(step * POLICY.period)
        for name, rows, scale in (("position", rolled.path, 1.0), ("velocity", rolled.velocity, T)):
            value = scale * read(system, context, f"desired_{name}")
            np.testing.assert_allclose(rows[0, step], value, rtol=0.0, atol=1e-11)
    unguided = roll_out_tool(SCENE, terms[None], **HOW)
    assert np.array_equal(unguided.path[0, :200], rolled.path[0, :200]) != guided
    # A changed input acts from the next step, and a motion of zero length is refused.
    fix(system, context, coupling_parameters=replace(coupling, alpha=-coupling.alpha))
    with pytest.raises(ValueError, match=r"alpha = -.* must be at least 0"):
        simulator.AdvanceTo(2.0 * T)
    simulator = Simulator(system)
    fix(system, simulator.get_mutable_context(), goal=START)
    with pytest.raises(ValueError, match="start and goal must be finite and apart"):
        simulator.Initialize()


def test_candidates_end_at_the_goal_or_when_their_path_is_too_long() -> None:
    terms = np.stack([random_terms(seed, 1) for seed in range(20)])
    terms[0, 0, ALPHA] = 0.0
    whole = roll_out_tool(SCENE, terms, **HOW)
    assert whole.path_length[0] == pytest.approx(SCENE.baseline, rel=1e-3)
    last = whole.steps.astype(int)
    assert (last >= 200).all()
    ends = whole.path[np.arange(20), last]
    np.testing.assert_allclose(np.linalg.norm(ends - GOAL, axis=1), whole.goal_error)
    steps = np.linalg.norm(np.diff(whole.path, axis=1), axis=2)
    np.testing.assert_allclose(np.nansum(steps, axis=1), whole.path_length)
    np.testing.assert_array_equal(np.isfinite(steps).sum(axis=1), last)
    longest = 1.02 * SCENE.baseline
    some = roll_out_tool(SCENE, terms, longest=longest, **HOW)
    early = some.steps < whole.steps
    assert early.any()
    np.testing.assert_array_equal(early, whole.path_length + whole.goal_error > longest)
    np.testing.assert_array_equal(some.path[~early], whole.path[~early])
    # A roll-out may start in the middle of a motion.
    half = 120
    begin = whole.path[1, half], whole.velocity[1, half]
    later = Scene(*begin, GOAL, SCENE.R_WL, SCENE.baseline, s=half * whole.ds)
    rest = roll_out_tool(later, terms[1:2], **HOW).path[0]
    np.testing.assert_allclose(rest[: 201 - half], whole.path[1, half:201], atol=1e-10)
