"""Claims of passive motion safety, checked at every logged instant of a run against ground truth.

Claim (A): before an object slower than V = 0.8 m/s (`OBSTACLE_SPEED`) can reach a point of the
arm, the point is at rest or moves away. Claim (B): no point of the arm is faster than v_unseen =
0.25 m/s toward a place that may contain an object that no camera has observed.

At the logged instant t_k let s be the stamp (time of measurement) of the newest observation that
has arrived. A point i of the arm is the center c_i of one of the spheres that enclose the links,
r_i the radius of the sphere, and u_i the velocity of its center. Since the stamp, an object slower
than V has traveled at most V (t_k - s). It can touch the sphere only if at the stamp it was within
the reach

    rho_i = r_i + V (t_k - s)

of the point's position c_i(t_k). The ball of radius rho_i around c_i(t_k) is sampled at the places
p_ij = c_i + a_j rho_i n_j: its center (a_j = 0), and in 26 directions n_j at half and at full
radius (a_j = 1/2 and 1). A place is observed free if, in the image of some camera, its depth is
within the camera's range and less than the true depth of its pixel. If perception uses noisy
images, a pixel without a surface in the range of the camera observes nothing. A place is unobserved
if at s it was neither observed free nor occupied by true collision geometry or the arm. The point
is fully observed if none of its places is unobserved. Let d_i(t) be the distance from c_i(t) to the
nearest collision geometry of those that move at s, at their poses of time s. With the next logged
instant t_(k+1) and e = 0.02 m/s, the claims are violated at t_k if for some point i

    (A)  the point is fully observed, a moving geometry can reach it, d_i(t_k) <= rho_i,
         and the point approaches,  (d_i(t_k) - d_i(t_(k+1))) / (t_(k+1) - t_k) > e
    (B)  the point is fast toward an unobserved place p_ij,  u_i . n_j > v_unseen;
         if p_ij is the center c_i itself,  |u_i| > v_unseen

On (A): an object moves at s if its speed exceeded 1 mm/s at some time from s - 2 s to s, since an
object that pauses may move again. The claim assumes that an object at rest for 2 s stays at rest
for the time in which the arm stops.

On (B): only the speed toward unobserved places is limited. The arm occludes space behind it in
every image, so that unobserved space is near each of its points at all times.

Before the first observation all places count as unobserved. Without cameras (perception of exact
obstacles) all places count as observed. An unobserved place between two samples may be missed: a
reported violation of (B) is a violation, but a run without reports is not proven to satisfy (B).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.distance import cdist

from drake_oa.common.messages import BoolArray, FloatArray
from drake_oa.evaluation.panda.scenes import OBSTACLE_SPEED
from drake_oa.evaluation.panda.true_world import STEP, TrueWorld
from drake_oa.geometry.collision_scene import CollisionGeometries, least_distances
from drake_oa.geometry.directions import DIRECTIONS
from drake_oa.perception.config import CameraSource
from drake_oa.perception.depth_perception import FreeSpace
from drake_oa.robot.spheres import sphere_centers
from drake_oa.runs.camera_placement import observed_free_space
from drake_oa.runs.motion_log import MotionLog
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.sources import camera_configs
from drake_oa.world.delayed_camera import BackgroundCamera

V_UNSEEN = 0.25
"""Speed limit in claim (B) of passive motion safety [m/s]: maximum speed of a point of the arm
toward a place that no camera observes as free."""
_MAX_REST_SPEED = 0.02
"""Speed e toward an obstacle up to which a point of the arm counts as at rest in claim (A) of
passive motion safety [m/s]: a point rests or recedes before a moving obstacle can reach it."""
_MAX_DISTANCE = 1e3
"""Upper bound of the computed distances from the arm to moving collision geometry [m]. If no
geometry moves, all distances have this value."""
_SURFACE_MARGIN = 0.01
"""Distance from the surface of an object or the arm up to which a place counts as occupied, since
the pixels of depth images have a finite size [m]."""
_MIN_SPEED, _MAX_SPEED = 1e-3, 100.0
"""Speeds between which an object counts as moving [m/s]. An object that appears or vanishes between
two samples of its trajectory has a higher speed, but does not count as moving."""
_PAUSE = 2.0
"""Time for which an object that has come to rest still counts as moving, since it may move again
[s]."""
_SAMPLES = np.vstack([np.zeros((1, 3)), 0.5 * DIRECTIONS, DIRECTIONS])
"""Sample points (53, 3) in the unit ball [-]: the center, and 26 directions at half and at full
radius. Scaled by the reach of an object and moved to a point of the arm, they are the places for
which claims (A) and (B) check whether a camera has observed them."""


def claim_violations(
    world: TrueWorld,
    t: FloatArray,
    q: FloatArray,
    stamp: FloatArray,
    free_space: Callable[[float], FreeSpace] | None = None,
) -> dict[str, BoolArray]:
    """Finds the logged instants that violate claim (A) or (B) of passive motion safety.

    By (A), each point of the arm rests or recedes before an observed obstacle slower than 0.8 m/s
    can reach it. By (B), no point is faster than 0.25 m/s toward a place that no camera observes as
    free. The module's docstring has the inequalities.

    Args:
        world: the arm, and the true collision geometries along their trajectories.
        t: (T,) logged instants [s].
        q: (T, n) joint positions [rad].
        stamp: (T,) time of measurement of the newest observation at each instant [s]; -inf without
            one.
        free_space: function from a time of measurement [s] to a `FreeSpace`, the region that the
            true depth images of all cameras show to be free; called only if a claim depends on it.
            None: all space counts as observed.

    Returns:
        "A" and "B" -> (T,) whether the claim is violated at each instant; False at the last one,
        where no velocity is known.
    """
    radius = world.arm.spheres.radius
    centers = sphere_centers(world.arm.chain, world.arm.spheres, q)
    A, B = np.zeros((2, len(t)), dtype=bool)
    for s in np.unique(stamp[:-1]):
        k = np.flatnonzero(stamp[:-1] == s)
        dt, now, later = (t[k + 1] - t[k])[:, None], centers[k], centers[k + 1]
        velocity = (later - now) / dt[..., None]
        speed = np.linalg.norm(velocity, axis=2)
        if s == -np.inf:
            B[k] = (speed > V_UNSEEN).any(axis=1)
            continue
        reach, geometries = radius + OBSTACLE_SPEED * (t[k] - s)[:, None], _geometries_at(world, s)
        points = np.stack([now, later]).reshape(-1, 3)
        distance = least_distances(
            geometries.select(_moves_at(world, s)), points, 0.0, _MAX_DISTANCE, -np.inf
        ).reshape(2, *speed.shape)
        is_closing = (distance[0] <= reach) & (distance[0] - distance[1] > _MAX_REST_SPEED * dt)
        toward = velocity @ DIRECTIONS.T
        is_fast = np.concatenate([speed[..., None], toward, toward], axis=2) > V_UNSEEN
        unseen, requested = np.zeros_like(is_fast), is_fast | is_closing[..., None]
        if free_space is not None and requested.any():
            row, point, sample = np.nonzero(requested)
            places = now[row, point] + reach[row, point, None] * _SAMPLES[sample]
            arm = centers[np.searchsorted(t, s)], radius
            unseen[requested] = is_unobserved(places, geometries, arm, free_space(float(s)))
        A[k] = (is_closing & ~unseen.any(axis=2)).any(axis=1)
        B[k] = (is_fast & unseen).any(axis=(1, 2))
    return {"A": A, "B": B}


def _row(world: TrueWorld, time: float) -> int:
    """Returns the index of the sample in `world`, which has one every 8 ms from time 0 on, that is
    nearest to a time [s].
    """
    return round(min(max(time / STEP, 0.0), len(world.ball) - 1.0))


def _moves_at(world: TrueWorld, time: float) -> BoolArray:
    """Computes for each of the K collision geometries of `world` whether it moves at a time [s], or
    moved less than 2 s (`_PAUSE`) before: (K,).
    """
    position = world.ball[_row(world, time - _PAUSE) : _row(world, time) + 1, :, :3]
    speed = np.linalg.norm(np.diff(position, axis=0), axis=2) / STEP
    return np.asarray(((speed > _MIN_SPEED) & (speed < _MAX_SPEED)).any(axis=0))


def _geometries_at(world: TrueWorld, time: float) -> CollisionGeometries:
    """Returns the collision geometries of `world` at their true poses at a time [s]."""
    row = _row(world, time)
    return world.arm.geometries._replace(ball=world.ball[row], X_WO=world.X_WO[row])


def is_unobserved(
    places: FloatArray,
    geometries: CollisionGeometries,
    arm: tuple[FloatArray, FloatArray],
    free_space: FreeSpace,
) -> BoolArray:
    """Finds places that, at one time, no camera observes as free and no object or link occupies.

    A place within 1 cm (`_SURFACE_MARGIN`) of an object or a sphere of the arm counts as occupied.

    Args:
        places: (N, 3) positions in the world [m].
        geometries: true collision geometries at that time.
        arm: (S, 3) centers in the world and (S,) radii of the arm's spheres at that time [m].
        free_space: region that the images of the cameras at that time show to be free.

    Returns:
        (N,) whether each place is unobserved.
    """
    unseen = ~free_space.contains(places)
    remaining = np.flatnonzero(unseen)
    # Compute distances in parts, since all at once would require gigabytes of memory.
    for rows in np.array_split(remaining, len(remaining) // 10_000 + 1):
        distance = least_distances(geometries, places[rows], 0.0, _SURFACE_MARGIN, -np.inf)
        in_arm = (cdist(places[rows], arm[0]) < arm[1] + _SURFACE_MARGIN).any(axis=1)
        unseen[rows] = (distance >= _SURFACE_MARGIN) & ~in_arm
    return unseen


def run_violations(scenario: Scenario, log: MotionLog, world: TrueWorld) -> dict[str, BoolArray]:
    """Finds the instants of a logged run that violate a claim of passive motion safety.

    By claim (A), each point of the arm rests or recedes before an observed obstacle slower than 0.8
    m/s can reach it. By claim (B), no point is faster than 0.25 m/s toward a place that no camera
    observes as free. If perception knows the obstacles exactly, all space counts as observed.

    Args:
        scenario: scenario of the run; true depth images of its cameras are rendered.
        log: log of the run.
        world: arm and true collision geometries of the scenario.

    Returns:
        "A" and "B" -> (T,) whether the claim is violated at each of the T logged instants.
    """
    arrived = np.searchsorted(log.observation_time, log.t, side="right")
    stamp = np.append(-np.inf, log.observation_stamp)[arrived]
    q, source = log.q[:, world.arm.chain.q_index], scenario.perception
    if not isinstance(source, CameraSource):
        return claim_violations(world, log.t, q, stamp)
    configs = camera_configs(scenario, source)
    cameras = [BackgroundCamera(scenario, config) for config in configs]

    def observe(time: float) -> FreeSpace:
        q_world = log.q_world[np.searchsorted(log.t, time)]
        state = np.append(q_world, np.zeros_like(q_world))
        images = [camera.request(state, time).result() for camera in cameras]
        return observed_free_space(source, configs, images)

    return claim_violations(world, log.t, q, stamp, observe)
