"""Sphere model of a robot, used to compute clearances: spheres around its collision geometry, and
the pairs of bodies that can collide.
"""

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
from drake_oa.robot.arm import Chain, Spheres, axis_frame, chain_poses, joints_to, make_chain
from drake_oa.robot.config import SphereParameters
from drake_oa.robot.plant import RobotPlant
from drake_oa.robot.sphere_cover import Cover, cover_key, load_cover

_ROUNDING_MARGIN = 1e-9
"""Additional radius of the spheres that enclose a group or cluster of spheres, against rounding
errors [m]."""
_MAX_CLUSTER_SIZE = 8
"""Maximum number of spheres in a cluster, a set of neighboring spheres that share a bounding
sphere."""
_N_SAMPLES = 2000
"""Number of random configurations at which each pair of bodies is tested for collision, to find
pairs that are always in contact, and the allowed overlap of the spheres of other pairs."""
_LOW_QUANTILE = 0.05
"""Level of the quantile from which the allowed overlap of two bodies' spheres is computed [-]. The
quantile is that of the distance between the exact shapes minus the distance between the spheres,
over the random configurations at which the spheres overlap and the shapes do not."""
_MAX_SPHERES = 200
"""Maximum number of spheres that cover one body; their protrusion from the body grows if more would
be required."""
_BALL_ITERATIONS = 300
"""Number of iterations of the algorithm that approximates the smallest ball around a set of
spheres."""
_SOURCE = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()
"""Digest of this source file, a part of the cache key of sphere models. After a change of the
algorithm, all models are therefore computed again."""
_CONTACT_FRACTION = 0.95
"""Minimum number of sampled configurations with contact between two bodies that count as always in
contact, as a fraction of all samples [-]. The pair of these bodies is ignored."""
_OVERLAP_FRACTION = 0.02
"""Minimum number of sampled configurations from which an allowed overlap of two bodies' spheres is
computed, as a fraction of all samples [-]. Configurations are counted at which the spheres overlap
and the exact shapes do not."""


@dataclass(frozen=True, eq=False)
class ArmSpheres(Frozen):
    """Sphere model of an arm with n revolute joints: S spheres in G groups, one group per body.

    Attributes:
        arrays: spheres as arrays for the compiled kernels.
        bodies: (G,) name of each group's body.
        protrusion: (G,) maximum protrusion of the spheres of each body from its shapes [m].
    """

    arrays: Spheres
    bodies: tuple[str, ...]
    protrusion: FloatArray


@compiled
def sphere_centers(chain: Chain, spheres: Spheres, q: FloatArray) -> FloatArray:
    """Computes the centers (T, S, 3) [m] of the S spheres that cover an arm, in the world, at T
    configurations (T, n) [rad].
    """
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
    robot: RobotPlant, q: FloatArray, tool_links: Sequence[str], parameters: SphereParameters
) -> ArmSpheres:
    """Computes the sphere model of a robot: the spheres that cover each body with collision
    geometry, and the self-collision pairs.

    The result is stored in the user's cache folder, and read from the cache when the inputs are the
    same.

    Args:
        robot: plant of the robot alone, with its base fixed in the world.
        q: (nq,) positions; joints that do not move the tool frame, such as finger joints, are fixed
            at these positions [rad, m].
        tool_links: names of the bodies of the tool and of grasped objects.
        parameters: protrusions of the spheres from the surfaces of links, tool and fixed bodies.

    Raises:
        ValueError: if no link moved by the joints has collision geometry, a joint between base and
            tool is not revolute, or a shape is not bounded.
    """
    plant, inspector = robot.plant, robot.scene_graph.model_inspector()
    joints = joints_to(plant, robot.tool_frame)
    # Body index -> row of the last joint that moves the body.
    last_joint = {
        body: row
        for row, joint in enumerate(joints)
        for body in plant.GetBodiesKinematicallyAffectedBy([joint.index()])
    }
    # Bodies of all model instances: a gripper may be a separate one. Body 0 is the world.
    all_bodies = [plant.get_body(BodyIndex(i)) for i in range(1, plant.num_bodies())]
    bodies = [body for body in all_bodies if plant.GetCollisionGeometriesForBody(body)]
    bodies.sort(key=lambda body: (last_joint.get(body.index(), -1), int(body.index())))
    joint = np.array([last_joint.get(body.index(), -1) for body in bodies], dtype=np.int64)
    if not (joint >= 0).any():
        links = [body.name() for body in all_bodies if body.index() in last_joint]
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
    message = f"covering the links of {plant.GetModelInstanceName(robot.instance)} with spheres"
    for row, body in enumerate(bodies):
        geometries = [read_geometry(inspector, geometry_id) for geometry_id in geometry_ids[row]]
        protrusion = parameters.protrusion if joint[row] >= 0 else parameters.max_fixed_protrusion
        if is_tool[row]:
            protrusion = parameters.max_tool_protrusion
        covers.append(
            load_cover(geometries, protrusion, max(_MAX_SPHERES, len(geometries)), message)
        )
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
        arrays = _assemble_spheres(covers, X_JB, joint, is_tool, pairs)
        return _filter_pairs(robot, q, geometry_ids, chain, arrays)._asdict()

    # The cache key contains all inputs to the last bit, so that equal arms have equal spheres.
    inputs = (keys, pairs, *(array.tolist() for array in (q, joint, is_tool, *X_JB, *chain)))
    digest = hashlib.sha256(repr(inputs).encode()).hexdigest()
    arrays = Spheres(**cached_arrays(f"spheres/{digest[:32]}", compute))
    return ArmSpheres(arrays, group_names, np.array([cover.protrusion for cover in covers]))


