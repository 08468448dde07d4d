"""Tests of the motion guard alone: following, evasion, return, and contact reaction."""

from dataclasses import replace
from functools import partial

import numpy as np
import pydrake.geometry as drake
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydrake.math import RotationMatrix
from pydrake.systems.analysis import Simulator

from drake_oa.common.messages import PlannedMotion, PolicyState
from drake_oa.geometry.collision_scene import (
    CollisionGeometry,
    CollisionScene,
    geometries_of,
    geometry_of,
)
from drake_oa.perception.depth_perception import FreeSpace
from drake_oa.planning.collision_model import group_distances
from drake_oa.policy.config import Policy
from drake_oa.robot.arm import tool_poses
from drake_oa.robot.spheres import sphere_centers
from drake_oa.safety.config import GuardParameters
from drake_oa.safety.maneuvers import achievable_distance
from drake_oa.safety.motion_guard import MotionGuard
from tests.builders import fix, read
from tests.planning.arms import ArmAlone

STEP, FRAME, RADIUS = 0.008, 0.04, 0.05
LIMIT = GuardParameters().acceleration_limit


class Bench:
    """`MotionGuard` at rest on its path, with a robot that follows its command exactly."""

    def __init__(self, panda: ArmAlone, turn_limit: float | None = None, **fields: float) -> None:
        self.arm, self.q, self.size = panda, np.array(panda.q), len(panda.q_full)
        self.index = panda.chain.q_index
        self.X_WE = panda.X_WE
        self.p_WE = p_WE = self.X_WE[9:]
        self.system = MotionGuard(
            panda.robot, panda.chain, panda.arm_spheres, 5.0, self.q,
            config=Policy(alpha_k=0.5, period=STEP), parameters=GuardParameters(**fields),
            period=FRAME, turn_limit=turn_limit,
        )  # fmt: skip
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.x = np.zeros(2 * self.size)
        self.x[self.index] = self.q
        quaternion = RotationMatrix(self.X_WE[:9].reshape(3, 3)).ToQuaternion().wxyz()
        policy = PolicyState(p_WE=p_WE, p_WS=p_WE, p_WG=p_WE, speed=0.0, phase=0.2)
        motion = PlannedMotion(np.array([3.0, 4.0]), np.tile(p_WE, (2, 1)), np.tile(self.q, (2, 1)))
        self.fix = partial(fix, self.system, self.context)
        self.fix(robot_state=self.x, policy_state=policy, motion=motion)
        self.fix(desired_position=p_WE, desired_velocity=np.zeros(3))
        self.fix(desired_orientation=quaternion, desired_angular_velocity=np.zeros(3))
        self.fix(desired_posture=np.append(self.q, np.zeros(7)))
        self.fix(collision_scene_W=CollisionScene.of(0.0, []))

    def run(self, duration: float, *balls: CollisionGeometry) -> dict[str, np.ndarray]:
        """Simulates with balls at their poses at the start, and returns recorded outputs."""
        found: dict[str, list] = {"x": [], "scale": [], "action": []}
        begin = self.context.get_time()
        geometries = [replace(ball, stamp=begin) for ball in balls]
        for k in range(round(duration / STEP)):
            self.fix(collision_scene_W=CollisionScene.of(begin + k * STEP, geometries))
            self.simulator.AdvanceTo(begin + (k + 1) * STEP)
            x = self.read("desired_joint_state")
            self.x[self.index], self.x[self.size + self.index] = np.split(x, 2)
            self.fix(robot_state=self.x)
            self.p_WE = self.p_WE + STEP * self.read("evasion_velocity")
            self.fix(desired_position=self.p_WE)
            found["x"].append(x)
            found["scale"].append(self.read("speed_scale")[0])
            found["action"].append(self.read("guard_action")[0])
        return {name: np.array(values) for name, values in found.items()}

    def read(self, name: str) -> np.ndarray:
        return read(self.system, self.context, name)

    def arriving(self, after: float, *v_WO: float) -> CollisionGeometry:
        """Returns a ball that reaches the hand after a time [s] with a velocity [m/s]."""
        X_WO = np.eye(4)
        X_WO[:3, 3] = self.X_WE[9:] + [0.0, 0.0, 0.05] - after * np.array(v_WO)
        return replace(
            geometry_of(drake.Sphere(RADIUS)), X_WO=X_WO, v_WO=np.array(v_WO), label="ball"
        )

    def gap(self, x: np.ndarray, ball: CollisionGeometry) -> float:
        """Computes the minimum distance of moving links to a ball along x (T, 2n) [m]."""
        spheres, q = self.arm.arm_spheres.arrays, np.ascontiguousarray(x[:, :7])
        at = partial(group_distances, self.arm.chain, spheres, geometries_of([ball]))
        apart = [at(q[k : k + 1], STEP * (k + 1), np.inf) for k in range(len(q))]
        return np.min(apart, axis=0)[spheres.group_joint >= 0].min()


