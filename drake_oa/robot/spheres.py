"""A robot as spheres that enclose its collision geometry, and which bodies may touch each other."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import GeometryId
from pydrake.math import RigidTransform
from pydrake.multibody.tree import BodyIndex
from scipy.spatial.distance import cdist

from drake_oa.common.compiled import compiled
from drake_oa.common.files import cached_arrays
from drake_oa.common.messages import BoolArray, FloatArray, Frozen, IntArray
from drake_oa.geometry.collision_scene import read_geometry
from drake_oa.robot.arm import (
    Chain,
    Spheres,
    axis_frame,
    chain_poses,
    joints_to,
    make_chain,
)
from drake_oa.robot.config import SphereParameters
from drake_oa.robot.plant import RobotPlant
from drake_oa.robot.sphere_cover import Cover, cover_key, known_cover

_ROUNDED = 1e-9
"""Added to bounding spheres [m]."""
_CLUSTER = 8
"""Spheres of a cluster at most."""
_POSTURES = 2000
"""Number of random postures in which pairs of bodies that may touch are found."""
_LOW = 0.05
"""Share of the postures that is disregarded where most of them count."""
_MOST = 200
"""Most spheres of a body; where more are needed they stick out farther."""
_BALL_STEPS = 300
"""Steps towards the smallest ball that holds others."""
_SOURCE = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()
"""Digest of this algorithm: after a change, arms are computed again."""
_ALWAYS = 0.95
"""Share of the random postures in which the shapes of neighbors touch."""
_OFTEN = 0.02
"""Share of the random postures with overlapping spheres from which a pair has an allowance."""


@dataclass(frozen=True, eq=False)
class ArmSpheres(Frozen):
    """An arm of n revolute joints as S spheres in G groups, a body a group.

    Attributes:
        arrays: as the kernels take it; its fields say what is what.
        bodies: (G,) name of each group's body.
        protrusion: (G,) how far the spheres of each body stick out of its shapes at most [m].
    """

    arrays: Spheres
    bodies: tuple[str, ...]
    protrusion: FloatArray


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

    Those of one arm are kept in the user's cache, as `known_cover` keeps the spheres of a body.

    Args:
        robot: the robot alone, its base fixed anywhere in the world.
        q: (nq,) its positions; joints that do not move the tool frame stay as they are here,
            such as those of the fingers [rad, m].
        tool_links: names of the bodies of the tool, and of what it holds.
        parameters: how near the spheres fit.

    Raises:
        ValueError: for a robot without collision geometry on the links that its joints move, a
            joint between base and tool that is not revolute, a shape that is not bounded.
    """
    plant, inspector = robot.plant, robot.scene_graph.model_inspector()
    joints = joints_to(plant, robot.tool_frame)
    # The last joint that moves each body.
    moved = {
        body: row
        for row, joint in enumerate(joints)
        for body in plant.GetBodiesKinematicallyAffectedBy([joint.index()])
    }
    # Of all model instances: a gripper may be one of its own. Body 0 is the world.
    everything = [plant.get_body(BodyIndex(i)) for i in range(1, plant.num_bodies())]
    bodies = [body for body in everything if plant.GetCollisionGeometriesForBody(body)]
    bodies.sort(key=lambda body: (moved.get(body.index(), -1), int(body.index())))
    joint = np.array([moved.get(body.index(), -1) for body in bodies], dtype=np.int64)
    if not (joint >= 0).any():
        links = [body.name() for body in everything if body.index() in moved]
        raise ValueError(
            f"none of the links that the joints move ({', '.join(links)}) has collision geometry; "
            "the model needs a <collision> of bounded shape on those that are to be kept clear"
        )
    group_names = tuple(body.name() for body in bodies)
    is_tool = np.array([name in tool_links for name in group_names])
    geometry_ids = [plant.GetCollisionGeometriesForBody(body) for body in bodies]

    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    X_WJ = [joint.child_body().EvalPoseInWorld(context) @ axis_frame(joint) for joint in joints]
    X_WJ.append(RigidTransform())
    covers, keys, X_JB = [], [_SOURCE, version("drake")], []
    announce = f"covering the links of {plant.GetModelInstanceName(robot.instance)} with spheres"
    for row, body in enumerate(bodies):
        geometries = [read_geometry(inspector, geometry_id) for geometry_id in geometry_ids[row]]
        protrusion = parameters.protrusion if joint[row] >= 0 else parameters.max_fixed_protrusion
        if is_tool[row]:
            protrusion = parameters.max_tool_protrusion
        covers.append(known_cover(geometries, protrusion, max(_MOST, len(geometries)), announce))
        keys.append(cover_key(geometries, protrusion))
        X_JB.append((X_WJ[joint[row]].inverse() @ body.EvalPoseInWorld(context)).GetAsMatrix4())
    pairs = [
        (i, j)
        for i, j in combinations(range(len(joint)), 2)
        if abs(joint[i] - joint[j]) > 1
        and any(
            not inspector.CollisionFiltered(a, b) for a in geometry_ids[i] for b in geometry_ids[j]
        )
    ]
    chain = make_chain(plant, robot.tool_frame, q)

    def compute() -> dict[str, NDArray[Any]]:
        arrays = _joined(covers, X_JB, joint, is_tool, pairs)
        return _with_pairs_found(robot, q, geometry_ids, chain, arrays)._asdict()

    # All that they depend on, to the last bit: the same arm then moves the same.
    inputs = (keys, pairs, *(array.tolist() for array in (q, joint, is_tool, *X_JB, *chain)))
    digest = hashlib.sha256(repr(inputs).encode()).hexdigest()
    arrays = Spheres(**cached_arrays(f"spheres/{digest[:32]}", compute))
    return ArmSpheres(arrays, group_names, np.array([found.protrusion for found in covers]))