def _assemble_spheres(
    covers: Sequence[Cover],
    X_JB: Sequence[FloatArray],
    joint: IntArray,
    is_tool: BoolArray,
    pairs: list[tuple[int, int]],
) -> Spheres:
    """Assembles the covers of all bodies to the arrays `Spheres`, with centers in the frames of the
    joints, ordered by clusters (sets of at most eight neighboring spheres of a body).

    Args:
        covers: spheres of each body, which form a group, in the frame of the body.
        X_JB: (4, 4) pose of each group's body in the frame of the last joint that moves it, or in
            the world for a fixed body.
        joint: (G,) index of the last joint that moves each group; -1: the group is fixed to the
            world.
        is_tool: (G,) whether each group belongs to the tool or to the grasped object.
        pairs: indices of two groups that can collide with each other.
    """
    centers, radii, clusters, sizes = [], [], [], [0]
    for cover, X in zip(covers, X_JB, strict=True):
        p_JS = cover.centers @ X[:3, :3].T + X[:3, 3]
        rows = _split_clusters(p_JS, np.arange(len(p_JS)))
        order = np.concatenate(rows)
        centers.append(p_JS[order])
        radii.append(cover.radii[order])
        clusters.append([_bounding_ball(p_JS[row], cover.radii[row]) for row in rows])
        sizes += map(len, rows)
    counts = [len(cover.radii) for cover in covers]
    return Spheres(
        joint=np.repeat(joint, counts),
        p_JS=np.concatenate(centers),
        radius=np.concatenate(radii),
        of_tool=np.repeat(is_tool, counts),
        first=np.cumsum([0, *counts], dtype=np.int64),
        group_joint=joint,
        bound=np.array([_bounding_ball(p, r) for p, r in zip(centers, radii, strict=True)]),
        cluster=np.cumsum([0, *map(len, clusters)], dtype=np.int64),
        cluster_first=np.cumsum(sizes, dtype=np.int64),
        cluster_bound=np.concatenate(clusters),
        pairs=np.array(pairs, dtype=np.int64).reshape(-1, 2),
        allowance=np.zeros(len(pairs)),
    )


def _split_clusters(p: FloatArray, rows: IntArray) -> list[IntArray]:
    """Splits points into clusters of neighboring points, by recursive halving across the longest
    extent.

    Args:
        p: (N, 3) points [m].
        rows: rows of `p` to be split.

    Returns:
        Rows of `p` in each cluster.
    """
    if len(rows) <= _MAX_CLUSTER_SIZE:
        return [rows]
    axis = int(np.ptp(p[rows], axis=0).argmax())
    order = rows[np.argsort(p[rows, axis], kind="stable")]
    half = len(order) // 2
    return [*_split_clusters(p, order[:half]), *_split_clusters(p, order[half:])]


