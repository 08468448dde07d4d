"""Getting out of the way of what moves: looking ahead, and choosing."""

import math
from functools import cache

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.multibody.tree import JacobianWrtVariable

from drake_oa.common.messages import Evasion, FloatArray, ObstacleClouds, PlannedMotion, PolicyState
from drake_oa.common.thinking import counted
from drake_oa.geometry.collision_shapes import collect_collision_shapes
from drake_oa.geometry.directions import ramped
from drake_oa.geometry.points import GuardShapes, ObstaclePoints
from drake_oa.robot.config import Robot
from drake_oa.robot.plant import home_positions, make_robot_plant
from drake_oa.safety import lookahead_kernels as kernels
from drake_oa.safety.config import EvasionSettings
from drake_oa.safety.evasion import NOTHING_MOVES, choose
from drake_oa.safety.evasion_candidates import displaced, planned_shift, shortened, stopping_shift
from drake_oa.safety.lookahead import Lookout, posed_arm
from drake_oa.safety.lookahead_kernels import Arm
from drake_oa.safety.obstacle_evasion import arm_joints

PARAMETERS = EvasionSettings(padding=0.0, turn_speed=0.0)
NO_TABLE = np.full(4, np.nan)
RATE = 0.2
"""ds/dt at full speed [1/s]."""


class Posed:
    """The Panda at its home posture."""

    def __init__(self) -> None:
        made = make_robot_plant(Robot())
        self.plant = plant = made.plant
        shapes = collect_collision_shapes(plant, made.scene_graph.model_inspector(), made.instance)
        self.frame = made.tool_frame
        self.bodies = [plant.get_body(index) for index in shapes.bodies]
        self.shapes = GuardShapes.of(shapes.shapes, len(self.bodies))
        joints = arm_joints(shapes, self.frame.body().index())
        self.joints, self.moved, self.limits = joints
        self.q = home_positions(made, Robot())
        self.context = plant.CreateDefaultContext()

    def body_poses(self, q: FloatArray) -> FloatArray:
        self.plant.SetPositions(self.context, q)
        return np.array([b.EvalPoseInWorld(self.context).GetAsMatrix4() for b in self.bodies])

    def arm(self) -> Arm:
        X_WB = self.body_poses(self.q)
        world = self.plant.world_frame()
        J = self.plant.CalcJacobianSpatialVelocity(
            self.context, JacobianWrtVariable.kV, self.frame, np.zeros(3), world, world
        )
        p_WE = self.frame.CalcPoseInWorld(self.context).translation()
        q = self.q[self.joints]
        return posed_arm(
            J[:, self.joints], p_WE, q, self.limits, self.shapes, X_WB, self.moved, PARAMETERS
        )


@cache
def posed() -> Posed:
    return Posed()


@cache
def home() -> Arm:
    return posed().arm()


def ball(center: FloatArray, velocity: FloatArray, radius: float = 0.05) -> ObstaclePoints:
    """A sphere that moves, and a point at rest far away."""
    rng = np.random.default_rng(0)
    way = rng.normal(size=(150, 3))
    points = center + radius * way / np.linalg.norm(way, axis=1, keepdims=True)
    clouds = (points, np.array([[5.0, 0.0, 0.0]]))
    v_WO = np.array([velocity, np.zeros(3)])
    return ObstaclePoints.of(ObstacleClouds(0.0, clouds, np.array([4, 9]), v_WO=v_WO))


def lookout(obstacles: ObstaclePoints, parameters: EvasionSettings = PARAMETERS) -> Lookout:
    return Lookout(home(), obstacles, NO_TABLE, 0.0, parameters)


def decide(
    obstacles: ObstaclePoints,
    z_W: FloatArray | None = None,
    before: Evasion = NOTHING_MOVES,
    speed: float = 0.0,
    motion: PlannedMotion | None = None,
    parameters: EvasionSettings = PARAMETERS,
) -> Evasion:
    """At the home posture, held unless a speed is given."""
    z = np.zeros(3) if z_W is None else z_W
    policy = PolicyState(p_WE=home().p_WE, z_W=z, speed=speed)
    return choose(
        before,
        before.velocity,
        np.zeros(7),
        policy,
        motion,
        0.3,
        RATE,
        lookout(obstacles, parameters),
        obstacles,
        parameters,
    )


# Looking ahead.


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_the_screws_give_the_poses_that_the_plant_has(seed: int) -> None:
    p, arm = posed(), home()
    n = len(arm.q)
    dq = np.random.default_rng(seed).uniform(-1.0, 1.0, n)
    T, moved = np.empty((n + 1, 3, 4)), np.empty((n, 6))
    kernels.arm_at(arm.screws, dq, T, moved)
    before = p.body_poses(p.q)
    q = p.q.copy()
    q[p.joints] += dq
    after = p.body_poses(q)
    for row, joint in enumerate(p.moved.sum(axis=1)):
        np.testing.assert_allclose(T[joint] @ before[row], after[row, :3], atol=1e-12)


