"""Baseline: evaluation of a control barrier function filter of the package CBFpy.

    python -m tests.regression.cbf --suite moving_hard --scenes 20 --seed 0 --json cbf.json
    python -m tests.regression.cbf --suite drp --levels floating1 floating2 --seed 0 --json f.json

runs the filter in the scenes of `drake-oa evaluate panda` and evaluates the runs by the same
functions. Each result is stored on completion; the same command resumes. CBFpy is not a dependency
of this project: `pip install cbfpy elastiqp` in a separate virtual environment, and set
JAX_ENABLE_X64=1, XLA_FLAGS=--xla_cpu_multi_thread_eigen=false and OPENBLAS_NUM_THREADS=1.

The nominal joint velocity u_des tracks the nominal tool pose by damped least squares, and the
nominal posture in the null space. The filter solves, every period of the policy,

    min_u |J (u - u_des)|^2 + w |u - u_des|^2    subject to    dh/dt + dh/dq u >= -alpha h

and the joint speed limits, each relaxed by a penalty (D. Morton and M. Pavone, 2025). The state is
the joint positions and the exact positions of the obstacles, which move at their exact velocities.
The barriers h(q, p) are

- for each link and shape of an obstacle: signed distances of the nearest enclosing spheres of the
  link, minus a margin;
- for each link: its height above the table, minus a margin;
- for each pair of links: the distance between their nearest spheres, minus a margin;
- for each joint: the distances to both limits.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from pydrake.common.value import Value
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import BasicVector, BusValue, Context, LeafSystem

from drake_oa.common.files import replace_json
from drake_oa.common.messages import FloatArray
from drake_oa.diagrams.motion import make_dmp
from drake_oa.diagrams.station import covered_arm
from drake_oa.evaluation.panda import differential_ik, evaluation
from drake_oa.evaluation.panda.differential_ik import ANGULAR_LIMIT, GAIN, SPEED_FACTOR
from drake_oa.evaluation.panda.scenes import suite_kinds
from drake_oa.geometry.shapes import Cylinder, Sphere, pose
from drake_oa.policy.dmp import trajectory
from drake_oa.robot.arm import make_chain
from drake_oa.robot.plant import TOOL_FRAME, make_robot_plant
from drake_oa.runs.motion_log import MotionLog
from drake_oa.runs.simulation import AT_GOAL
from drake_oa.scenario.end_poses import start_positions
from drake_oa.scenario.loading import parse_scenario
from drake_oa.scenario.scenario import Scenario, robot_of

try:
    import jax
    import jax.numpy as jnp
    from cbfpy import CBF, CBFConfig
except ModuleNotFoundError as error:
    raise SystemExit(f"{error}; this evaluation requires: pip install cbfpy elastiqp") from None

jax.config.update("jax_enable_x64", True)

METHOD = "ControlBarrierFunction"
"""Name of the method in logs."""
NEAREST = 2
"""Number of barriers for each link and shape."""
_TINY = 1e-12
"""Constant added to squares, so that their roots are differentiable [m^2]."""
_STEP = 1e-3
"""Time step of the finite differences of the obstacles' velocities [s]."""


@dataclass(frozen=True)
class Filter:
    """Parameters of the control barrier function filter.

    Attributes:
        alpha: decay rate of the barriers [1/s].
        obstacle: margin of the links to obstacles [m].
        table: margin of the links to the table [m].
        own: margin of the links to one another [m].
        joint_weight: weight w of joint velocities against the tool's [m^2].
        damping: lambda^2 of the least squares J^T (J J^T + lambda^2 I)^-1 [m^2].
        posture_gain: rate at which the null space tracks the posture [1/s].
        backend: quadratic program solver of CBFpy.
    """

    alpha: float = 2.0
    obstacle: float = 0.01
    table: float = 0.003
    own: float = 0.005
    joint_weight: float = 0.01
    damping: float = 1e-3
    posture_gain: float = 1.0
    backend: str = "elastiqp"


