"""Passive motion safety of a finished run, judged at every logged instant against the true world.

At the logged instant t_k let s be the stamp of the newest observation that has arrived. A point i
of the arm is the center c_i of an enclosing sphere of radius r_i, and u_i its velocity. In the time
since the stamp anything slower than V comes no farther than V (t_k - s), hence touches the point
only if it was within the reach

    rho_i = r_i + V (t_k - s)

of its center at the stamp. The ball of radius rho_i around c_i(t_k) is sampled at the places p_ij =
c_i + a_j rho_i n_j: its center, and in 26 directions n_j at half and at full radius. A place is
seen free if for some camera it is in the image, at a depth that perception uses, and not farther
than the true depth of its pixel; it is unseen if at s it was neither seen free nor taken by a true
solid or the arm. Sight is lacking at the point if any of its places is unseen. With d_i(t) the
distance of c_i(t) to the true solids that move at s, at their places then, the claims are violated
at t_k if for some i

    (A)  sight is not lacking,  d_i(t_k) <= rho_i,  and  (d_i(t_k) - d_i(t_k+1)) / (t_k+1 - t_k) > e
    (B)  u_i . n_j > v_unseen at an unseen place j; at its center: |u_i| > v_unseen

with e = 0.02 m/s.

(A): before anything slower than V can reach a point, it is at rest or moving away. A solid moves at
s if its course changes its place by more than 1 mm from s - 33 ms to s + 33 ms. The claim assumes
that what was observed at rest stays at rest for the time in which the arm stops.

(B): where that is not known for lack of sight, no point is faster than v_unseen toward what was not
seen. What is limited is the speed at which a point runs into something that could not be seen, not
its speed beside or away from there: the arm casts a shadow in every single image, hence each of its
points is near unseen space, and without cameras all around it none could ever be faster.

Before the first observation sight is lacking everywhere; without cameras, as from ground truth,
nowhere. A place without sight between two samples may be missed, so that a violation of (B) is one,
but its lack is not proven.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from drake_oa.common.messages import BoolArray, FloatArray
from drake_oa.evaluation.panda.true_world import STEP, TrueWorld
from drake_oa.geometry.collision_scene import CollisionGeometries, least_distances
from drake_oa.geometry.directions import DIRECTIONS
from drake_oa.geometry.pinhole import pixel_at
from drake_oa.perception.config import CameraSource
from drake_oa.perception.coverage import ViewVolume
from drake_oa.robot.spheres import sphere_centers
from drake_oa.runs.camera_placement import view_volumes
from drake_oa.runs.motion_log import MotionLog
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.sources import camera_configs
from drake_oa.world.delayed_camera import BackgroundCamera

V = 0.8
"""Speed below which claim (A) holds for anything [m/s]."""
V_UNSEEN = 0.25
"""Maximum speed of a point of the arm where sight is lacking [m/s]."""
_AT_REST = 0.02
"""Speed of approach at which a point counts as at rest [m/s]."""
_FAR = 1e3
"""Distance where no solid moves [m]."""
_SKIN = 0.01
"""Distance up to which a place counts as taken by a solid or the arm: images are of pixels [m]."""
_MOVES, _MOVES_TIME = 1e-3, 0.033
"""Displacement from this time before a stamp until so long after it above which a solid moves at
the stamp [m, s]."""
_SAMPLES = np.vstack([np.zeros((1, 3)), 0.5 * DIRECTIONS, DIRECTIONS])
"""(53, 3) places in the unit ball: its center, and those in `DIRECTIONS`."""


PlanningInputs = tuple[NDArray[np.float32], ViewVolume]
"""True depth image (H, W) of a camera, 0 where something is too near, inf where nothing is near
enough [m]; and where it was taken."""


def claim_violations(
    world: TrueWorld,
    t: FloatArray,
    q: FloatArray,
    stamp: FloatArray,
    sights: Callable[[float], Sequence[PlanningInputs]] | None = None,
) -> dict[str, BoolArray]:
    """Finds the instants at which the claims are violated, by the equations of the module.

    Args:
        world: the arm, and the true solids on their courses.
        t: (T,) logged instants [s].
        q: (T, n) joint positions [rad].
        stamp: (T,) stamp of the newest observation at each instant [s]; -inf: there is none.
        sights: returns the images of all cameras at a stamp, where needed; None: all is seen.

    Returns:
        "A" and "B" -> (T,) whether the claim is violated.
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
        reach, geometries = radius + V * (t[k] - s)[:, None], _solids_at(world, s)
        points = np.stack([now, later]).reshape(-1, 3)
        distance = least_distances(
            geometries.chosen(_moves_at(world, s)), points, 0.0, _FAR, -np.inf
        ).reshape(2, *speed.shape)
        is_closing = (distance[0] <= reach) & (distance[0] - distance[1] > _AT_REST * dt)
        toward = velocity @ DIRECTIONS.T
        is_fast = np.concatenate([speed[..., None], toward, toward], axis=2) > V_UNSEEN
        unseen, requested = np.zeros_like(is_fast), is_fast | is_closing[..., None]
        if sights is not None and requested.any():
            row, point, sample = np.nonzero(requested)
            places = now[row, point] + reach[row, point, None] * _SAMPLES[sample]
            arm = centers[np.searchsorted(t, s)], radius
            unseen[requested] = is_unseen(places, geometries, arm, sights(float(s)))
        A[k] = (is_closing & ~unseen.any(axis=2)).any(axis=1)
        B[k] = (is_fast & unseen).any(axis=(1, 2))
    return {"A": A, "B": B}