@pytest.mark.parametrize("v_WO", [(-0.5, 0.0, 0.0), (0.0, -0.5, 0.0)])
def test_the_arm_evades_a_ball_and_returns(panda: ArmAlone, v_WO: tuple[float, ...]) -> None:
    bench = Bench(panda)
    before, rest = bench.run(0.2), np.append(bench.q, np.zeros(7))
    np.testing.assert_allclose(before["x"][-1], rest, atol=1e-6)
    assert before["action"].max() == 0.0
    ball = bench.arriving(1.2, *v_WO)
    found = bench.run(3.0, ball)
    assert bench.gap(found["x"], ball) > 0.0
    # Without a maneuver the ball would hit the hand.
    assert bench.gap(np.tile(rest, (len(found["x"]), 1)), ball) < -0.03
    assert found["action"].max() >= 3.0
    assert found["scale"].min() == 0.0
    assert np.abs(np.diff(found["x"][:, 7:], axis=0)).max() <= LIMIT * STEP + 1e-9
    assert (np.abs(found["x"][:, 7:]) <= panda.chain.speed + 1e-9).all()
    after = bench.run(2.0)
    np.testing.assert_allclose(after["x"][-1, :7], bench.q, atol=2e-3)
    assert (after["action"][-1], after["scale"][-1]) == (0.0, 1.0)


def test_the_arm_returns_through_unobserved_space(panda: ArmAlone) -> None:
    bench = Bench(panda, obstacle_speed=0.8, seed=3)
    bench.fix(free_space_W=FreeSpace((None,), 0.0))
    found = bench.run(1.8, bench.arriving(1.2, 0.0, -0.5, 0.0))
    assert np.abs(found["x"][:, :7] - bench.q).max() > 0.2
    np.testing.assert_allclose(bench.run(2.0)["x"][-1, :7], bench.q, atol=2e-3)


def test_the_motion_through_unobserved_space_is_as_fast_as_claim_b_allows(panda: ArmAlone) -> None:
    bench, v_unseen = Bench(panda, obstacle_speed=0.8), GuardParameters().v_unseen
    bench.fix(free_space_W=FreeSpace((None,), 0.0))
    # The base turns by 0.8 rad/s at full speed.
    q = bench.q + np.outer([0.0, 4.0], np.eye(7)[0])
    motion = PlannedMotion(np.array([0.0, 1.0]), np.zeros((2, 3)), q)
    bench.fix(motion=motion, policy_state=PolicyState(speed=0.08, phase=1.0))
    scale = bench.run(0.1)["scale"][-1]
    centers = sphere_centers(panda.chain, panda.arm_spheres.arrays, bench.q[None])[0]
    speed = 0.8 * scale * np.hypot(*centers[:, :2].T).max()
    assert 0.8 * v_unseen < speed <= v_unseen