class Shapes:
    """Struct of arrays of the K shapes of a scenario's obstacles.

    A shape is the set of points within a radius of a box |x_i| <= half_i in the shape's frame G;
    the box of a sphere is a point. For a cylinder the first coordinate is the distance from its
    axis.

    Attributes:
        R_WG: (K, 3, 3) orientations.
        p_WG: (K, 3) positions without the obstacles' offsets [m].
        half, radius: (K, 3) and (K,) dimensions [m].
        is_cylinder: (K,) whether each is a cylinder.
        obstacles: (K,) obstacle of each.
    """

    def __init__(self, scenario: Scenario) -> None:
        """Reads the shapes of a scenario's obstacles."""
        items = [(item, shape) for item in scenario.obstacles for shape in item.shapes]
        poses = [pose(item) @ pose(shape) for item, shape in items]
        self.R_WG = np.array([X_WG.rotation().matrix() for X_WG in poses])
        self.p_WG = np.array([X_WG.translation() for X_WG in poses])
        self.is_cylinder = np.array([isinstance(shape, Cylinder) for _, shape in items])
        self.radius = np.array([s.radius if isinstance(s, Sphere) else 0.0 for _, s in items])
        self.half = np.array([_half_size(shape) for _, shape in items])
        self.obstacles = [item for item, _ in items]

    def state(self, time: float) -> tuple[FloatArray, FloatArray]:
        """Computes (K, 3) positions [m] and velocities [m/s] at a time [s]."""
        offsets, velocities = [], []
        for item in self.obstacles:
            trajectory_item = replace(item, present=[])
            step = trajectory_item.offset_at(time + _STEP) - trajectory_item.offset_at(time)
            offsets.append(item.offset_at(time))
            velocities.append(step / _STEP)
        return self.p_WG + offsets, np.array(velocities)

    def distances(self, p_WS: Any, p_WG: Any, rows: Any) -> Any:
        """Computes signed distances of points (..., 3) to shapes at positions (..., 3) [m]."""
        local = jnp.abs(jnp.einsum("...ij,...i->...j", self.R_WG[rows], p_WS - p_WG))
        x, y, z = jnp.moveaxis(local, -1, 0)
        round_ = jnp.stack([jnp.sqrt(x**2 + y**2 + _TINY), jnp.zeros_like(z), z], axis=-1)
        beyond = jnp.where(self.is_cylinder[rows, None], round_, local) - self.half[rows]
        outside = _norm(jnp.maximum(beyond, 0.0))
        return outside + jnp.minimum(beyond.max(axis=-1), 0.0) - self.radius[rows]


def _half_size(shape: Any) -> list[float]:
    """Returns the half edge lengths of a shape's box [m]."""
    if isinstance(shape, Sphere):
        return [0.0, 0.0, 0.0]
    if isinstance(shape, Cylinder):
        return [shape.radius, np.inf, 0.5 * shape.length]
    return [0.5 * edge for edge in shape.size]


def _norm(x: Any) -> Any:
    """Computes a differentiable norm over the last axis."""
    return jnp.sqrt((x**2).sum(axis=-1) + _TINY)