def _joined(
    covers: Sequence[Cover],
    X_JB: Sequence[FloatArray],
    joint: IntArray,
    is_tool: BoolArray,
    pairs: list[tuple[int, int]],
) -> Spheres:
    """Returns the spheres of all groups in a row, in the frames of their joints, by clusters."""
    centers, radii, clusters, sizes = [], [], [], [0]
    for found, X in zip(covers, X_JB, strict=True):
        p_JS = found.centers @ X[:3, :3].T + X[:3, 3]
        rows = _clusters(p_JS, np.arange(len(p_JS)))
        order = np.concatenate(rows)
        centers.append(p_JS[order])
        radii.append(found.radii[order])
        clusters.append([_ball(p_JS[row], found.radii[row]) for row in rows])
        sizes += map(len, rows)
    counts = [len(found.radii) for found in covers]
    return Spheres(
        joint=np.repeat(joint, counts),
        p_JS=np.concatenate(centers),
        radius=np.concatenate(radii),
        of_tool=np.repeat(is_tool, counts),
        first=np.cumsum([0, *counts], dtype=np.int64),
        group_joint=joint,
        bound=np.array([_ball(p, r) for p, r in zip(centers, radii, strict=True)]),
        cluster=np.cumsum([0, *map(len, clusters)], dtype=np.int64),
        cluster_first=np.cumsum(sizes, dtype=np.int64),
        cluster_bound=np.concatenate(clusters),
        pairs=np.array(pairs, dtype=np.int64).reshape(-1, 2),
        allowance=np.zeros(len(pairs)),
    )


def _clusters(p: FloatArray, rows: IntArray) -> list[IntArray]:
    """Divides rows of points (N, 3) into clusters of neighbors, by halves of the longest extent."""
    if len(rows) <= _CLUSTER:
        return [rows]
    axis = int(np.ptp(p[rows], axis=0).argmax())
    order = rows[np.argsort(p[rows, axis], kind="stable")]
    half = len(order) // 2
    return [*_clusters(p, order[:half]), *_clusters(p, order[half:])]


def _ball(centers: FloatArray, radii: FloatArray) -> FloatArray:
    """Returns center and radius (4,) of a small ball that holds others (K, 3), (K,).

    The center moves towards the farthest by ever smaller steps. M. Badoiu and K. L. Clarkson,
    Smaller core-sets for balls, 2003.
    """
    middle = centers.mean(axis=0)
    for i in range(1 + _BALL_STEPS):
        reach = np.linalg.norm(centers - middle, axis=1) + radii
        if i < _BALL_STEPS:
            middle = middle + (centers[reach.argmax()] - middle) / (i + 2.0)
    return np.append(middle, reach.max() + _ROUNDED)


def _with_pairs_found(
    robot: RobotPlant,
    q: FloatArray,
    geometry_ids: Sequence[Sequence[GeometryId]],
    chain: Chain,
    spheres: Spheres,
) -> Spheres:
    """Removes pairs of groups that always touch, and finds how much overlap is harmless.

    Random postures tell, as in MoveIt's setup assistant. Where spheres overlap, SceneGraph gives
    the distance of the shapes. A pair whose spheres overlap often while its shapes do not touch
    gets as an allowance the least by which its shapes were farther apart than its spheres;
    less, for postures that were not drawn, as much as that is below most of them.
    """
    # Joints without limits, or with those of more than a turn, turn once.
    is_round = ~(chain.upper - chain.lower < 2.0 * np.pi)
    lower, upper = np.where(is_round, -np.pi, chain.lower), np.where(is_round, np.pi, chain.upper)
    postures = np.random.default_rng(0).uniform(lower, upper, (_POSTURES, len(lower)))
    p_WS = sphere_centers(chain, spheres, postures)
    bounds = spheres._replace(joint=spheres.group_joint, p_JS=spheres.bound[:, :3])
    p_WG = sphere_centers(chain, bounds, postures)
    root = robot.diagram.CreateDefaultContext()
    context = robot.plant.GetMyMutableContextFromRoot(root)
    of_scene = robot.scene_graph.GetMyContextFromRoot(root)
    full = q.copy()
    kept, allowance = [], []
    for pair in spheres.pairs:
        i, j = pair
        apart = np.linalg.norm(p_WG[:, i] - p_WG[:, j], axis=1) - spheres.bound[pair, 3].sum()
        a, b = (slice(spheres.first[g], spheres.first[g + 1]) for g in pair)
        for k in np.flatnonzero(apart < 0.0):
            between = cdist(p_WS[k, a], p_WS[k, b]) - spheres.radius[a, None] - spheres.radius[b]
            apart[k] = between.min()
        rows = np.flatnonzero(apart < 0.0)
        shape_distance = np.empty(len(rows))
        for n, k in enumerate(rows):
            full[chain.q_index] = postures[k]
            robot.plant.SetPositions(context, full)
            query = robot.scene_graph.get_query_output_port().Eval(of_scene)
            shape_distance[n] = min(
                query.ComputeSignedDistancePairClosestPoints(one, other).distance
                for one in geometry_ids[i]
                for other in geometry_ids[j]
            )
        is_free = shape_distance > 0.0
        if (~is_free).sum() >= _ALWAYS * len(postures):
            continue
        kept.append(pair)
        slack = (shape_distance - apart[rows])[is_free]
        is_frequent = len(slack) >= _OFTEN * len(postures)
        allowance.append(
            max(0.0, 2.0 * slack.min() - np.quantile(slack, _LOW)) if is_frequent else 0.0
        )
    return spheres._replace(
        pairs=np.array(kept, dtype=np.int64).reshape(-1, 2), allowance=np.array(allowance)
    )
