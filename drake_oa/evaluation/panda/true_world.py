"""The true world of a finished run: the arm among all solids on their true courses.

The solids are the collision geometry of all that is not the robot; the arm is the spheres that
enclose its links (`drake_oa.robot.spheres`; they stick out by 3 mm, at the hand by 5 mm). A motion
that is clear here is therefore clear, and one that is not may yet miss a solid by 5 mm. Links that
no joint moves are left out. Courses are sampled every `STEP`: at 1 m/s an obstacle is up to 4 mm
away from where it is at a time between two samples.

Nothing here, nor in the modules that judge by it, imports `drake_oa.safety`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray, IntArray
from drake_oa.diagrams.station import covered_arm
from drake_oa.geometry.collision_scene import CollisionGeometries
from drake_oa.planning.collision_model import (
    ArmCollisionModel,
    ClearanceRequirements,
    clearance_margin,
)
from drake_oa.robot.arm import make_chain
from drake_oa.robot.plant import make_robot_plant
from drake_oa.runs.metrics import clearance_evaluator
from drake_oa.scenario.end_poses import start_positions
from drake_oa.scenario.obstacles import last_change
from drake_oa.scenario.scenario import Scenario, robot_of

STEP = 0.008
"""Time between two checked configurations, a multiple of the period of logs [s]."""
_NEAR = 1e-3
"""Excess up to which the clearance of a configuration is computed [m]."""
_ACCELERATION = 10.0
"""Acceleration limit of a joint for which the robot's model has none [rad/s^2]."""


class TrueWorld(NamedTuple):
    """Arm of n joints among K solids, of which T samples are known, the last one at rest.

    Attributes:
        arm: the arm, its clearance, and the solids at the last sample.
        ball: (T, K, 8) `CollisionGeometries.ball` at each.
        X_WO: (T, K, 3, 4) `CollisionGeometries.X_WO` at each.
        acceleration: (n,) acceleration limits of the joints [rad/s^2].
    """

    arm: ArmCollisionModel
    ball: FloatArray
    X_WO: FloatArray
    acceleration: FloatArray


def make_true_world(scenario: Scenario, clearance: float = 0.0) -> TrueWorld:
    """Makes the true world of a scenario.

    Args:
        scenario: with a robot.
        clearance: minimum distance of all moving links to all solids, and of the links to each
            other, below which a configuration is not clear [m].

    Raises:
        ScenarioError: if the robot cannot be covered with spheres.
    """
    robot_plant, evaluator = make_robot_plant(robot_of(scenario)), clearance_evaluator(scenario)
    plant, spheres = robot_plant.plant, covered_arm(robot_of(scenario)).arrays
    chain = make_chain(plant, robot_plant.tool_frame, start_positions(scenario), spheres)
    count = math.ceil(last_change(scenario.obstacles) / STEP) + 1
    samples = [evaluator.geometries_at(STEP * row) for row in range(count)]
    of_geometries = np.full((len(spheres.group_joint), len(samples[-1].ball)), clearance)
    of_geometries[spheres.group_joint < 0] = -math.inf
    required = ClearanceRequirements(of_geometries, clearance, spheres.of_tool[spheres.first[:-1]])
    return TrueWorld(
        ArmCollisionModel(chain, spheres, samples[-1], required, 0.0),
        np.array([sample.ball for sample in samples]),
        np.array([sample.X_WO for sample in samples]),
        np.nan_to_num(plant.GetAccelerationUpperLimits()[chain.q_index], posinf=_ACCELERATION),
    )


def bang_motions(
    world: TrueWorld, q: FloatArray, v: FloatArray, legs: FloatArray, switch: IntArray, steps: int
) -> FloatArray:
    """Computes joint motions of two legs, each time-optimal for every joint on its own.

    In each step of `STEP` the acceleration is constant. The velocity after the step is the
    greatest from which the joint, braking at its limit a, still stops at the target:
    v' = sign(e) min(v_max, sqrt(h^2 + 2 a |e|) - h), h = a STEP / 2, e the way to the target less
    v STEP / 2, and |v' - v| <= a STEP.

    Args:
        world: the arm and its limits.
        q: (n,) or (N, n) positions at first [rad].
        v: (n,) or (N, n) velocities at first [rad/s].
        legs: (N, 2, n) targets of both legs [rad].
        switch: (N,) step at which the second leg begins.
        steps: number of steps M.

    Returns:
        (N, M + 1, n) positions [rad].
    """
    motions = np.empty((len(legs), steps + 1, legs.shape[2]))
    half = 0.5 * STEP * world.acceleration
    for k in range(steps + 1):
        motions[:, k] = q
        target = np.where((k < switch)[:, None], legs[:, 0], legs[:, 1])
        error = target - q - 0.5 * STEP * v
        braking = np.sqrt(half**2 + 2.0 * world.acceleration * np.abs(error)) - half
        wanted = np.sign(error) * np.minimum(world.arm.chain.speed, braking)
        change = np.clip(wanted - v, -2.0 * half, 2.0 * half)
        q, v = q + (v + 0.5 * change) * STEP, v + change
    return motions


@compiled
def clear_steps(world: TrueWorld, motions: FloatArray, first: IntArray) -> IntArray:
    """Counts the leading configurations of motions that are clear and within the joint limits.

    Args:
        world: the arm, its clearance and the solids.
        motions: (N, M, n) positions, a row every `STEP` [rad].
        first: (N,) sample of the courses at which each begins; after the last one all rests.

    Returns:
        (N,) counts, M where all are.
    """
    N, M, n = motions.shape
    arm, fixed, last = world.arm, world.arm.geometries, len(world.ball) - 1
    X, center = np.empty((n + 2, 12)), np.empty((len(arm.spheres.group_joint), 3))
    counts = np.full(N, M)
    for i in range(N):
        for k in range(M):
            row, q = min(first[i] + k, last), motions[i, k]
            geometries = CollisionGeometries(
                world.ball[row],
                world.X_WO[row],
                fixed.size,
                fixed.layout,
                fixed.faces,
                fixed.voxels,
            )
            now = ArmCollisionModel(arm.chain, arm.spheres, geometries, arm.required, 0.0)
            is_within = np.all(arm.chain.lower <= q) and np.all(q <= arm.chain.upper)
            if not is_within or clearance_margin(now, q, _NEAR, X, center) < 0.0:
                counts[i] = k
                break
    return counts