class ArmConfig(CBFConfig):
    """Control problem of an arm among shapes, in the form of CBFpy.

    The state z is the n joint positions [rad] and the K positions of the shapes [m]; the
    additional argument is the (3 K,) velocities of these [m/s].
    """

    def __init__(self, scenario: Scenario, parameters: Filter) -> None:
        """Reads the arm and the shapes of a scenario."""
        robot, self.parameters, self.shapes = robot_of(scenario), parameters, Shapes(scenario)
        plant, self.spheres = make_robot_plant(robot), covered_arm(robot).arrays
        self.chain = make_chain(plant.plant, plant.tool_frame, start_positions(scenario))
        self.groups = [slice(*ends) for ends in pairwise(self.spheres.first.tolist())]
        self.joints, coordinates = len(self.chain.speed), self.shapes.p_WG.size
        super().__init__(
            n=self.joints + coordinates,
            m=self.joints,
            u_min=-self.chain.speed,
            u_max=self.chain.speed,
            backend=parameters.backend,
            solver_tol=1e-6,
            init_args=(np.zeros(coordinates),),
        )

    def f(self, z: Any, v_WG: Any) -> Any:
        """Computes the drift: shapes move at their velocities."""
        return jnp.concatenate([jnp.zeros(self.joints), v_WG])

    def g(self, z: Any, v_WG: Any) -> Any:
        """Computes the input matrix: inputs are the joint velocities."""
        return jnp.eye(len(z), self.joints)

    def alpha(self, h: Any, v_WG: Any) -> Any:
        """Computes the class K function alpha(h) of the barriers."""
        return self.parameters.alpha * h

    def P(self, z: Any, u_des: Any, v_WG: Any) -> Any:
        """Computes the weights of deviations from the nominal joint velocity."""
        J = self.tool(z[: self.joints])[1]
        return 2.0 * (J.T @ J + self.parameters.joint_weight * jnp.eye(self.joints))

    def q(self, z: Any, u_des: Any, v_WG: Any) -> Any:
        """Computes the linear term that belongs to `P`."""
        return -self.P(z, u_des, v_WG) @ u_des

    def poses(self, q: Any) -> Any:
        """Computes the (n + 2, 4, 4) poses of the world, the joints and the tool frame."""
        poses = [jnp.eye(4)]
        for X_PJ, angle in zip(self.chain.X_PJ, [*q, 0.0], strict=True):
            c, s = jnp.cos(angle), jnp.sin(angle)
            turned = jnp.eye(4).at[:2, :2].set(jnp.array([[c, -s], [s, c]]))
            poses.append(poses[-1] @ X_PJ @ turned)
        return jnp.stack(poses)

    def tool(self, q: Any) -> tuple[Any, Any]:
        """Computes the pose of the tool frame and its (6, n) Jacobian, rotation last."""
        X = self.poses(q)
        axes, arms = X[1:-1, :3, 2], X[-1, :3, 3] - X[1:-1, :3, 3]
        return X[-1], jnp.concatenate([jnp.cross(axes, arms), axes], axis=1).T

    def h_1(self, z: Any, v_WG: Any) -> Any:
        """Computes the barriers h, see the module's docstring."""
        q, p_WG = z[: self.joints], z[self.joints :].reshape(-1, 3)
        spheres, margins, rows = self.spheres, self.parameters, np.arange(len(p_WG))
        X, radius = self.poses(q)[spheres.joint + 1], jnp.asarray(spheres.radius)
        p_WS = jnp.einsum("sij,sj->si", X[:, :3, :3], spheres.p_JS) + X[:, :3, 3]
        fixed_S, fixed_G = jax.lax.stop_gradient((p_WS, p_WG))
        apart = self.shapes.distances(fixed_S[:, None], fixed_G, rows) - radius[:, None]
        bounds = [q - self.chain.lower, self.chain.upper - q]
        for group, joint in zip(self.groups, spheres.group_joint, strict=True):
            if joint < 0:
                continue
            near = jax.lax.top_k(-apart[group].T, NEAREST)[1] + group.start
            distance = self.shapes.distances(p_WS[near], p_WG[:, None], rows[:, None])
            bounds.append((distance - radius[near] - margins.obstacle).ravel())
            if joint > 0:
                height = p_WS[group, 2] - radius[group]
                bounds.append(height.min(keepdims=True) - margins.table)
        for (a, b), allowance in zip(spheres.pairs, spheres.allowance, strict=True):
            one, two = self.groups[a], self.groups[b]
            radii = radius[one, None] + radius[two]
            i, j = jnp.divmod(
                (_norm(fixed_S[one, None] - fixed_S[two]) - radii).argmin(), len(radii[0])
            )
            distance = _norm(p_WS[one][i] - p_WS[two][j]) - radii[i, j] + allowance
            bounds.append(distance[None] - margins.own)
        return jnp.concatenate(bounds)


