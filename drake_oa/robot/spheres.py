"""A robot as spheres that enclose its collision geometry, and which bodies may touch each other."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from pydrake.geometry import GeometryId, SceneGraphInspector
from pydrake.math import RigidTransform
from pydrake.multibody.tree import BodyIndex, RevoluteJoint, RigidBody
from pydrake.systems.framework import Context
from scipy.spatial.distance import cdist

from drake_oa.common.compiled import compiled
from drake_oa.common.console import ProgressLines
from drake_oa.common.messages import BoolArray, FloatArray, Frozen, IntArray
from drake_oa.geometry.solids import read_solid
from drake_oa.robot.arm import Chain, Spheres, axis_frame, chain_poses, joints_to, moved_by
from drake_oa.robot.config import SphereParameters
from drake_oa.robot.plant import RobotPlant
from drake_oa.robot.sphere_cover import Cover, known_cover

_ROUNDED = 1e-9
"""Added to bounding spheres [m]."""
_CLUSTER = 8
"""Spheres of a cluster at most."""
_BALL_STEPS = 300
_LOW, _FEW = 0.05, 30
"""What of the postures is not most of them, and how many tell too little."""
_MOST = 200
"""Most spheres of a body; where more are needed they stick out farther."""
_ALWAYS = 0.95
"""Share of the random postures in which the shapes of neighbours touch."""
_OFTEN = 0.02
"""Share of the random postures with overlapping spheres from which a pair has an allowance."""


@dataclass(frozen=True, eq=False)
class ArmSpheres(Frozen):
    """An arm of n revolute joints as S spheres in G groups, a body a group.

    Attributes:
        arrays: as the kernels take it; its fields say what is what.
        bodies: (G,) name of each group's body.
        overshoot: (G,) how far the spheres of each body stick out of its shapes at most [m].
    """

    arrays: Spheres
    bodies: tuple[str, ...]
    overshoot: FloatArray

    def __len__(self) -> int:
        return len(self.arrays.radius)


@compiled
def sphere_centers(chain: Chain, spheres: Spheres, q: FloatArray) -> FloatArray:
    """Computes (T, S, 3) centers of an arm's spheres in the world at joints (T, n) [m]."""
    X_WJ = np.empty((q.shape[1] + 2, 12))
    p_WS = np.empty((len(q), len(spheres.joint), 3))
    for row in range(len(q)):
        chain_poses(q[row], chain.X_PJ, X_WJ)
        for i in range(len(spheres.joint)):
            X = X_WJ[spheres.joint[i] + 1]
            x, y, z = spheres.p_JS[i]
            for k in range(3):
                p_WS[row, i, k] = X[3 * k] * x + X[3 * k + 1] * y + X[3 * k + 2] * z + X[9 + k]
    return p_WS


def make_arm_spheres(
    robot: RobotPlant,
    q: FloatArray,
    tool_links: Sequence[str],
    parameters: SphereParameters,
) -> ArmSpheres:
    """Spheres for everything of a robot that has collision geometry.

    Args:
        robot: the robot alone, its base fixed anywhere in the world.
        q: (nq,) its positions; joints that do not move the tool frame stay as they are here,
            such as those of the fingers [rad, m].
        tool_links: names of the bodies of the tool, and of what it holds.
        parameters: how near the spheres fit.

    Raises:
        ValueError: for a robot without collision geometry on what its joints move, a joint
            between base and tool that is not revolute, none at all, a shape that is not
            bounded, names that are not of bodies.
    """
    plant, inspector = robot.plant, robot.scene_graph.model_inspector()
    joints = joints_to(plant, robot.tool_frame)
    tool = robot.tool_frame.body()
    if not joints:
        raise ValueError(
            f"no joint moves '{tool.name()}', which carries the tool frame; there must be "
            "revolute joints between the base and the tool"
        )
    moved = moved_by(plant, joints)
    # Of all model instances: a gripper may be one of its own. Body 0 is the world.
    everything = [plant.get_body(BodyIndex(i)) for i in range(1, plant.num_bodies())]
    names = [body.name() for body in everything]
    bodies = [body for body in everything if plant.GetCollisionGeometriesForBody(body)]
    bodies.sort(key=lambda body: (moved.get(body.index(), -1), int(body.index())))
    joint = np.array([moved.get(body.index(), -1) for body in bodies], dtype=np.int64)
    if not (joint >= 0).any():
        links = [body.name() for body in everything if body.index() in moved]
        raise ValueError(
            f"none of the links that the joints move ({', '.join(links)}) has collision geometry; "
            "the model needs a <collision> of bounded shape on those that are to be kept clear"
        )
    unknown = sorted(set(tool_links) - set(names))
    if unknown:
        raise ValueError(f"tool_links: no body {', '.join(unknown)}; there are {', '.join(names)}")
    group_names = tuple(body.name() for body in bodies)
    is_tool = np.array([name in tool_links for name in group_names])
    geometries = [plant.GetCollisionGeometriesForBody(body) for body in bodies]

    root = robot.diagram.CreateDefaultContext()
    context = plant.GetMyMutableContextFromRoot(root)
    plant.SetPositions(context, q)
    X_WJ = _joint_frames([(joint.child_body(), axis_frame(joint)) for joint in joints], context)
    covers, X_JB = [], []
    # Covers in the user's cache are read in less time than the first line waits.
    model = plant.GetModelInstanceName(robot.instance)
    work = f"covering the links of {model} with spheres"
    progress = ProgressLines(work, len(bodies), last=time.monotonic())
    for row, body in enumerate(bodies):
        progress.update(row + 1)
        solids = [read_solid(inspector, geometry) for geometry in geometries[row]]
        asked = parameters.overshoot if joint[row] >= 0 else parameters.fixed_overshoot
        if is_tool[row]:
            asked = parameters.tool_overshoot
        covers.append(known_cover(solids, asked, max(_MOST, len(solids))))
        X_JW = RigidTransform(X_WJ[joint[row]]).inverse()
        X_JB.append((X_JW @ body.EvalPoseInWorld(context)).GetAsMatrix4())
    arrays = _laid(covers, X_JB, joint, is_tool, _candidates(inspector, geometries, joint))
    arrays = _with_pairs_found(robot, joints, geometries, q, arrays, parameters)
    return ArmSpheres(arrays, group_names, np.array([found.overshoot for found in covers]))