def test_a_ball_that_comes_is_as_near_as_it_will_be() -> None:
    p_WE = home().p_WE
    # From ahead of the tool point, along x; the hand's own extent is unknown here.
    far = lookout(ball(p_WE + [0.6, 0.0, 0.0], np.zeros(3)))
    coming = lookout(ball(p_WE + [0.6, 0.0, 0.0], np.array([-0.5, 0.0, 0.0])))
    still = np.zeros((1, PARAMETERS.instants, 3))
    assert far.look(still).row[0] == kernels.NOTHING
    with counted() as work:
        found = coming.look(still)
    # Each way at each instant.
    assert work.poses == still.shape[0] * still.shape[1]
    assert (found.row[0], found.clearance[0] < 0.0) == (0, True)
    # Whoever flees at its speed keeps the distance.
    away = PARAMETERS.times[None, :, None] * np.array([-0.1, 0.0, 0.0])
    slow = lookout(ball(p_WE + [0.2, 0.0, 0.0], np.array([-0.1, 0.0, 0.0])))
    assert slow.look(away).clearance[0] > slow.look(still).clearance[0]


def test_what_the_arm_cannot_follow_is_no_way() -> None:
    arm = lookout(ball(np.array([5.0, 5.0, 5.0]), np.array([0.1, 0.0, 0.0])))
    for reach in ([2.0, 0.0, 0.0], [0.0, 0.0, 3.0]):
        shift = PARAMETERS.times[None, :, None] * np.array(reach)
        assert arm.look(shift).clearance[0] == -np.inf
    inside = Lookout(
        home(),
        ball(np.array([5.0, 5.0, 5.0]), np.array([0.1, 0.0, 0.0])),
        np.array([0.0, 0.0, 1.0, 0.0]),
        0.0,
        PARAMETERS,
        table_height=float(home().p_WE[2]) - 0.05,
    )
    down = PARAMETERS.times[None, :, None] * np.array([0.0, 0.0, -0.1])
    assert inside.look(down).clearance[0] == -np.inf
    assert inside.look(0.1 * down).clearance[0] > 0.0


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_turning_in_the_null_space_leaves_the_tool_where_it_is(seed: int) -> None:
    arm, times = home(), PARAMETERS.times
    speed = np.random.default_rng(seed).uniform(-1.0, 1.0, 7)
    n = len(arm.q)
    turn = 0.1 * (arm.free @ (arm.free.T @ speed))
    dq, T, moved = np.zeros(n), np.empty((n + 1, 3, 4)), np.empty((n, 6))
    for _ in times:
        for step in (turn, np.zeros(n)):
            kernels.step_to(arm.screws, arm.p_WE, arm.p_WE, 1e-5, step, dq, T, moved)
    kernels.arm_at(arm.screws, dq, T, moved)
    np.testing.assert_allclose(T[n, :, :3], np.eye(3), atol=1e-3)
    np.testing.assert_allclose(T[n] @ [*arm.p_WE, 1.0], arm.p_WE, atol=1e-3)
    # Nor does it stand still.
    assert dq @ turn > 0.5 * len(times) * (turn @ turn)


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


def test_nothing_is_done_while_nothing_moves() -> None:
    near = ball(home().p_WE + [0.08, 0.0, 0.0], np.zeros(3))
    assert decide(near) is NOTHING_MOVES
    assert not NOTHING_MOVES.velocity.any()


def test_what_moves_far_away_or_leaves_is_left_alone() -> None:
    p_WE = home().p_WE
    assert decide(ball(p_WE + [1.0, 0.0, 0.0], np.array([-0.2, 0.0, 0.0]))) is NOTHING_MOVES
    # What is close and leaves is close now only.
    gone = decide(ball(p_WE + [0.3, 0.0, 0.0], np.array([0.4, 0.0, 0.0])))
    assert gone is NOTHING_MOVES


def test_a_ball_that_comes_at_a_held_robot_is_evaded() -> None:
    coming = ball(home().p_WE + [0.3, 0.0, 0.0], np.array([-0.3, 0.0, 0.0]))
    found = decide(coming)
    assert (found.action, found.obstacle, found.certain) == ("evading", 4, False)
    assert 0.0 < np.linalg.norm(found.velocity) <= PARAMETERS.speed + 1e-9
    assert found.clearance > 0.0
    # It stays with it.
    again = decide(coming, before=found)
    np.testing.assert_array_equal(again.velocity, found.velocity)


def test_a_motion_that_leaves_the_way_in_time_goes_on() -> None:
    coming = ball(home().p_WE + [0.3, 0.0, 0.0], np.array([-0.3, 0.0, 0.0]))
    found = decide(coming, z_W=np.array([0.0, 2.5, 0.0]))
    assert (found.action, found.velocity.any()) == ("going on", False)


def test_a_motion_that_would_run_into_it_waits() -> None:
    p_WE = home().p_WE
    # It crosses ahead of the motion.
    crossing = ball(p_WE + [-0.2, 0.26, 0.0], np.array([0.4, 0.0, 0.0]))
    z = np.array([0.0, 2.0, 0.0])
    found = decide(crossing, z_W=z, speed=RATE)
    assert found.action == "waiting"
    assert not found.velocity.any()


