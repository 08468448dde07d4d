"""The arm's spheres among solids: how fast each may be approached."""

from dataclasses import replace

import numpy as np
import pytest

from drake_oa.geometry.solids import box, solids_of, sphere
from drake_oa.planning.arm_world import (
    group_distances,
)
from drake_oa.robot.arm import Chain, Spheres
from drake_oa.safety.approach_kernels import (
    NOTHING,
    SolidRules,
    braking_scale,
    kept_along,
    planned_rate,
    solid_limit,
)

T_REACTION, STEP, HOLD = 0.3, 0.008, 0.25


@pytest.fixture
def arm() -> tuple[Chain, Spheres]:
    """One joint about z with a sphere of 5 cm half a metre from it."""
    X_PJ = np.tile(np.eye(4), (2, 1, 1))
    chain = Chain(X_PJ, np.full(1, -3.0), np.full(1, 3.0), np.full(1, 2.0), np.full(1, 0.55))
    one, zero = np.array([0, 1]), np.zeros(1, dtype=np.int64)
    p, ball = np.array([[0.5, 0.0, 0.0]]), np.array([[0.5, 0.0, 0.0, 0.05]])
    tool = np.ones(1, dtype=bool)
    pairs = np.zeros((0, 2), dtype=np.int64)
    spheres = Spheres(
        zero, p, np.full(1, 0.05), tool, one, zero, ball, one, one, ball, pairs, np.zeros(0)
    )
    return chain, spheres


def rules(stop: float = 0.025, *, verified: bool = False, passing: bool = False) -> SolidRules:
    return SolidRules(np.full((1, 1), stop), T_REACTION, STEP, HOLD, 0.3, verified, passing)


def ball_at(y: float, v_y: float = 0.0):
    X_WO = np.eye(4)
    X_WO[:2, 3] = 0.5, y
    return solids_of([replace(sphere(0.05), X_WO=X_WO, v_WO=np.array([0.0, v_y, 0.0]))])


def test_approach_is_what_finite_differences_say(arm) -> None:
    rate, q, dt = np.array([1.5]), np.array([0.1]), 1e-6
    solids = solids_of(
        [
            replace(
                box([0.1, 0.1, 0.1]), X_WO=np.vstack([ball_at(0.25).X_WO[0], [0.0, 0.0, 0.0, 1.0]])
            )
        ]
    )
    near, nearer = (group_distances(*arm, solids, q + s * rate, 0.0)[0, 0] for s in (0.0, dt))
    scale, group, solid, distance, oncoming = solid_limit(*arm, solids, q, rate, 0.0, rules())
    assert (group, solid, oncoming) == (0, 0, 0.0)
    assert distance == pytest.approx(near)
    assert scale * (near - nearer) / dt * T_REACTION == pytest.approx(near - 0.025, rel=1e-4)


def test_what_moves_slows_a_verified_motion_as_any_other(arm) -> None:
    q, v = np.zeros(1), np.ones(1)
    moving = ball_at(0.3, -0.4)
    free, known = (solid_limit(*arm, moving, q, v, 0.0, rules(verified=k)) for k in (False, True))
    assert free == known
    left = free[3] - 0.025
    assert free[0] == pytest.approx((left / T_REACTION - 0.4) / 0.5)
    assert solid_limit(*arm, moving, q, v, 0.0, rules(passing=True))[2] == NOTHING
    later = solid_limit(*arm, moving, q, v, 0.1, rules())
    assert later[3] == pytest.approx(free[3] - 0.04)


def test_verified_motion_brakes_within_what_is_left(arm) -> None:
    q, v = np.zeros(1), np.ones(1)
    rests = ball_at(0.15)
    scale, _, _, distance, _ = solid_limit(*arm, rests, q, v, 0.0, rules(verified=True))
    assert scale * STEP * 0.5 + 0.5 * scale**2 * HOLD * 0.5 == pytest.approx(distance - 0.025)
    assert scale > solid_limit(*arm, rests, q, v, 0.0, rules())[0]
    assert braking_scale(-1e-3, 0.5, rules()) == 0.0
    assert braking_scale(1e-3, 0.0, rules()) == 1.0


def test_motion_keeps_the_least_along_it(arm) -> None:
    q = np.linspace(0.0, 0.2, 9)[:, None]
    each = [group_distances(*arm, ball_at(0.3), row, 0.0) for row in q]
    kept = kept_along(*arm, ball_at(0.3), q, 0.0, 1.0)
    np.testing.assert_allclose(kept, np.min(each, axis=0))
    assert kept_along(*arm, ball_at(0.3), q, 0.0, 0.03)[0, 0] == 0.03
    s = np.linspace(0.0, 1.0, 9)
    np.testing.assert_allclose(planned_rate(s, q, np.array([0.11])), [0.2])