class SafetyFilter(LeafSystem):
    """Filter of the nominal joint velocity toward the desired tool pose.

    .. pydrake_system::

      name: SafetyFilter
      input_ports:
      - position
      - nominal_posture
      - desired_cartesian_poses
      output_ports:
      - commanded_velocity

    The ports are those of Drake's DifferentialInverseKinematicsSystem; see `CommandedJoints`.
    """

    def __init__(self, scenario: Scenario, plant: MultibodyPlant, parameters: Filter) -> None:
        """Declares the ports and prepares the filter for the scenario's obstacles.

        Args:
            scenario: scenario with a robot.
            plant: plant of the world, whose positions are those of the ports.
            parameters: parameters of the filter.
        """
        super().__init__()
        tool_frame, self._plant = plant.GetFrameByName(TOOL_FRAME), plant
        self._robot, self._tool = tool_frame.model_instance(), tool_frame.scoped_name().get_full()
        self._config = ArmConfig(scenario, parameters)
        self._filter, self._gain = CBF.from_config(self._config), GAIN / scenario.policy.period
        dmp = make_dmp(scenario)
        planned = trajectory(dmp, scenario.task.start, scenario.task.goal)
        speed = SPEED_FACTOR * float(np.linalg.norm(planned.z, axis=1).max()) / dmp.duration
        self._limits, self._filtered = np.repeat([speed, ANGULAR_LIMIT], 3), jax.jit(self._solve)
        self._inputs = [
            self.DeclareVectorInputPort("position", plant.num_positions()),
            self.DeclareVectorInputPort("nominal_posture", plant.num_positions()),
            self.DeclareAbstractInputPort("desired_cartesian_poses", Value(BusValue())),
        ]
        size = plant.num_positions(self._robot)
        self.DeclareVectorOutputPort("commanded_velocity", size, self._calc)

    def _solve(self, q: Any, posture: Any, X_WD: Any, p_WG: Any, v_WG: Any) -> Any:
        """Computes the filtered joint velocity (n,) toward a tool pose X_WD [rad/s]."""
        parameters = self._config.parameters
        X_WE, J = self._config.tool(q)
        turn = 0.5 * jnp.cross(X_WE[:3, :3], X_WD[:3, :3], axis=0).sum(axis=1)
        error = jnp.concatenate([X_WD[:3, 3] - X_WE[:3, 3], turn])
        velocity = jnp.clip(self._gain * error, -self._limits, self._limits)
        inverse = J.T @ jnp.linalg.inv(J @ J.T + parameters.damping * jnp.eye(6))
        to_posture = parameters.posture_gain * (posture - q)
        u = to_posture + inverse @ (velocity - J @ to_posture)
        u = u / jnp.maximum(1.0, jnp.abs(u / self._config.chain.speed).max())
        z = jnp.concatenate([q, p_WG.ravel()])
        return self._filter.safety_filter(z, u, v_WG.ravel())

    def _calc(self, context: Context, output: BasicVector) -> None:
        *positions, poses = (port.Eval(context) for port in self._inputs)
        index = self._config.chain.q_index
        q = (self._plant.GetPositionsFromArray(self._robot, x)[index] for x in positions)
        X_WD, now = poses.Find(self._tool).GetAsMatrix4(), context.get_time()
        u = np.zeros(output.size())
        u[index] = self._filtered(*q, X_WD, *self._config.shapes.state(now))
        output.SetFromVector(u)


def simulate_filter(scenario: Scenario, parameters: Filter) -> MotionLog:
    """Simulates a motion as `simulate_differential_ik`, with the filter in place of IK."""

    def make_filter(scenario: Scenario, checker: Any, *_: object) -> SafetyFilter:
        return SafetyFilter(scenario, checker.plant(), parameters)

    with patch.object(differential_ik, "make_differential_ik", make_filter):
        return replace(differential_ik.simulate_differential_ik(scenario), inference=METHOD)