def test_what_is_faster_than_the_arm_cannot_be_evaded() -> None:
    # At the shoulder, which cannot leave.
    center, velocity = np.array([1.3, 0.0, 0.35]), np.array([-3.0, 0.0, 0.0])
    found = decide(ball(center, velocity))
    assert (found.action, found.obstacle) == ("caught", 4)
    assert found.certain == (found.contact <= 0.4)
    assert decide(ball(center + 0.1 * velocity, velocity)).certain


def at_the_elbow() -> ObstaclePoints:
    """A ball that comes at the elbow from the side, which the hand need not step aside for."""
    arm = home()
    elbow = arm.X_WG[arm.joint == 4][:, :3, 3].mean(axis=0)
    return ball(elbow + [0.18, 0.27, -0.04], np.array([-0.08, -0.11, -0.05]), 0.04)


def test_an_elbow_that_is_come_at_turns_out_of_the_way_and_the_tool_stays() -> None:
    obstacles = at_the_elbow()
    turns = EvasionSettings(padding=0.0, turn_speed=1.5)
    found = decide(obstacles, parameters=turns)
    assert found.action in ("going on", "waiting")
    assert not found.velocity.any()
    assert np.linalg.norm(found.turn) <= turns.turn_speed + 1e-9
    free = home().free
    np.testing.assert_allclose(free @ (free.T @ found.turn), found.turn, atol=1e-12)
    assert found.clearance >= turns.margin
    # It keeps the posture that it has turned to until nothing that moves is near any more.
    leaving = ball(home().p_WE + [0.16, 0.0, 0.0], np.array([0.02, 0.0, 0.0]))
    after = decide(leaving, before=found, parameters=turns)
    assert (after.action, after.turn.tolist()) == ("", [0.0] * 7)
    elsewhere = ball(home().p_WE + [2.0, 0.0, 0.0], np.array([0.1, 0.0, 0.0]))
    assert decide(elsewhere, before=after, parameters=turns) is NOTHING_MOVES


def test_without_a_null_space_or_a_speed_the_tool_is_displaced() -> None:
    found = decide(at_the_elbow())
    assert (found.action, len(found.turn)) == ("evading", 0)
    stiff = home()._replace(free=np.zeros((7, 0)))
    turns, obstacles = EvasionSettings(padding=0.0, turn_speed=1.5), at_the_elbow()
    policy = PolicyState(p_WE=stiff.p_WE)
    ahead = Lookout(stiff, obstacles, NO_TABLE, 0.0, turns)
    same = choose(
        NOTHING_MOVES, np.zeros(3), np.ones(7), policy, None, 0.3, RATE, ahead, obstacles, turns
    )
    assert (same.action, len(same.turn)) == ("evading", 0)
    np.testing.assert_array_equal(same.velocity, found.velocity)


def test_an_arm_that_can_go_no_way_is_held_or_caught() -> None:
    # Beyond all of its limits, so that not even standing still is allowed.
    stuck = home()._replace(lower=home().q + 1.0, speed=np.zeros(7))
    for center, action in ((0.12, "caught"), (0.25, "waiting")):
        obstacles = ball(stuck.p_WE + [center, 0.0, 0.0], np.array([-0.1, 0.0, 0.0]), 0.05)
        ahead = Lookout(stuck, obstacles, NO_TABLE, 0.0, PARAMETERS)
        policy = PolicyState(p_WE=stuck.p_WE)
        found = choose(
            NOTHING_MOVES,
            np.array([0.1, 0.0, 0.0]),
            np.zeros(7),
            policy,
            None,
            0.3,
            RATE,
            ahead,
            obstacles,
            PARAMETERS,
        )
        assert (found.action, found.velocity.tolist()) == (action, [0.0] * 3)
        assert math.isfinite(found.clearance)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 100_000))
def test_it_is_never_worse_than_standing_still(seed: int) -> None:
    rng = np.random.default_rng(seed)
    toward = rng.normal(size=3)
    toward /= np.linalg.norm(toward)
    speed = rng.uniform(0.05, 1.0)
    center = home().p_WE + rng.uniform(0.1, 0.8) * speed * toward + rng.normal(0.0, 0.05, 3)
    obstacles = ball(center, -speed * toward, rng.uniform(0.02, 0.08))
    found = decide(obstacles)
    look = lookout(obstacles)
    still = look.look(np.zeros((1, PARAMETERS.instants, 3))).clearance[0]
    shift = displaced(np.zeros(3), found.velocity[None], PARAMETERS.times, PARAMETERS.acceleration)
    ways = np.concatenate([shift, shortened(shift, 0.2), shortened(shift, 0.08)])
    chosen = look.look(ways).clearance.max()
    assert chosen >= min(still, PARAMETERS.margin) - 1e-9
    assert np.linalg.norm(found.velocity) <= PARAMETERS.speed + 1e-9
    # And the same each time.
    np.testing.assert_array_equal(decide(obstacles).velocity, found.velocity)