def _row(world: TrueWorld, time: float) -> int:
    """Returns the sample of the courses that is nearest to a time [s]."""
    return round(min(max(time / STEP, 0.0), len(world.ball) - 1.0))


def _moves_at(world: TrueWorld, time: float) -> BoolArray:
    """Finds the solids (K,) that move at a time [s]."""
    rows = [_row(world, time + offset) for offset in (-_MOVES_TIME, _MOVES_TIME)]
    before, after = world.ball[rows, :, :3]
    return np.asarray(np.linalg.norm(after - before, axis=1) > _MOVES)


def _solids_at(world: TrueWorld, time: float) -> CollisionGeometries:
    """Returns the solids where they are at a time [s]."""
    row = _row(world, time)
    return world.arm.geometries._replace(ball=world.ball[row], X_WO=world.X_WO[row])


def is_unseen(
    places: FloatArray,
    geometries: CollisionGeometries,
    arm: tuple[FloatArray, FloatArray],
    sights: Sequence[PlanningInputs],
) -> BoolArray:
    """Finds the places that are neither seen free nor taken, at one time.

    Args:
        places: (N, 3) in the world [m].
        geometries: true solids then.
        arm: (S, 3) centers and (S,) radii of the arm's spheres then [m].
        sights: images of the cameras then.

    Returns:
        (N,) whether each is unseen.
    """
    unseen = np.ones(len(places), dtype=bool)
    for depth, (X_WC, K, shape, near, far) in sights:
        p_C = (places - X_WC[:3, 3]) @ X_WC[:3, :3]
        pixel, z = pixel_at(p_C, shape, K), p_C[:, 2]
        seen = np.minimum(depth.ravel()[pixel], far)
        unseen &= ~((pixel >= 0) & (near <= z) & (z <= seen))
    left = np.flatnonzero(unseen)
    # In parts: all distances at once would take gigabytes.
    for rows in np.array_split(left, len(left) // 10_000 + 1):
        in_solid = least_distances(geometries, places[rows], 0.0, _SKIN, -np.inf) < _SKIN
        in_arm = (cdist(places[rows], arm[0]) < arm[1] + _SKIN).any(axis=1)
        unseen[rows] = ~(in_solid | in_arm)
    return unseen


def run_violations(scenario: Scenario, log: MotionLog, world: TrueWorld) -> dict[str, BoolArray]:
    """Finds the instants of a run at which the claims are violated, as `claim_violations`.

    Args:
        scenario: the scenario that was run; where it has cameras, their true images are rendered.
        log: of the run.
        world: the scenario's true world.
    """
    arrived = np.searchsorted(log.observation_time, log.t, side="right")
    stamp = np.append(-np.inf, log.observation_stamp)[arrived]
    q, source = log.q[:, world.arm.chain.q_index], scenario.perception
    if not isinstance(source, CameraSource):
        return claim_violations(world, log.t, q, stamp)
    views = view_volumes(scenario, source)
    cameras = [BackgroundCamera(scenario, config) for config in camera_configs(scenario, source)]

    def sights(time: float) -> list[PlanningInputs]:
        q_world = log.q_world[np.searchsorted(log.t, time)]
        state = np.append(q_world, np.zeros_like(q_world))
        images = [camera.request(state, time).result().depth for camera in cameras]
        return list(zip(images, views, strict=True))

    return claim_violations(world, log.t, q, stamp, sights)