def run_scene(draw: Callable[[], str], criteria: Any, parameters: Filter) -> dict[str, Any]:
    """Draws a scene, runs the filter in it and evaluates the run.

    The result has the keys of `run_and_evaluate` and `at_rest_error`, the distance of the tool from
    the goal at the end of the run [m]. `goal_error` is the maximum of `at_rest_error` and of the
    distance at the end of the motion, which may exceed the tolerance while the tool approaches.
    """

    logs: list[MotionLog] = []

    def simulate_scene(scenario: Scenario, *_: object) -> MotionLog:
        logs.append(simulate_filter(scenario, parameters))
        return logs[0]

    scenario = parse_scenario(draw())
    with patch.object(evaluation, "_simulate", simulate_scene):
        result = evaluation.run_and_evaluate(scenario, "nominal", "truth", criteria=criteria)
    error = None
    for log in logs:
        (p_WE,) = make_robot_plant(robot_of(scenario)).tool_path(log.q[-1:])
        error = math.dist(p_WE, scenario.task.goal)
    return {**result, "at_rest_error": error}


def run_suite(
    suite: evaluation.PandaSuite, parameters: Filter, file: Path | None
) -> list[dict[str, Any]]:
    """Runs the filter on a suite, storing each result in the file, and returns the results.

    Raises:
        ValueError: if the file has results of other parameters.
    """
    content = {"parameters": asdict(parameters), "seed": suite.seed, "runs": {}}
    if file is not None and file.exists():
        stored = json.loads(file.read_text())
        if any(stored[name] != content[name] for name in ("parameters", "seed")):
            raise ValueError(f"--json {file}: has results of other parameters; name another file")
        content = stored
    runs = content["runs"].setdefault(suite.kind, {})
    for scene, draw in suite.drawings.items():
        if str(scene) not in runs:
            runs[str(scene)] = run_scene(draw, suite.criteria, parameters)
            replace_json(file, content)
        result = runs[str(scene)]
        touched = ", ".join([*result["contacts"], *result["self_contacts"]])
        reason = touched or result["stop_reason"] or "arrived"
        print(f"{suite.scene_name(scene)}: {result['outcome']} ({reason})", flush=True)
    return [runs[str(scene)] for scene in suite.drawings]


def _row(kind: str, results: Sequence[dict[str, Any]]) -> str:
    """Returns a table's row with the numbers of outcomes of a kind of scenes."""
    names = ("contact", "success", "stopped")
    counts = [sum(result["outcome"] == name for result in results) for name in names]
    resting = [row for row in results if row["outcome"] != "contact" and row["settled"]]
    counts.append(sum(row["at_rest_error"] <= AT_GOAL for row in resting))
    counts += [sum(row["drp_outcome"] == name for row in results) for name in names[:2]]
    return f"| {kind} | {len(results)} | {' | '.join(map(str, counts))} |"


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the table, a row for each kind of scenes."""
    parser = argparse.ArgumentParser(prog="python -m tests.regression.cbf")
    parser.add_argument("--suite", default="moving_hard")
    parser.add_argument("--levels", nargs="*", default=[])
    parser.add_argument("--scenes", type=int, default=6)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    for name, default in asdict(Filter()).items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=type(default), default=default)
    options = parser.parse_args(arguments)
    parameters = Filter(**{name: getattr(options, name) for name in asdict(Filter())})
    logging.disable(logging.WARNING)
    heads = ["kind", "scenes", "contacts", "success", "stopped", "at the goal at rest"]
    heads += ["DRPBench contacts", "DRPBench success"]
    rows = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for kind in suite_kinds([options.suite], options.levels):
        suite = evaluation.panda_suite(kind, options.scenes, options.seed, ["nominal"], "truth")
        rows.append(_row(kind, run_suite(suite, parameters, options.json)))
    print("\n".join(rows))


if __name__ == "__main__":
    main()