def _joint_frames(
    frames: Sequence[tuple[RigidBody, RigidTransform]], context: Context
) -> FloatArray:
    """Computes the poses of the joints' frames J.

    Args:
        frames: of each joint its child body B, and X_BJ.
        context: of the plant.

    Returns:
        (n + 1, 4, 4) poses in the world, the last the identity.
    """
    X_WJ = np.tile(np.eye(4), (len(frames) + 1, 1, 1))
    for i, (body, X_BJ) in enumerate(frames):
        X_WJ[i] = (body.EvalPoseInWorld(context) @ X_BJ).GetAsMatrix4()
    return X_WJ


def _laid(
    covers: Sequence[Cover],
    X_JB: Sequence[FloatArray],
    joint: IntArray,
    is_tool: BoolArray,
    pairs: list[tuple[int, int]],
) -> Spheres:
    """All the groups' spheres in a row, in the frames of their joints, neighbours together."""
    centers, radii, clusters = [], [], []
    for found, X in zip(covers, X_JB, strict=True):
        p_JS = found.centers @ X[:3, :3].T + X[:3, 3]
        rows = _clusters(p_JS, np.arange(len(p_JS)))
        order = np.concatenate(rows)
        centers.append(p_JS[order])
        radii.append(found.radii[order])
        clusters.append([(p_JS[row], found.radii[row]) for row in rows])
    counts = np.array([len(found.radii) for found in covers])
    sizes = [len(r) for of_group in clusters for _, r in of_group]
    return Spheres(
        joint=np.repeat(joint, counts),
        p_JS=np.concatenate(centers),
        radius=np.concatenate(radii),
        of_tool=np.repeat(is_tool, counts),
        first=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        group_joint=joint,
        bound=np.array([_ball(p, r) for p, r in zip(centers, radii, strict=True)]),
        cluster=np.cumsum([0] + [len(of_group) for of_group in clusters], dtype=np.int64),
        cluster_first=np.cumsum([0, *sizes], dtype=np.int64),
        cluster_bound=np.array([_ball(p, r) for of_group in clusters for p, r in of_group]),
        pairs=np.array(pairs, dtype=np.int64).reshape(-1, 2),
        allowance=np.zeros(len(pairs)),
    )


def _clusters(p: FloatArray, rows: IntArray) -> list[IntArray]:
    """Rows of points (N, 3) in clusters of neighbours, halved along their longest extent."""
    if len(rows) <= _CLUSTER:
        return [rows]
    axis = int(np.ptp(p[rows], axis=0).argmax())
    order = rows[np.argsort(p[rows, axis], kind="stable")]
    half = len(order) // 2
    return [*_clusters(p, order[:half]), *_clusters(p, order[half:])]


def _ball(centers: FloatArray, radii: FloatArray) -> FloatArray:
    """(4,) centre and radius of a small ball that holds others (K, 3), (K,).

    The centre goes towards the farthest by ever smaller steps. M. Badoiu and K. L. Clarkson,
    Smaller core-sets for balls, 2003.
    """
    middle = centers.mean(axis=0)
    for i in range(_BALL_STEPS):
        reach = np.linalg.norm(centers - middle, axis=1) + radii
        middle = middle + (centers[reach.argmax()] - middle) / (i + 2.0)
    reach = np.linalg.norm(centers - middle, axis=1) + radii
    return np.append(middle, reach.max() + _ROUNDED)


