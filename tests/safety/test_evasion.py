"""Getting out of the way of what moves: looking ahead, and choosing."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.math import RigidTransform

from drake_oa.common.messages import (
    Evasion,
    FloatArray,
    IntArray,
    PlannedMotion,
    PolicyState,
    TablePlane,
)
from drake_oa.common.thinking import counted
from drake_oa.geometry.directions import ramped
from drake_oa.geometry.solids import SURROUNDINGS, SolidScene, solids_of, sphere, table_solid
from drake_oa.planning.arm_world import (
    FAR,
    excess,
    group_distances,
)
from drake_oa.safety.config import EvasionSettings
from drake_oa.safety.evasion import NOTHING_MOVES, choose
from drake_oa.safety.evasion_candidates import displaced, planned_shift, shortened, stopping_shift
from drake_oa.safety.guarded_arm import GuardedArm
from drake_oa.safety.lookout import FULL, HELD, Lookout, Underway
from tests.planning.arms import ArmAlone

PARAMETERS = EvasionSettings(padding=0.0, turn_speed=0.0)
RATE = 0.2
"""ds/dt at full speed [1/s]."""


@dataclass
class Home:
    """The Panda at its home posture."""

    panda: ArmAlone
    arm: GuardedArm

    @property
    def p_WE(self) -> FloatArray:
        return self.panda.X_WE[9:]

    def lookout(
        self,
        scene: SolidScene,
        parameters: EvasionSettings = PARAMETERS,
        policy: PolicyState | None = None,
        **more: Any,
    ) -> Lookout:
        policy = PolicyState(p_WE=self.p_WE) if policy is None else policy
        underway = Underway(policy, 0.3, RATE, more.pop("motion", None))
        return Lookout(self.arm, self.panda.q, scene, 0.0, underway, parameters, **more)

    def decide(
        self,
        scene: SolidScene,
        z_W: FloatArray | None = None,
        before: Evasion = NOTHING_MOVES,
        speed: float = 0.0,
        parameters: EvasionSettings = PARAMETERS,
    ) -> Evasion:
        """Held unless a speed is given."""
        z = np.zeros(3) if z_W is None else z_W
        policy = PolicyState(p_WE=self.p_WE, z_W=z, speed=speed)
        ahead = self.lookout(scene, parameters, policy)
        return choose(before, before.velocity, np.zeros(7), ahead, parameters)


@pytest.fixture(scope="module")
def home(panda: ArmAlone, guarded: GuardedArm) -> Home:
    return Home(panda, guarded)


def ball(center: FloatArray, velocity: FloatArray, radius: float = 0.05) -> SolidScene:
    """A sphere that moves, and one at rest far away."""
    far = RigidTransform([5.0, 0.0, 0.0]).GetAsMatrix4()
    X_WO = RigidTransform(center).GetAsMatrix4()
    solids = [
        replace(sphere(radius), X_WO=X_WO, v_WO=velocity, name=4, label="obstacle 4"),
        replace(sphere(0.01), X_WO=far, name=9, label="obstacle 9"),
    ]
    return SolidScene(0.0, solids_of(solids), tuple(solid.label for solid in solids))


def table(height: float) -> SolidScene:
    """And a ball that moves, far away."""
    far = RigidTransform([5.0, 5.0, 5.0]).GetAsMatrix4()
    moving = replace(sphere(0.05), X_WO=far, v_WO=np.array([0.1, 0.0, 0.0]), name=4)
    plane = replace(table_solid(TablePlane(offset=height)), name=SURROUNDINGS)
    return SolidScene(0.0, solids_of([moving, plane]), ("obstacle 4", "the table"))


def own_distance(home: Home, q: FloatArray) -> float:
    """What the arm keeps of itself [m]."""
    world = home.panda.among(own=0.0)
    return excess(world, q, 0.0, FAR, np.empty((9, 12)), np.empty((len(world.spheres.bound), 3)))


def still(count: int = 1, held: int = HELD) -> tuple[FloatArray, FloatArray, IntArray]:
    """Ways that lead nowhere."""
    K = PARAMETERS.instants
    return np.zeros((count, K, 3)), np.zeros((count, K, 7)), np.full(count, held)


def along(way: list[float]) -> tuple[FloatArray, FloatArray, IntArray]:
    """One at a velocity [m/s]."""
    _, turns, led = still()
    return PARAMETERS.times[None, :, None] * np.array(way), turns, led


# Looking ahead.


def test_a_ball_that_comes_is_as_near_as_it_will_be(home: Home) -> None:
    # From ahead of the tool point, along x; the hand's own extent is unknown here.
    far = home.lookout(ball(home.p_WE + [0.6, 0.0, 0.0], np.zeros(3)))
    coming = home.lookout(ball(home.p_WE + [0.6, 0.0, 0.0], np.array([-0.5, 0.0, 0.0])))
    assert far.nearest(far.look(*still()), 0) == -1
    with counted() as work:
        found = coming.look(*still())
    # Each way now and at each instant.
    assert work.poses == work.configurations == 1 + PARAMETERS.instants
    assert (coming.nearest(found, 0), found.clearance[0] < 0.0) == (0, True)
    other = np.array([False, True])
    assert coming.nearest(coming.look(*still(), among=other), 0, other) == -1
    # What is only seen to come may be nearer, by and by.
    assert coming.gap(found, 0, 0) == pytest.approx(
        found.distance[0] + PARAMETERS.growth * found.when[0]
    )
    # Whoever flees at its speed keeps the distance.
    slow = home.lookout(ball(home.p_WE + [0.2, 0.0, 0.0], np.array([-0.1, 0.0, 0.0])))
    flees = slow.look(*along([-0.1, 0.0, 0.0]))
    assert flees.clearance[0] > slow.look(*still()).clearance[0]


def test_a_way_is_as_near_as_its_spheres_are(home: Home) -> None:
    scene = ball(home.p_WE + [0.25, 0.05, 0.1], np.array([-0.2, 0.0, 0.0]))
    wide = EvasionSettings(padding=0.01, margin=0.2, growth=0.05)
    found = home.lookout(scene, wide).look(*along([0.1, 0.0, 0.05]))
    chain, spheres = home.arm.chain, home.arm.spheres
    near = group_distances(chain, spheres, scene.solids, found.q[0], float(found.when[0]))
    expected = near[spheres.group_joint >= 0, 0].min() - 0.01 - 0.05 * found.when[0]
    assert found.clearance[0] == pytest.approx(expected, abs=1e-9)
    X_WE = home.panda.poses(found.q[0])[-1]
    shift = found.when[0] * np.array([0.1, 0.0, 0.05])
    np.testing.assert_allclose(X_WE[9:], home.p_WE + shift, atol=1e-3)
    np.testing.assert_allclose(X_WE[:9], home.panda.X_WE[:9], atol=1e-3)


def test_what_the_arm_cannot_follow_is_no_way(home: Home) -> None:
    arm = home.lookout(ball(np.array([5.0, 5.0, 5.0]), np.array([0.1, 0.0, 0.0])))
    for reach in ([2.0, 0.0, 0.0], [0.0, 0.0, 3.0]):
        assert arm.look(*along(reach)).clearance[0] == -np.inf
    inside = home.lookout(table(0.0), table_height=float(home.p_WE[2]) - 0.05)
    assert inside.look(*along([0.0, 0.0, -0.1])).clearance[0] == -np.inf
    assert inside.look(*along([0.0, 0.0, -0.01])).clearance[0] > 0.0


def test_a_turn_by_which_the_arm_touches_itself_is_no_way(home: Home) -> None:
    rng = np.random.default_rng(0)
    while True:
        q = home.panda.random_q(rng)
        if own_distance(home, q) < -0.02:
            break
    scene, policy = table(-5.0), PolicyState(p_WE=home.panda.poses(q)[-1, 9:])
    touches = Lookout(home.arm, q, scene, 0.0, Underway(policy, 0.3, RATE), PARAMETERS)
    # It may stay as it is, and come no nearer to itself; but not come to it.
    assert touches.look(*still()).clearance[0] > 0.0
    fast = replace(home.arm, chain=home.arm.chain._replace(speed=np.full(7, 1e3)))
    clear = Lookout(fast, home.panda.q, scene, 0.0, Underway(policy, 0.3, RATE), PARAMETERS)
    clear._own = FAR + 1e-3
    assert clear.look(*still()).clearance[0] == -np.inf


def test_a_motion_leads_orientation_and_posture(home: Home) -> None:
    s = np.linspace(0.0, 1.0, 41)
    q = home.panda.q + 0.4 * (s[:, None] - 0.3) * np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    motion = PlannedMotion(s, np.tile(home.p_WE, (41, 1)), q)
    ahead = home.lookout(
        ball(home.p_WE + [0.15, 0.0, 0.0], np.array([0.0, 0.01, 0.0])), motion=motion
    )
    shifts, turns, led = still(2)
    led[1] = FULL
    found = ahead.look(shifts, turns, led)
    np.testing.assert_allclose(found.q[0], home.panda.q, atol=1e-9)
    turned = found.q[1, 6] - home.panda.q[6]
    assert turned == pytest.approx(0.4 * RATE * found.when[1], abs=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_turning_in_the_null_space_leaves_the_tool_where_it_is(home: Home, seed: int) -> None:
    speed = np.random.default_rng(seed).uniform(-1.0, 1.0, 7)
    near = home.lookout(ball(home.p_WE + [0.15, 0.0, 0.0], np.array([-0.05, 0.0, 0.0])))
    turn = near.free @ (near.free.T @ speed)
    shifts, turns, led = still()
    turns = turns + PARAMETERS.times[None, :, None] * turn
    found = near.look(shifts, turns, led)
    np.testing.assert_allclose(home.panda.poses(found.q[0])[-1], home.panda.X_WE, atol=1e-3)
    # Nor does it stand still.
    assert (found.q[0] - home.panda.q) @ turn > 0.3 * found.when[0] * (turn @ turn)


# Ways.


@settings(max_examples=50)
@given(seed=st.integers(0, 10_000))
def test_a_displacement_is_the_integral_of_its_velocity(seed: int) -> None:
    rng = np.random.default_rng(seed)
    u, wanted = rng.uniform(-0.4, 0.4, (2, 3))
    a, step = 2.0, 1e-4
    shift, velocity, found = np.zeros(3), u, []
    for _ in range(4000):
        after = ramped(velocity, wanted, a * step)
        assert np.linalg.norm(after - velocity) <= a * step + 1e-12
        shift = shift + 0.5 * step * (velocity + after)
        velocity = after
        found.append(shift)
    at = np.array([0.05, 0.2, 0.4])
    expected = [found[round(t / step) - 1] for t in at]
    np.testing.assert_allclose(displaced(u, wanted[None], at, a)[0], expected, atol=1e-4)


def test_a_planned_motion_is_followed_at_the_rate_that_it_has() -> None:
    s = np.linspace(0.0, 1.0, 11)
    path = np.stack([s, s**2, np.zeros(11)], axis=1)
    motion = PlannedMotion(s, path)
    policy = PolicyState(z_W=np.array([1.0, 0.6, 0.0]))
    times = np.array([1.0, 10.0])
    found = planned_shift(policy, motion, 0.3, 0.2, times)
    np.testing.assert_allclose(found, [[0.2, 0.16, 0.0], [0.7, 0.91, 0.0]])
    assert not planned_shift(policy, motion, 0.3, 0.0, times).any()
    straight = planned_shift(policy, None, 0.3, 0.2, times)
    np.testing.assert_allclose(straight, [[0.2, 0.12, 0.0], [0.7, 0.42, 0.0]])


def test_a_motion_that_is_held_goes_half_as_far_as_it_would() -> None:
    v = np.array([0.4, 0.0, 0.0])
    found = stopping_shift(v, np.array([0.25, 3.0]), 0.25)
    np.testing.assert_allclose(found, [[0.05, 0.0, 0.0]] * 2)


# Choosing.


def test_nothing_is_done_while_nothing_moves(home: Home) -> None:
    near = ball(home.p_WE + [0.08, 0.0, 0.0], np.zeros(3))
    assert home.decide(near) is NOTHING_MOVES
    assert not NOTHING_MOVES.velocity.any()


def test_what_moves_far_away_or_leaves_is_left_alone(home: Home) -> None:
    p_WE = home.p_WE
    assert home.decide(ball(p_WE + [1.0, 0.0, 0.0], np.array([-0.2, 0.0, 0.0]))) is NOTHING_MOVES
    # What is close and leaves is close now only.
    gone = home.decide(ball(p_WE + [0.3, 0.0, 0.0], np.array([0.4, 0.0, 0.0])))
    assert gone is NOTHING_MOVES


def test_a_ball_that_comes_at_a_held_robot_is_evaded(home: Home) -> None:
    coming = ball(home.p_WE + [0.3, 0.0, 0.0], np.array([-0.3, 0.0, 0.0]))
    found = home.decide(coming)
    assert (found.action, found.obstacle, found.certain) == ("evading", 4, False)
    assert 0.0 < np.linalg.norm(found.velocity) <= PARAMETERS.speed + 1e-9
    assert found.clearance > 0.0
    # It stays with it.
    again = home.decide(coming, before=found)
    np.testing.assert_array_equal(again.velocity, found.velocity)


def test_a_motion_that_leaves_the_way_in_time_goes_on(home: Home) -> None:
    coming = ball(home.p_WE + [0.3, 0.0, 0.0], np.array([-0.3, 0.0, 0.0]))
    found = home.decide(coming, z_W=np.array([0.0, 2.5, 0.0]))
    assert (found.action, found.velocity.any()) == ("going on", False)


def test_a_motion_that_would_run_into_it_waits(home: Home) -> None:
    p_WE = home.p_WE
    # It crosses ahead of the motion.
    crossing = ball(p_WE + [-0.2, 0.28, 0.0], np.array([0.4, 0.0, 0.0]))
    z = np.array([0.0, 2.0, 0.0])
    found = home.decide(crossing, z_W=z, speed=RATE)
    assert found.action == "waiting"
    assert not found.velocity.any()


def test_what_is_faster_than_the_arm_cannot_be_evaded(home: Home) -> None:
    # At the shoulder, which cannot leave.
    center, velocity = np.array([1.3, 0.0, 0.35]), np.array([-3.0, 0.0, 0.0])
    found = home.decide(ball(center, velocity))
    assert (found.action, found.obstacle) == ("caught", 4)
    assert found.certain == (found.contact <= 0.4)
    assert home.decide(ball(center + 0.1 * velocity, velocity)).certain


def at_the_elbow(home: Home) -> SolidScene:
    """A ball that comes at the elbow from the side, which the hand need not step aside for."""
    elbow = home.panda.centers(home.panda.q)[home.arm.spheres.joint == 3].mean(axis=0)
    return ball(elbow + [0.18, 0.27, -0.04], np.array([-0.08, -0.11, -0.05]), 0.04)


def test_an_elbow_that_is_come_at_turns_out_of_the_way_and_the_tool_stays(home: Home) -> None:
    scene = at_the_elbow(home)
    turns = EvasionSettings(padding=0.0, turn_speed=1.5)
    found = home.decide(scene, parameters=turns)
    assert found.action in ("going on", "waiting")
    assert not found.velocity.any()
    assert 0.0 < np.linalg.norm(found.turn) <= turns.turn_speed + 1e-9
    free = home.lookout(scene).free
    np.testing.assert_allclose(free @ (free.T @ found.turn), found.turn, atol=1e-12)
    assert found.clearance >= turns.margin
    # It keeps the posture that it has turned to until nothing that moves is near any more.
    leaving = ball(home.p_WE + [0.16, 0.0, 0.0], np.array([0.02, 0.0, 0.0]))
    after = home.decide(leaving, before=found, parameters=turns)
    assert (after.action, after.turn.tolist()) == ("", [0.0] * 7)
    elsewhere = ball(home.p_WE + [2.0, 0.0, 0.0], np.array([0.1, 0.0, 0.0]))
    assert home.decide(elsewhere, before=after, parameters=turns) is NOTHING_MOVES


def test_without_a_null_space_or_a_speed_the_tool_is_displaced(home: Home) -> None:
    found = home.decide(at_the_elbow(home))
    assert (found.action, len(found.turn)) == ("evading", 0)
    turns = EvasionSettings(padding=0.0, turn_speed=1.5)
    stiff = home.lookout(at_the_elbow(home), turns)
    stiff.free = np.zeros((7, 0))
    same = choose(NOTHING_MOVES, np.zeros(3), np.ones(7), stiff, turns)
    assert (same.action, len(same.turn)) == ("evading", 0)
    np.testing.assert_array_equal(same.velocity, found.velocity)


def test_an_arm_that_can_go_no_way_is_held_or_caught(home: Home) -> None:
    # So slow that it can follow none.
    stuck = replace(home.arm, chain=home.arm.chain._replace(speed=np.full(7, 1e-9)))
    policy = PolicyState(p_WE=home.p_WE)
    for center, action in ((0.12, "caught"), (0.25, "waiting")):
        scene = ball(home.p_WE + [center, 0.0, 0.0], np.array([-0.1, 0.0, 0.0]), 0.05)
        underway = Underway(policy, 0.3, RATE)
        ahead = Lookout(stuck, home.panda.q, scene, 0.0, underway, PARAMETERS)
        velocity = np.array([0.1, 0.0, 0.0])
        found = choose(NOTHING_MOVES, velocity, np.zeros(7), ahead, PARAMETERS)
        assert (found.action, found.velocity.tolist()) == (action, [0.0] * 3)
        assert math.isfinite(found.clearance)


def test_what_rests_hides_nothing_that_moves(home: Home) -> None:
    # Nearer than what comes, it is the supervisor's.
    coming = ball(home.p_WE + [0.3, 0.0, 0.0], np.array([-0.3, 0.0, 0.0]))
    X_WO = RigidTransform(home.p_WE - [0.1, 0.0, 0.0]).GetAsMatrix4()
    rests = replace(sphere(0.05), X_WO=X_WO, name=9, label="obstacle 9")
    moving = replace(
        sphere(0.05),
        X_WO=RigidTransform(home.p_WE + [0.3, 0.0, 0.0]).GetAsMatrix4(),
        v_WO=np.array([-0.3, 0.0, 0.0]),
        name=4,
    )
    both = SolidScene(0.0, solids_of([rests, moving]), ("obstacle 9", "obstacle 4"))
    assert home.decide(coming).obstacle == home.decide(both).obstacle == 4


@pytest.mark.parametrize("seed", range(25))
def test_it_is_never_worse_than_standing_still(home: Home, seed: int) -> None:
    rng = np.random.default_rng(seed)
    toward = rng.normal(size=3)
    toward /= np.linalg.norm(toward)
    speed = rng.uniform(0.05, 1.0)
    center = home.p_WE + rng.uniform(0.1, 0.8) * speed * toward + rng.normal(0.0, 0.05, 3)
    scene = ball(center, -speed * toward, rng.uniform(0.02, 0.08))
    found = home.decide(scene)
    look = home.lookout(scene)
    stands = look.look(*still()).clearance[0]
    shift = displaced(np.zeros(3), found.velocity[None], PARAMETERS.times, PARAMETERS.acceleration)
    ways = np.concatenate([shift, shortened(shift, 0.2), shortened(shift, 0.08)])
    _, turns, led = still(3)
    chosen = look.look(ways, turns, led).clearance.max()
    assert chosen >= min(stands, PARAMETERS.margin) - 1e-9
    assert np.linalg.norm(found.velocity) <= PARAMETERS.speed + 1e-9
    # And the same each time.
    np.testing.assert_array_equal(home.decide(scene).velocity, found.velocity)
