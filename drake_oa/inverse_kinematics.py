"""Joint positions that put the tool where it is asked for."""

from __future__ import annotations

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.inverse_kinematics import InverseKinematics
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, JacobianWrtVariable
from pydrake.solvers import Solve
from pydrake.systems.framework import Context

from drake_oa.cartesian_kernels import rotation_vector
from drake_oa.values import FloatArray
from drake_oa.workspace import tool_down_radii

PANDA_REACH = 0.855
"""Distance from the Panda's shoulder that its data sheet states [m]."""

_SEEDS = 8
_NEWTON_STEPS = 10
_DISTANCE_WEIGHT = 1e4
_POSITION_BOUND = 1e-4
"""Half width of the solver's position constraint [m], narrowed by the Newton steps."""
_ORIENTATION_BOUND = 0.01
"""Width of the solver's orientation constraint [rad], narrowed by the Newton steps."""


def solve_tool_pose(
    plant: MultibodyPlant,
    tool_frame: str,
    X_WE: RigidTransform,
    q_seed: FloatArray,
    *,
    position_tolerance: float = 1e-6,
    orientation_tolerance: float = 1e-6,
) -> FloatArray:
    """Positions, within the joint limits, that put the tool frame E at a pose.

    Drake's `InverseKinematics` finds the solution nearest to the seed; Newton steps
    then bring it onto the pose. The same arguments give the same answer. Joints that
    do not move the tool keep their seed.

    Args:
        plant: finalized plant of the robot alone.
        tool_frame: name of the frame E.
        X_WE: asked pose.
        q_seed: (n,) positions to start from and to stay near [rad].
        position_tolerance: largest distance from the asked position [m].
        orientation_tolerance: largest angle from the asked orientation [rad].

    Returns:
        (n,) positions.

    Raises:
        ValueError: "out of reach: ..." when there is none, with how near the tool
            comes; or when the seed or the frame does not fit the plant.
    """
    q_seed = np.array(q_seed, dtype=float)
    n = plant.num_positions()
    if q_seed.shape != (n,) or not np.isfinite(q_seed).all():
        raise ValueError(f"q_seed is {q_seed}; it must hold {n} finite numbers for this plant")
    if not plant.HasFrameNamed(tool_frame):
        raise ValueError(f"tool_frame: the plant has no frame '{tool_frame}'")
    p_WE = X_WE.translation()
    if not np.isfinite(p_WE).all():
        raise ValueError(f"X_WE: the position {p_WE} must be finite [m]")
    frame = plant.GetFrameByName(tool_frame)
    for seed in _seeds(plant, q_seed):
        q = _nearest_solution(plant, frame, X_WE, seed, q_seed)
        if q is None:
            continue
        q, error_p, error_R = _refine(plant, frame, X_WE, q)
        if error_p <= position_tolerance and error_R <= orientation_tolerance:
            return q
    raise ValueError(_out_of_reach(plant, frame, X_WE, q_seed))


def check_reachable(
    plant: MultibodyPlant, tool_frame: str, X_WE: RigidTransform, q_seed: FloatArray
) -> None:
    """Raises the ValueError of `solve_tool_pose` if a pose is out of reach."""
    solve_tool_pose(plant, tool_frame, X_WE, q_seed)


def _seeds(plant: MultibodyPlant, q_seed: FloatArray) -> list[FloatArray]:
    """The given seed, the middle of the joint ranges, and fixed random places."""
    lower, upper = plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits()
    bounded = np.isfinite(lower) & np.isfinite(upper)
    lower, upper = np.where(bounded, lower, q_seed), np.where(bounded, upper, q_seed)
    random = np.random.default_rng(0)
    spread = [random.uniform(lower, upper) for _ in range(_SEEDS)]
    return [q_seed, 0.5 * (lower + upper), *spread]


def _program(
    plant: MultibodyPlant, frame: Frame, X_WE: RigidTransform, q_seed: FloatArray
) -> InverseKinematics:
    """Joint limits, the asked orientation, and as near to the seed as can be."""
    problem = InverseKinematics(plant, with_joint_limits=True)
    problem.AddOrientationConstraint(
        plant.world_frame(), X_WE.rotation(), frame, RotationMatrix(), _ORIENTATION_BOUND
    )
    # It also keeps the joints that do not move the tool where they were.
    weight = np.eye(plant.num_positions())
    problem.prog().AddQuadraticErrorCost(weight, q_seed, problem.q())
    return problem