def _candidates(
    inspector: SceneGraphInspector, geometries: Sequence[Sequence[GeometryId]], joint: IntArray
) -> list[tuple[int, int]]:
    """Groups that more than one joint parts and that the model's filters let touch."""
    return [
        (i, j)
        for i, j in combinations(range(len(joint)), 2)
        if abs(joint[i] - joint[j]) > 1
        and any(not inspector.CollisionFiltered(a, b) for a in geometries[i] for b in geometries[j])
    ]


def _with_pairs_found(
    robot: RobotPlant,
    joints: list[RevoluteJoint],
    geometries: Sequence[Sequence[GeometryId]],
    q: FloatArray,
    spheres: Spheres,
    parameters: SphereParameters,
) -> Spheres:
    """Leaves out pairs that always touch, and finds what overlap means nothing.

    Random postures tell, as in MoveIt's setup assistant. Where spheres overlap, SceneGraph tells
    whether the shapes touch. A pair whose spheres overlap often while its shapes do not touch
    gets as an allowance the least by which its shapes were farther apart than its spheres, of all
    those postures; less, for what they do not tell, as much as that is below most of them.
    """
    plant = robot.plant
    index = np.array([joint.position_start() for joint in joints])
    lower, upper = plant.GetPositionLowerLimits()[index], plant.GetPositionUpperLimits()[index]
    # Joints without limits, or with those of more than a turn, go once round.
    is_round = ~(upper - lower < 2.0 * np.pi)
    lower, upper = np.where(is_round, -np.pi, lower), np.where(is_round, np.pi, upper)
    random = np.random.default_rng(parameters.seed)
    postures = random.uniform(lower, upper, (parameters.postures, len(joints)))
    root = robot.diagram.CreateDefaultContext()
    context = plant.GetMyMutableContextFromRoot(root)
    of_scene = robot.scene_graph.GetMyContextFromRoot(root)
    group = {geometry: g for g, of_body in enumerate(geometries) for geometry in of_body}
    row = {(int(i), int(j)): k for k, (i, j) in enumerate(spheres.pairs)}
    frames = [(joint.child_body(), axis_frame(joint)) for joint in joints]
    apart = np.zeros((len(postures), len(row)))
    touch = np.zeros(apart.shape, dtype=bool)
    full = q.copy()
    for k, posture in enumerate(postures):
        full[index] = posture
        plant.SetPositions(context, full)
        _lower_pair_distances(_joint_frames(frames, context), spheres, apart[k])
        if (apart[k] < 0.0).any():
            query = robot.scene_graph.get_query_output_port().Eval(of_scene)
            for found in query.ComputePointPairPenetration():
                i, j = sorted((group.get(found.id_A, -1), group.get(found.id_B, -1)))
                if (i, j) in row:
                    touch[k, row[i, j]] = True

    def true_distance(k: int, i: int, j: int) -> float:
        full[index] = postures[k]
        plant.SetPositions(context, full)
        query = robot.scene_graph.get_query_output_port().Eval(of_scene)
        return min(
            query.ComputeSignedDistancePairClosestPoints(a, b).distance
            for a in geometries[i]
            for b in geometries[j]
        )

    allowance, kept = np.zeros(len(row)), touch.mean(axis=0) < _ALWAYS
    for (i, j), p in row.items():
        overlap = np.flatnonzero((apart[:, p] < 0.0) & ~touch[:, p])
        if kept[p] and len(overlap) >= max(_FEW, _OFTEN * len(postures)):
            slack = [true_distance(int(k), i, j) - float(apart[k, p]) for k in overlap]
            allowance[p] = max(0.0, 2.0 * min(slack) - float(np.quantile(slack, _LOW)))
    found_pairs = np.ascontiguousarray(spheres.pairs[kept])
    return spheres._replace(pairs=found_pairs, allowance=allowance[kept])


def _lower_pair_distances(X_WJ: FloatArray, spheres: Spheres, apart: FloatArray) -> None:
    """Lowers apart (P,) to the distances of the pairs of groups that are less [m].

    Args:
        X_WJ: (n + 1, 4, 4) from `_joint_frames`.
        spheres: of the arm.
        apart: (P,) changed.
    """
    first, bound = spheres.first, spheres.bound
    of_sphere, of_group = X_WJ[spheres.joint], X_WJ[spheres.group_joint]
    centers = np.einsum("sij,sj->si", of_sphere[:, :3, :3], spheres.p_JS) + of_sphere[:, :3, 3]
    at = np.einsum("gij,gj->gi", of_group[:, :3, :3], bound[:, :3]) + of_group[:, :3, 3]
    one, other = spheres.pairs.T
    away = np.linalg.norm(at[one] - at[other], axis=1) - bound[one, 3] - bound[other, 3]
    for p in np.flatnonzero(away < apart):
        a, b = (slice(first[g], first[g + 1]) for g in spheres.pairs[p])
        between = cdist(centers[a], centers[b]) - spheres.radius[a, None] - spheres.radius[b]
        apart[p] = min(apart[p], between.min())
