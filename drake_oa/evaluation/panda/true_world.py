"""Ground-truth model of a run, with the arm and all collision geometry along its true trajectories.

The model contains the collision geometry of everything but the robot. Spheres that enclose its
links represent the arm (`drake_oa.robot.spheres`); they protrude from the links by up to 3 mm, at
the hand by 5 mm. A motion that is collision-free by this model is therefore collision-free. A
motion that collides by this model may in truth miss an object by up to 5 mm. Fixed links are left
out.

Trajectories are sampled every 8 ms (`STEP`): at 1 m/s an obstacle is up to 4 mm away from its
position at the nearest sample.

Modules that evaluate runs on this model do not import `drake_oa.safety`, so that the evaluation is
independent of the motion guard.
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
"""Time between two samples of the true trajectories, and between two configurations of a motion
that is checked for collisions [s]. It is a multiple of the log's period."""
_MAX_MARGIN = 1e-3
"""Upper bound of computed clearance margins (distance minus required clearance), of which only the
sign is used [m]."""
_DEFAULT_ACCELERATION = 10.0
"""Acceleration limit of a joint for which the robot's model has no limit [rad/s^2]."""


class TrueWorld(NamedTuple):
    """Ground-truth model of a run: an arm of n joints, and K collision geometries at T samples
    8 ms (`STEP`) apart.

    The collision geometries are at rest after the last sample.

    Attributes:
        arm: the arm, its required clearances, and the collision geometries at the last sample.
        ball: (T, K, 8) bounding sphere of each geometry at each sample: center in the world and
            radius [m], then velocity and time of the pose, which are 0 here.
        X_WO: (T, K, 3, 4) upper three rows of the pose of each geometry at each sample.
        acceleration: (n,) acceleration limits of the joints [rad/s^2].
    """

    arm: ArmCollisionModel
    ball: FloatArray
    X_WO: FloatArray
    acceleration: FloatArray


def make_true_world(scenario: Scenario, clearance: float = 0.0) -> TrueWorld:
    """Makes the ground-truth model of a scenario, with the arm and all true obstacle trajectories.

    Args:
        scenario: scenario with a robot.
        clearance: minimum clearance of all moving links to all objects, and between links [m].

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
    acceleration = plant.GetAccelerationUpperLimits()[chain.q_index]
    return TrueWorld(
        ArmCollisionModel(chain, spheres, samples[-1], required, 0.0),
        np.array([sample.ball for sample in samples]),
        np.array([sample.X_WO for sample in samples]),
        np.nan_to_num(acceleration, posinf=_DEFAULT_ACCELERATION),
    )


def bang_motions(
    world: TrueWorld, q: FloatArray, v: FloatArray, legs: FloatArray, switch: IntArray, steps: int
) -> FloatArray:
    """Computes joint motions of two legs, each of which is time-optimal for each joint separately.

    In each step of duration `STEP` (8 ms) the acceleration is constant. Let v be the velocity of a
    joint before the step, v' that after the step, a the acceleration limit and v_max the speed
    limit. v' is the largest velocity from which the joint can still stop at the target:

        v' = sign(e) min(v_max, sqrt(h^2 + 2 a |e|) - h),   |v' - v| <= a STEP.

    Here h is a STEP / 2, and e is the signed distance to the target minus v STEP / 2.

    Args:
        world: the arm with its speed and acceleration limits.
        q: (n,) or (N, n) initial positions [rad].
        v: (n,) or (N, n) initial velocities [rad/s].
        legs: (N, 2, n) target positions of both legs [rad].
        switch: (N,) step at which the second leg begins.
        steps: number of steps M.

    Returns:
        (N, M + 1, n) positions at the steps [rad].
    """
    motions = np.empty((len(legs), steps + 1, legs.shape[2]))
    half = 0.5 * STEP * world.acceleration
    for k in range(steps + 1):
        motions[:, k] = q
        target = np.where((k < switch)[:, None], legs[:, 0], legs[:, 1])
        error = target - q - 0.5 * STEP * v
        braking = np.sqrt(half**2 + 2.0 * world.acceleration * np.abs(error)) - half
        desired = np.sign(error) * np.minimum(world.arm.chain.speed, braking)
        change = np.clip(desired - v, -2.0 * half, 2.0 * half)
        q, v = q + (v + 0.5 * change) * STEP, v + change
    return motions


@compiled
def clear_steps(world: TrueWorld, motions: FloatArray, first: IntArray) -> IntArray:
    """Counts the configurations of joint motions before the first collision or violated joint
    limit.

    Args:
        world: the arm, its required clearances, and the collision geometries.
        motions: (N, M, n) joint positions of N motions, a row every 8 ms (`STEP`) [rad].
        first: (N,) index of the sample of `world` at which each motion begins; after the last
            sample everything is at rest.

    Returns:
        (N,) number of configurations before the first one that is outside the joint limits or has
        less than a required clearance; M if there is none.
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
            if not is_within or clearance_margin(now, q, _MAX_MARGIN, X, center) < 0.0:
                counts[i] = k
                break
    return counts