def _nearest_solution(
    plant: MultibodyPlant,
    frame: Frame,
    X_WE: RigidTransform,
    guess: FloatArray,
    q_seed: FloatArray,
) -> FloatArray | None:
    """The solver's answer from one initial guess, or None."""
    problem = _program(plant, frame, X_WE, q_seed)
    p_WE = X_WE.translation()
    problem.AddPositionConstraint(
        frame, np.zeros(3), plant.world_frame(), p_WE - _POSITION_BOUND, p_WE + _POSITION_BOUND
    )
    result = Solve(problem.prog(), guess)
    return np.array(result.GetSolution(problem.q())) if result.is_success() else None


def _pose_error(
    plant: MultibodyPlant, context: Context, frame: Frame, X_WE: RigidTransform, q: FloatArray
) -> FloatArray:
    """(6,) rotation vector [rad] and translation [m] from the pose at q to the asked one."""
    plant.SetPositions(context, q)
    X_WF = frame.CalcPoseInWorld(context)
    R_error = X_WE.rotation().matrix() @ X_WF.rotation().matrix().T
    return np.concatenate(
        [rotation_vector(np.ascontiguousarray(R_error)), X_WE.translation() - X_WF.translation()]
    )


def _refine(
    plant: MultibodyPlant, frame: Frame, X_WE: RigidTransform, q: FloatArray
) -> tuple[FloatArray, float, float]:
    """Newton steps onto the pose within the limits; positions, distance, angle left."""
    context = plant.CreateDefaultContext()
    world = plant.world_frame()
    lower, upper = plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits()
    q = np.clip(q, lower, upper)
    error = _pose_error(plant, context, frame, X_WE, q)
    for _ in range(_NEWTON_STEPS):
        J = plant.CalcJacobianSpatialVelocity(
            context, JacobianWrtVariable.kQDot, frame, np.zeros(3), world, world
        )
        step = np.linalg.lstsq(J, error, rcond=1e-6)[0]
        trial = np.clip(q + step, lower, upper)
        left = _pose_error(plant, context, frame, X_WE, trial)
        if not np.linalg.norm(left) < np.linalg.norm(error):
            break
        q, error = trial, left
    return q, float(np.linalg.norm(error[3:])), float(np.linalg.norm(error[:3]))


def _out_of_reach(
    plant: MultibodyPlant, frame: Frame, X_WE: RigidTransform, q_seed: FloatArray
) -> str:
    """What to tell about a pose that has no solution: how near the tool comes."""
    problem = _program(plant, frame, X_WE, q_seed)
    problem.AddPositionCost(
        plant.world_frame(), X_WE.translation(), frame, np.zeros(3), _DISTANCE_WEIGHT * np.eye(3)
    )
    context = plant.CreateDefaultContext()
    nearest, p_WF = np.inf, np.zeros(3)
    for seed in _seeds(plant, q_seed):
        result = Solve(problem.prog(), seed)
        if result.is_success():
            q = result.GetSolution(problem.q())
            distance = float(np.linalg.norm(_pose_error(plant, context, frame, X_WE, q)[3:]))
            if distance < nearest:
                nearest, p_WF = distance, frame.CalcPoseInWorld(context).translation()
    p_WE = X_WE.translation()
    rpy = X_WE.rotation().ToRollPitchYaw().vector()
    comes = (
        "no configuration with this orientation was found"
        if nearest == np.inf
        else f"with this orientation it comes as near as {nearest:.3f} m, "
        f"to {(np.round(p_WF, 3) + 0.0).tolist()}"
    )
    return (
        f"out of reach: {frame.name()} cannot be at {np.round(p_WE, 4).tolist()} m in the world, "
        f"roll, pitch, yaw {np.round(rpy, 3).tolist()} rad; {comes}"
        f"{_panda_reach(plant, frame, p_WE[2])}"
    )


def _panda_reach(plant: MultibodyPlant, frame: Frame, height: float) -> str:
    """What is known of the reach, for the robot that it is known of."""
    if plant.GetModelInstanceName(frame.model_instance()) != "panda":
        return ""
    inner, outer = tool_down_radii(np.asarray(height))
    return (
        f". The Panda reaches {PANDA_REACH} m from its shoulder; with the tool down, "
        f"{inner:.2f} to {outer:.2f} m from its base axis at a height of "
        f"{np.clip(height, -0.2, 0.8):.2f} m"
    )