def test_the_arm_does_not_approach_an_obstacle_that_pauses(panda: ArmAlone) -> None:
    bench = Bench(panda, obstacle_speed=0.8)
    bench.run(1.2, bench.arriving(1.2, -0.5, 0.0, 0.0))
    # The ball pauses 0.15 m from the previous position of the hand.
    paused = replace(bench.arriving(0.3, -0.5, 0.0, 0.0), v_WO=np.zeros(3))
    deviation = np.abs(bench.run(5.0, paused)["x"][:, :7] - bench.q).max(axis=1)
    assert deviation[: round(1.9 / STEP)].min() > 0.05
    assert deviation[-1] < 2e-3


def test_the_desired_position_moves_to_an_arm_that_cannot_return(panda: ArmAlone) -> None:
    bench = Bench(panda, seed=1)
    bench.run(0.2)
    bench.run(1.2, bench.arriving(1.2, -0.5, 0.0, 0.0))
    # The ball rests at the previous position of the hand.
    ball = bench.arriving(0.0, 0.0, 0.0, 0.0)
    found = bench.run(5.0, ball)
    X_WE = tool_poses(panda.chain, found["x"][-1:, :7].copy())[0]
    assert np.linalg.norm(X_WE[9:] - bench.X_WE[9:]) > 0.03
    np.testing.assert_allclose(bench.p_WE, X_WE[9:], atol=1e-3)
    np.testing.assert_array_equal(bench.read("evasion_velocity"), 0.0)
    # A new motion begins at the tool; the null space of the arm is not at the nominal posture.
    quaternion = RotationMatrix(X_WE[:9].reshape(3, 3)).ToQuaternion().wxyz()
    bench.fix(desired_orientation=quaternion, motion=PlannedMotion())
    assert bench.run(1.0, ball)["action"].max() == 0.0


@pytest.mark.parametrize("limit", [0.1, None])
def test_maneuvers_satisfy_the_turn_limit_of_the_tool(panda: ArmAlone, limit: float | None) -> None:
    bench = Bench(panda, limit)
    bench.run(0.2)
    found = bench.run(3.0, bench.arriving(1.6, -0.3, 0.0, 0.0))
    assert found["action"].max() >= 3.0
    R_WE = tool_poses(panda.chain, np.ascontiguousarray(found["x"][:, :7]))[:, :9]
    turn = np.arccos(np.clip(0.5 * (R_WE @ bench.X_WE[:9] - 1.0), -1.0, 1.0))
    assert (turn.max() <= 0.12) == (limit is not None)


def test_the_command_restarts_at_a_pushed_arm(panda: ArmAlone) -> None:
    bench = Bench(panda)
    bench.run(0.2)
    bench.x[bench.index[3]] += 0.1
    bench.fix(robot_state=bench.x)
    found = bench.run(0.48)
    assert found["x"][0][3] == pytest.approx(bench.q[3] + 0.1, abs=1e-3)
    # The speed is limited after the contact.
    point_speed = np.abs(found["x"][:, 7:]) @ panda.chain.reach
    assert point_speed.max() <= GuardParameters().v_unseen + 1e-6


@pytest.mark.parametrize("name", ["robot_state", "stopping"])
def test_an_input_that_is_not_finite_is_a_fault(panda: ArmAlone, name: str) -> None:
    bench = Bench(panda)
    bench.run(0.2)
    bench.fix(**{name: np.full(2 * bench.size, np.nan) if name == "robot_state" else np.ones(1)})
    bench.simulator.AdvanceTo(bench.context.get_time() + 2 * STEP)
    supervision = bench.system.GetOutputPort("supervision").Eval(bench.context)
    source = "the robot state" if name == "robot_state" else "an input of the controller"
    assert (supervision.action, supervision.reason) == ("stop", f"{source} is not finite")
    assert bench.read("speed_scale")[0] == 0.0


@given(st.floats(1e-3, 0.02), st.floats(-0.02, 0.04))
def test_no_sequence_of_maneuvers_halves_a_required_distance(required: float, start: float) -> None:
    distance = start
    for _ in range(100):
        least = float(achievable_distance(required, np.array(distance)))
        assert least < distance
        assert least <= required
        distance = least
    assert distance > min(start, 0.5 * required) - 1.1e-4