def _bounding_ball(centers: FloatArray, radii: FloatArray) -> FloatArray:
    """Computes center and radius (4,) of a ball that encloses K balls with centers (K, 3) and radii
    (K,) [m].

    The ball is approximately the smallest: in iteration i = 0, 1, ..., its center moves by 1 / (i +
    2) of the way to the center of the ball that extends farthest from it (M. Badoiu and K. L.
    Clarkson, Smaller core-sets for balls, 2003).
    """
    middle = centers.mean(axis=0)
    for i in range(1 + _BALL_ITERATIONS):
        reach = np.linalg.norm(centers - middle, axis=1) + radii
        if i < _BALL_ITERATIONS:
            middle = middle + (centers[reach.argmax()] - middle) / (i + 2.0)
    return np.append(middle, reach.max() + _ROUNDING_MARGIN)


def _filter_pairs(
    robot: RobotPlant,
    q: FloatArray,
    geometry_ids: Sequence[Sequence[GeometryId]],
    chain: Chain,
    spheres: Spheres,
) -> Spheres:
    """Removes the pairs of bodies that are always in contact, and computes for the other pairs how
    far their spheres may overlap (`allowance`).

    Random configurations are sampled, as in MoveIt's setup assistant. If the spheres of a pair
    overlap at a configuration, Drake's SceneGraph computes the distance of the exact shapes. A pair
    whose shapes are in contact at 95 % or more of the configurations is removed. The allowance is
    0 if the spheres overlap without contact of the shapes at less than 2 % of the configurations.
    Otherwise let delta be the distance of the exact shapes minus the distance of the spheres, at
    each configuration with such an overlap. The allowance is then

        max(0, min delta - (5 % quantile of delta - min delta))

    The difference in parentheses is a margin for configurations that were not sampled.

    Args:
        robot: plant of the robot alone.
        q: (nq,) positions; joints that do not move the tool frame are fixed at these positions
            [rad, m].
        geometry_ids: collision geometries of each group's body.
        chain: chain of the arm.
        spheres: spheres, with all pairs in `pairs`.

    Returns:
        The spheres, with the remaining pairs and their allowances.
    """
    # Joints without limits, or with a range of more than one turn, are sampled over one turn.
    is_unlimited = ~(chain.upper - chain.lower < 2.0 * np.pi)
    lower, upper = (
        np.where(is_unlimited, -np.pi, chain.lower),
        np.where(is_unlimited, np.pi, chain.upper),
    )
    samples = np.random.default_rng(0).uniform(lower, upper, (_N_SAMPLES, len(lower)))
    p_WS = sphere_centers(chain, spheres, samples)
    bounds = spheres._replace(joint=spheres.group_joint, p_JS=spheres.bound[:, :3])
    p_WG = sphere_centers(chain, bounds, samples)
    root = robot.diagram.CreateDefaultContext()
    context = robot.plant.GetMyMutableContextFromRoot(root)
    scene_context = robot.scene_graph.GetMyContextFromRoot(root)
    positions = q.copy()
    pairs, allowance = [], []
    for pair in spheres.pairs:
        i, j = pair
        sphere_distance = (
            np.linalg.norm(p_WG[:, i] - p_WG[:, j], axis=1) - spheres.bound[pair, 3].sum()
        )
        a, b = (slice(spheres.first[g], spheres.first[g + 1]) for g in pair)
        for k in np.flatnonzero(sphere_distance < 0.0):
            gaps = cdist(p_WS[k, a], p_WS[k, b]) - spheres.radius[a, None] - spheres.radius[b]
            sphere_distance[k] = gaps.min()
        rows = np.flatnonzero(sphere_distance < 0.0)
        shape_distance = np.empty(len(rows))
        for n, k in enumerate(rows):
            positions[chain.q_index] = samples[k]
            robot.plant.SetPositions(context, positions)
            query = robot.scene_graph.get_query_output_port().Eval(scene_context)
            shape_distance[n] = min(
                query.ComputeSignedDistancePairClosestPoints(id_a, id_b).distance
                for id_a in geometry_ids[i]
                for id_b in geometry_ids[j]
            )
        is_free = shape_distance > 0.0
        if (~is_free).sum() >= _CONTACT_FRACTION * len(samples):
            continue
        pairs.append(pair)
        difference = (shape_distance - sphere_distance[rows])[is_free]
        is_frequent = len(difference) >= _OVERLAP_FRACTION * len(samples)
        allowance.append(
            max(0.0, 2.0 * difference.min() - np.quantile(difference, _LOW_QUANTILE))
            if is_frequent
            else 0.0
        )
    return spheres._replace(
        pairs=np.array(pairs, dtype=np.int64).reshape(-1, 2), allowance=np.array(allowance)
    )
