"""Positions and velocities of tracked obstacles: a constant-velocity Kalman filter and its
measurements.

A track is one obstacle over time. The state of each world axis is (position, velocity).
Acceleration is white noise of spectral density q, so that a step dt adds the covariance

    Q = q [[dt^3/3, dt^2/2], [dt^2/2, dt]]

(Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001,
ch. 6: continuous white noise acceleration). The axes are independent.

Position is measured by the sides of an obstacle (`find_sides`), its robust ends along each axis.
Beyond each side lie 2 % of the largest visible area of the obstacle. The centroid of the visible
points shifts when the arm occludes a part of the obstacle. A side does not shift as long as the
image contains free space beyond this side.

Velocity is measured by the displacement of the surface since an earlier frame: `register_surface`
aligns the points of both frames (`measure_velocities`).

A track rests or moves (`_decide_motion`). The remembered surface points of a moving track move with
the filter's position; those of a resting track do not move, and its output velocity is zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from drake_oa.common.messages import BoolArray, FloatArray, Frozen, IntArray, TablePlane, zeros
from drake_oa.geometry.pinhole import View, pixel_at, pixel_rays
from drake_oa.perception.segmentation import Segmentation

SIDE_DEVIATION = 0.0015
"""Standard deviation of the measured position of an obstacle's side (end along an axis) or surface
point, at depths up to 1.2 m [m]."""
_ACCELERATION = 0.001
"""Spectral density of the acceleration noise that the Kalman filter assumes for a resting obstacle,
per axis, and its minimum for a moving one [m^2/s^3]."""
_MANEUVER, _FAST_SPEED = 0.05, 0.3
"""Spectral density of the acceleration noise that the Kalman filter assumes for a fast obstacle,
per axis [m^2/s^3], and the speed from which an obstacle is fast [m/s]. For a slower moving obstacle
the density is proportional to the square of the speed, but at least `_ACCELERATION`."""
_START_SPEED = 0.03
"""Minimum speed of a tracked obstacle at which a frame can be evidence that the obstacle moves
[m/s]."""
START_STATISTIC = 21.1
"""Minimum speed statistic v^T P_v^-1 v of a significant velocity v with covariance P_v [-]. Noise
exceeds it in one of 10,000 frames of an obstacle at rest."""
_CERTAIN_STATISTIC = 100.0
"""Minimum speed statistic v^T P_v^-1 v of a velocity v with covariance P_v at which a single frame
starts the motion of a track [-]."""
_REST_SPEED = 0.02
"""Speed of a tracked obstacle below which a frame is evidence that the obstacle rests [m/s]."""
_STOP_STATISTIC = 7.8
"""Speed statistic v^T P_v^-1 v of a velocity v with covariance P_v: below this value an obstacle
seems to rest, above it motion is likely [-]."""
_STOP_TIME = 0.1
"""Duration of uninterrupted evidence of rest (speed statistic below `_STOP_STATISTIC`, or speed
below `_REST_SPEED`) after which a moving track counts as resting [s]."""
_OUTLIER = 5.0
"""Gate: maximum difference between measured and predicted position or velocity of a track, in
standard deviations of this difference [-]. A position beyond the gate is an outlier; a velocity
beyond it shows that the obstacle has changed its motion."""
_JUMP = 0.01
"""Minimum displacement at which a resting obstacle counts as moved to another place, so that its
remembered points are moved there [m]."""
_SETTLING = 0.1
"""Weight of one frame in the running mean of a resting obstacle's position [-]."""
_STRONG_EVIDENCE = 0.15
"""Minimum motion evidence (fraction of a track's visible points that are not observed again) at
which a velocity below `START_STATISTIC` counts as likely motion [-]."""
COAST_TIME = 0.5
"""Maximum duration for which a moving track without measurements is predicted by its velocity
(coasting) [s]."""
UNMEASURED_TIME = 0.2
"""Time without a measurement along an axis after which the velocity of a resting track along that
axis is set to zero [s]."""
_SIGNIFICANT_SCORE = 3
"""Increase of a track's motion score by a frame with a significant velocity (speed statistic above
`START_STATISTIC`). A frame with a likely velocity (above `_STOP_STATISTIC`, with motion evidence
above `_STRONG_EVIDENCE`) adds 1. A resting track starts to move at the score `_MOVING_SCORE`."""
_MOVING_SCORE = 2 * _SIGNIFICANT_SCORE
"""Motion score at which a resting track starts to move: the sum, over consecutive frames, of
`_SIGNIFICANT_SCORE` for a significant velocity (speed statistic above `START_STATISTIC`) and 1 for
a likely one (above `_STOP_STATISTIC`, with motion evidence above `_STRONG_EVIDENCE`). One frame
with a measured velocity and a statistic above `_CERTAIN_STATISTIC` suffices."""
_REST_RADIUS = 0.004
"""Distance of an obstacle from its resting position above which a significant velocity (speed
statistic above `START_STATISTIC`) counts as evidence of motion [m]. With a statistic above
`_CERTAIN_STATISTIC`, no distance is required."""
_MIN_EVIDENCE = 0.04
"""Motion evidence (fraction of a track's visible points that are not observed again) above which a
resting obstacle is suspected to move, so that its velocity is measured [-]."""
MAX_GAP = 1.0
"""Maximum time between two frames from which a velocity is computed [s]. After a longer gap, all
tracks count as resting."""
INITIAL_SPEED = 0.4
"""Standard deviation of the velocity of a new track along each axis, before its first measured
velocity [m/s]."""


@dataclass(frozen=True, eq=False)
class Tracks(Frozen):
    """State of M tracks, one per row of each array; a track is one obstacle over time.

    Attributes:
        ids: (M,) track IDs.
        state: (M, 3, 2) filtered position [m] and velocity [m/s] along each world axis. The
            position is that of a point fixed to the obstacle, initially its centroid.
        covariance: (M, 3, 2, 2) covariance of position and velocity along each world axis.
        shift_W: (M, 3) translation from the frame O of the remembered points to the world [m]: p_WQ
            = p_OQ + shift_W.
        p_shift_W: (M, 3) position of the obstacle in the world at which its remembered points are
            placed [m]. For a moving obstacle, it is the filtered position; for a resting one, the
            running mean of the filtered position.
        sides: (M, 3, 2) lowest and highest side (end) of the obstacle along each world axis,
            relative to the filtered position [m]; NaN while unknown.
        area: (M,) largest visible area, perpendicular to the line of sight [m^2]; it decreases by
            1 % per frame while all sides are visible.
        is_moving: (M,) whether the obstacle moves.
        motion_evidence: (M,) fraction of the visible remembered points without an observed point
            near them, in [0, 1]: the slowly decaying maximum over the last frames.
        motion_score: (M,) sum of the scores of consecutive frames by their speed statistic:
            `_SIGNIFICANT_SCORE` above `START_STATISTIC`, `_MOVING_SCORE` above
            `_CERTAIN_STATISTIC`, and 1 above `_STOP_STATISTIC` with motion evidence above
            `_STRONG_EVIDENCE`; `_decide_motion` has all conditions. From `_MOVING_SCORE` on, a
            resting obstacle moves.
        rest_time: (M,) time for which the speed statistic has been below `_STOP_STATISTIC`, or
            the speed below `_REST_SPEED`, without interruption [s].
        unmeasured_time: (M, 3) time since the last measurement along each world axis [s].
        is_outlier: (M, 3) whether the last position measured along each axis was an outlier, more
            than `_OUTLIER` standard deviations from its prediction.
        split_frames: (M,) number of consecutive frames with the obstacle in separate parts.
        merged_time: (M,) time for which the track has shared one cluster with a track of more
            remembered points, with velocities that differ by less than 0.1 m/s [s].
    """

    ids: IntArray = zeros(0, kind=np.int64)
    state: FloatArray = zeros(0, 3, 2)
    covariance: FloatArray = zeros(0, 3, 2, 2)
    shift_W: FloatArray = zeros(0, 3)
    p_shift_W: FloatArray = zeros(0, 3)
    sides: FloatArray = zeros(0, 3, 2)
    area: FloatArray = zeros(0)
    is_moving: BoolArray = zeros(0, kind=bool)
    motion_evidence: FloatArray = zeros(0)
    motion_score: IntArray = zeros(0, kind=np.int64)
    rest_time: FloatArray = zeros(0)
    unmeasured_time: FloatArray = zeros(0, 3)
    is_outlier: BoolArray = zeros(0, 3, kind=bool)
    split_frames: IntArray = zeros(0, kind=np.int64)
    merged_time: FloatArray = zeros(0)

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def p_W(self) -> FloatArray:
        """Positions (M, 3) of the tracked obstacles in the world, as filtered by the Kalman filter
        [m].
        """
        return self.state[..., 0]

    @property
    def v_W(self) -> FloatArray:
        """Velocities (M, 3) of the tracked obstacles in the world, as filtered by the Kalman filter
        [m/s].
        """
        return self.state[..., 1]


def new_tracks(p_W: FloatArray) -> Tracks:
    """Returns new tracks of M obstacles at the positions p_W (M, 3) in the world [m].

    The tracks are at rest, and have ID 0 until the tracker numbers them. Their sides (ends of the
    obstacle along each world axis) are unknown, that is, NaN.
    """
    parts = {
        name: np.zeros((len(p_W), *part.shape[1:]), dtype=part.dtype)
        for name, part in vars(Tracks()).items()
    }
    parts["state"][..., 0], parts["covariance"][:] = p_W, _FIRST_COVARIANCE
    parts["sides"][:] = np.nan
    return Tracks(**parts | {"p_shift_W": p_W})


_FIRST_COVARIANCE = np.diag([SIDE_DEVIATION**2, INITIAL_SPEED**2])
"""Covariance (2, 2) of the position [m] and velocity [m/s] of a new track, per axis."""


def kalman_update(tracks: Tracks, kind: int, measured: FloatArray, variance: FloatArray) -> Tracks:
    """Corrects the state of each track by the Kalman update for measured positions (kind 0) or
    velocities (kind 1).

    With H the row of the identity with index `kind`, and the variance r of the measurement z:

        K = P H^T / (H P H^T + r),   x <- x + K (z - H x),   P <- P - K H P

    Args:
        tracks: predicted tracks with states x and covariances P.
        kind: 0 for positions, 1 for velocities.
        measured: (M, 3) measurements z along the world axes [m or m/s]; NaN: no measurement.
        variance: (M, 3) variances r of the measurements [m^2 or m^2/s^2].
    """
    P, is_measured = tracks.covariance, np.isfinite(measured)
    innovation = np.where(is_measured, measured - tracks.state[..., kind], 0.0)
    gain = P[..., kind] / (P[..., kind, kind] + variance)[..., None] * is_measured[..., None]
    return replace(
        tracks,
        state=tracks.state + gain * innovation[..., None],
        covariance=P - gain[..., None] * P[..., kind, None, :],
    )


def speed_statistic(tracks: Tracks) -> FloatArray:
    """Computes the speed statistic v^T P_v^-1 v (M,) of each track, with velocity v and covariance
    P_v of v.

    For an obstacle at rest it is chi-square distributed with 3 degrees of freedom.
    """
    return np.asarray((tracks.v_W**2 / tracks.covariance[..., 1, 1]).sum(axis=1))


_AREA_DECAY = 0.99
"""Factor per frame by which the largest visible area that is stored for an obstacle decays, while
all its sides are visible [-]."""


def predict_tracks(tracks: Tracks, dt: float) -> Tracks:
    """Predicts the tracks dt [s] >= 0 ahead by their velocities; remembered points of moving tracks
    move with them.

    A moving track without a measurement for 0.5 s (`COAST_TIME`) stops at its last predicted
    position. All tracks stop after a gap of more than 1 s (`MAX_GAP`) between frames.
    """
    gap = dt > MAX_GAP
    is_moving = (
        tracks.is_moving & (tracks.unmeasured_time.min(axis=1) + dt <= COAST_TIME) & (not gap)
    )
    lost = (tracks.is_moving & ~is_moving) | gap
    P = np.where(lost[:, None, None, None], _FIRST_COVARIANCE, tracks.covariance)
    # Noise in the velocity of a resting track would displace it while it is occluded.
    is_uncertain = (tracks.unmeasured_time > UNMEASURED_TIME) | lost[:, None]
    state = np.array(tracks.state)
    state[..., 1][~is_moving[:, None] & is_uncertain] = 0.0
    dt = min(dt, MAX_GAP)
    F = np.array([[1.0, dt], [0.0, 1.0]])
    Q = np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])
    share = np.minimum((tracks.v_W**2).sum(axis=1) / _FAST_SPEED**2, 1.0) * is_moving
    q = np.maximum(share * _MANEUVER, _ACCELERATION)[:, None, None, None]
    state = state @ F.T
    step = np.where(is_moving[:, None], state[..., 0] - tracks.p_shift_W, 0.0)
    return replace(
        tracks,
        state=state,
        covariance=F @ P @ F.T + q * Q,
        shift_W=tracks.shift_W + step,
        p_shift_W=tracks.p_shift_W + step,
        is_moving=is_moving,
    )


def correct_tracks(
    tracks: Tracks,
    sides: Sides,
    deviation: FloatArray,
    v_W: FloatArray,
    v_variance: FloatArray,
    dt: float,
) -> Tracks:
    """Corrects the tracks by the positions and velocities measured in a frame, and decides which
    tracks move.

    Along each axis, a measurement is beyond the gate if it differs from its prediction by more than
    `_OUTLIER` (5) standard deviations.

    - A position beyond the gate is an outlier, and is rejected. A second outlier in a row is
      accepted, since the obstacle has changed its motion: the variance of the predicted position
      grows by the square of the difference, and the variance of the predicted velocity is reset.
    - A velocity beyond the gate is accepted, for example when a resting obstacle starts to move:
      the variance of the predicted velocity is reset.

    The reset velocity variance is that of a new track (`INITIAL_SPEED`).

    Args:
        tracks: predicted tracks.
        sides: sides (ends along the world axes) of the obstacles in the frame.
        deviation: (M,) standard deviations of depth at the obstacles, from `depth_deviation` [m].
        v_W: (M, 3) measured velocities of the surfaces in the world [m/s]; NaN: not measured.
        v_variance: (M, 3) variances of `v_W` [m^2/s^2].
        dt: time since the previous frame [s].
    """
    p_W, variance = measure_positions(sides, tracks.sides, tracks.area, deviation)
    has_velocity, previous_sides = np.isfinite(v_W), tracks.sides
    change = np.where(has_velocity, v_W - tracks.v_W, 0.0)
    has_changed = change**2 > _OUTLIER**2 * (tracks.covariance[..., 1, 1] + v_variance)
    reset = tracks.covariance * np.diag([1.0, 0.0]) + np.diag([0.0, INITIAL_SPEED**2])
    P = np.where(has_changed[..., None, None], reset, tracks.covariance)
    tracks = kalman_update(replace(tracks, covariance=P), 1, v_W, v_variance)
    jump = np.where(np.isfinite(p_W), p_W - tracks.p_W, 0.0)
    is_outlier = jump**2 > _OUTLIER**2 * (tracks.covariance[..., 0, 0] + variance)
    is_maneuver = is_outlier & tracks.is_outlier
    P = np.array(tracks.covariance)
    P[is_maneuver, 0, 0] += jump[is_maneuver] ** 2
    P[is_maneuver, 0, 1] = P[is_maneuver, 1, 0] = 0.0
    P[is_maneuver, 1, 1] = INITIAL_SPEED**2
    p_W = np.where(is_outlier & ~is_maneuver, np.nan, p_W)
    is_measured = np.isfinite(p_W) | has_velocity
    tracks = kalman_update(replace(tracks, covariance=P), 0, p_W, variance)
    is_whole = sides.ends.all(axis=(1, 2))
    new_sides = learn_sides(sides, previous_sides, tracks.p_W)
    tracks = replace(
        tracks,
        sides=np.where(is_outlier[:, :, None], previous_sides, new_sides),
        area=np.maximum(sides.area, np.where(is_whole, _AREA_DECAY, 1.0) * tracks.area),
        unmeasured_time=np.where(is_measured, 0.0, tracks.unmeasured_time + dt),
        is_outlier=is_outlier,
    )
    any_measured, any_velocity = is_measured.any(axis=1), has_velocity.any(axis=1)
    return _decide_motion(tracks, np.asarray(any_measured), np.asarray(any_velocity), dt)


def _decide_motion(
    tracks: Tracks, is_measured: BoolArray, has_velocity: BoolArray, dt: float
) -> Tracks:
    """Decides which tracks move, and moves the remembered points of moving tracks to the filtered
    position.

    Symbols:

    - v: velocity, with covariance P_v;
    - S: speed statistic v^T P_v^-1 v;
    - D: motion evidence, the fraction of the visible remembered points that are not observed again;
    - d: distance of the filtered position from the position at which the remembered points are
      placed (`Tracks.p_shift_W`).

    A track is suspect if it moves, has a measured velocity, or has D > _MIN_EVIDENCE. A frame is
    certain if the velocity is measured and S > _CERTAIN_STATISTIC. It is significant if S >
    START_STATISTIC, |v| > _START_SPEED, and the frame is certain, the track moves, or it is suspect
    with d > _REST_RADIUS.

        frame with a measurement of the track                               motion score
        significant                                                         + _SIGNIFICANT_SCORE
        significant and certain                                             + _MOVING_SCORE
        S > _STOP_STATISTIC, D > _STRONG_EVIDENCE, |v| > _START_SPEED       + 1
        any other                                                           reset to 0

        state     condition                                                 next state
        resting   motion score >= _MOVING_SCORE                             moving
        moving    S < _STOP_STATISTIC or |v| < _REST_SPEED for _STOP_TIME   resting
        resting   suspect, and d > _JUMP along measured axes                resting, points moved

    Args:
        tracks: corrected tracks.
        is_measured: (M,) whether the frame has a measurement of each track.
        has_velocity: (M,) whether the frame has a measured velocity of each track.
        dt: time since the previous frame [s].
    """
    statistic, speed = speed_statistic(tracks), np.linalg.norm(tracks.v_W, axis=1)
    offset = tracks.p_W - tracks.p_shift_W
    is_suspect = tracks.is_moving | has_velocity | (tracks.motion_evidence > _MIN_EVIDENCE)
    is_fast = (speed > _START_SPEED) & is_measured
    is_distant = np.linalg.norm(offset, axis=1) > _REST_RADIUS
    is_significant = statistic > START_STATISTIC
    is_certain = has_velocity & (statistic > _CERTAIN_STATISTIC)
    is_significant &= is_fast & (is_certain | tracks.is_moving | (is_suspect & is_distant))
    is_likely = is_fast & (statistic > _STOP_STATISTIC)
    is_likely &= tracks.motion_evidence > _STRONG_EVIDENCE
    score = np.where(is_certain, _MOVING_SCORE, _SIGNIFICANT_SCORE)
    score = tracks.motion_score + np.where(is_significant, score, 1)
    score = np.where(is_significant | is_likely, score, 0)
    # Distant obstacles are not measured in each frame.
    motion_score = np.where(is_measured, score, tracks.motion_score)
    is_calm = (statistic < _STOP_STATISTIC) | (speed < _REST_SPEED)
    rest_time = np.where(is_calm, tracks.rest_time + dt, 0.0)
    is_moving = (tracks.is_moving | (motion_score >= _MOVING_SCORE)) & (rest_time < _STOP_TIME)
    # A resting track jumps only along the axes that were measured.
    jump = np.where(is_moving[:, None] | (tracks.unmeasured_time == 0.0), offset, 0.0)
    has_jumped = is_suspect & (np.linalg.norm(jump, axis=1) > _JUMP)
    follows = is_measured & (is_moving | has_jumped)
    step = np.where(follows[:, None], jump, 0.0)
    settling = np.where((is_measured & ~follows)[:, None], _SETTLING * offset, 0.0)
    return replace(
        tracks,
        is_moving=is_moving,
        motion_score=motion_score,
        rest_time=rest_time,
        shift_W=tracks.shift_W + step,
        p_shift_W=tracks.p_shift_W + step + settling,
    )


_MAX_SURFACE_POINTS = 160
"""Maximum number of points of the earlier surface that the registration of two surfaces uses."""
_NEIGHBORS = 8
"""Number of nearest points from which the registration of two surfaces computes a local mean and a
surface normal."""
_ITERATIONS = 4
"""Number of iterations of the registration that measures the displacement between two surfaces."""
_MAX_SPREAD_RATIO = 0.5
"""Maximum standard deviation of a registered displacement along an axis, relative to the standard
deviation of the predicted displacement that the registration assumes [-]. Above it, the velocity
along this axis counts as not measured."""
_CORRELATED_POINTS = 12.0
"""Number of neighboring points assumed to share one depth error, since camera noise is smooth over
pixels. It divides the weight of each point in the registration [-]."""
_GATE = 0.02
"""Maximum distance between corresponding points of two surfaces in the last iteration of their
registration [m]."""
_BETTER_FIT = 0.8
"""Ratio of two misfits below which a registration from the alternative start is clearly better than
that from the prediction, and is used instead [-]. The misfit of a registration is the sum of two
mean distances: from the earlier surface to the later one, and in reverse."""
_SPEED_STEP = 0.1
"""Maximum apparent speed of an obstacle due to one depth step (resolution of the camera's depth)
[m/s]. The apparent speed is the step divided by the age of the earlier frame; the velocity is not
measured until this frame is old enough."""
_CONSTANT_DEPTH = 1.2
"""Depth beyond which the standard deviation of a measured point grows with the square of the depth
[m]."""
_MAX_REFERENCE_AGE = 0.19
"""Age from which an earlier frame is used to measure the velocity of an obstacle, even if the depth
step of the camera causes a larger apparent speed than `_SPEED_STEP` [s]."""


class Reference(NamedTuple):
    """Surface of an obstacle in an earlier frame, with which a later frame is compared to measure
    the velocity.

    Attributes:
        stamp: time of the earlier frame [s].
        p_WQ: (N, 3) points of the surface in the world [m].
    """

    stamp: float
    p_WQ: FloatArray


def register_surface(
    before: FloatArray,
    now: FloatArray,
    guess: FloatArray,
    prior: float,
    deviation: float = SIDE_DEVIATION,
    alternative: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Computes the displacement between two surfaces of an obstacle by point-to-plane registration.

    Each iteration minimizes, over the displacement t,

        sum_i w_i (n_i . (q_i - p_i - t))^2 + |t - guess|^2 / prior^2

    Here p_i are local means of the earlier points, and q_i and n_i mean and normal of the nearest
    later points (Chen and Medioni 1992). The weights w_i reject edges and outliers. The iterations
    start at the guess. They converge to a wrong minimum if the guess differs from the true
    displacement by more than the width of a face of the obstacle. They are therefore repeated from
    an alternative start. The second result is used if the mean distance between the surfaces is
    then less than 0.8 times (`_BETTER_FIT`) that of the first result.

    Args:
        before, now: (N, 3) earlier and (M, 3) later surface in the world [m].
        guess: (3,) predicted displacement in the world [m].
        prior: standard deviation of each component of the guess [m].
        deviation: standard deviation of a measured point [m].
        alternative: (3,) another displacement in the world at which the iterations start [m];
            without effect within 2 cm of the guess along each axis. None: no alternative.

    Returns:
        (3,) displacement in the world [m], and (3,) its variances [m^2]. If a surface has fewer
        than 8 points (`_NEIGHBORS`): the guess, and prior^2.
    """
    if min(len(before), len(now)) < _NEIGHBORS:
        return np.array(guess), np.full(3, prior**2)
    tree, before_tree = cKDTree(now), cKDTree(before)
    sample = before[:: -(-len(before) // _MAX_SURFACE_POINTS)]
    # Means of as many points on both sides, so that a curved surface is flattened equally.
    sample = before[before_tree.query(sample, k=_NEIGHBORS)[1]].mean(axis=1)
    prior_information = np.eye(3) / prior**2

    def align(start: FloatArray) -> tuple[FloatArray, FloatArray]:
        shift, information = np.array(start, dtype=float), prior_information
        for reach in np.geomspace(
            2.0 * max(_GATE, prior), max(_GATE, 2.0 * deviation), _ITERATIONS
        ):
            distance, rows = tree.query(sample + shift, k=_NEIGHBORS, distance_upper_bound=reach)
            has_patch = np.isfinite(distance).all(axis=1)
            if not has_patch.any():
                break
            patches = now[rows[has_patch]]
            middle = patches.mean(axis=1)
            offsets = patches - middle[:, None]
            spread, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets))
            normal = axes[:, :, 0]
            gap = np.einsum("ni,ni->n", normal, middle - sample[has_patch])
            residual = np.abs(gap - normal @ shift)
            # Edges have no normal, and outliers must have no influence.
            weight = (1.0 - spread[:, 0] / np.maximum(spread[:, 1], 1e-12)) ** 2
            weight = weight / (1.0 + (residual / (3.0 * deviation)) ** 2)
            weight = weight / (_CORRELATED_POINTS * deviation**2)
            frame_information = np.einsum("n,ni,nj->ij", weight, normal, normal)
            pull = np.einsum("n,ni,n->i", weight, normal, gap) + prior_information @ guess
            shift = np.linalg.solve(frame_information + prior_information, pull)
            # Noise tilts the normals, which would pretend information along the surface.
            roughness = np.minimum(spread[:, 0] / (_NEIGHBORS - 3), deviation**2)
            tilt = weight @ (roughness / np.maximum(spread[:, 1], deviation**2))
            size, along = np.linalg.eigh(frame_information - tilt * np.eye(3))
            information = (along * np.maximum(size, 0.0)) @ along.T + prior_information
        return shift, np.diag(np.linalg.inv(information)).copy()

    def misfit(shift: FloatArray) -> float:
        distances = tree.query(sample + shift)[0], before_tree.query(now - shift)[0]
        return float(sum(np.minimum(distance, _GATE).mean() for distance in distances))

    result = align(guess)
    if alternative is not None and np.abs(alternative - guess).max() > _GATE:
        other = align(alternative)
        result = other if misfit(other[0]) < _BETTER_FIT * misfit(result[0]) else result
    return result


def depth_deviation(p_W: FloatArray, views: Sequence[View]) -> FloatArray:
    """Computes the standard deviation (M,) of the depth [m] that the nearest camera measures at
    each position p_W (M, 3) in the world [m].

    It is 1.5 mm (`SIDE_DEVIATION`), and beyond a depth of 1.2 m (`_CONSTANT_DEPTH`) it grows with
    the square of the depth. A depth step (resolution) of a structured-light camera is twice as
    large. Without `views`, for a point cloud, it is 1.5 mm.
    """
    depths = [(p_W - view.X_WC[:3, 3]) @ view.X_WC[:3, 2] for view in views]
    nearest = np.min(depths, axis=0) if depths else np.ones(len(p_W))
    return np.asarray(SIDE_DEVIATION * np.maximum(1.0, nearest / _CONSTANT_DEPTH) ** 2)


def measure_velocities(
    tracks: Tracks,
    references: dict[int, Reference],
    p_WQ: FloatArray,
    point_row: IntArray,
    cluster: IntArray,
    deviation: FloatArray,
    stamp: float,
) -> tuple[FloatArray, FloatArray, dict[int, Reference]]:
    """Measures velocities of tracks by the displacements of their surfaces since an earlier frame,
    the reference.

    The depth of a structured-light camera has steps that grow with the square of the depth. Between
    consecutive frames the depth of a distant obstacle remains within one step, as if the obstacle
    rested. The reference is therefore older: it remains, and no velocity is measured, until the
    step divided by its age is at most 0.1 m/s (`_SPEED_STEP`), or its age is `_MAX_REFERENCE_AGE`.
    Each reference is used once, so that no displacement is counted twice. The velocity of a resting
    track is measured only if its motion evidence is above `_MIN_EVIDENCE`, or the centroid of its
    points differs from that of the reference by more than `_REST_RADIUS` along an axis.

    Args:
        tracks: M predicted tracks.
        references: surface of each track in its reference frame, by track ID.
        p_WQ: (Q, 3) points of this frame in the world [m].
        point_row: (Q,) row of the track of each point.
        cluster: (Q,) index of the cluster of each point. All points of a track's clusters are
            registered, since points that belong to another track in the same cluster may be on the
            surface of this one.
        deviation: (M,) standard deviations of depth at the obstacles, from `depth_deviation` [m].
        stamp: time of the frame [s].

    Returns:
        (M, 3) velocities in the world [m/s], NaN along axes that are not measured; (M, 3) their
        variances [m^2/s^2]; and the references for the next frame, by track ID.
    """
    v_W, variance = np.full((len(tracks), 3), np.nan), np.ones((len(tracks), 3))
    new_references = {}
    for row, track_id in enumerate(tracks.ids.tolist()):
        is_own = point_row == row
        if not is_own.any():
            continue
        now = p_WQ[is_own]
        middle = now.mean(axis=0)
        reference = references.get(track_id)
        dt = np.inf if reference is None else stamp - reference.stamp
        new_references[track_id] = Reference(stamp, now)
        if reference is None or dt > MAX_GAP:
            continue
        if 2.0 * deviation[row] > _SPEED_STEP * dt and dt < _MAX_REFERENCE_AGE:
            new_references[track_id] = reference
            continue
        moved = middle - reference.p_WQ.mean(axis=0)
        is_suspect = tracks.is_moving[row] or tracks.motion_evidence[row] > _MIN_EVIDENCE
        if not is_suspect and np.abs(moved).max() <= _REST_RADIUS:
            continue
        prior = dt * INITIAL_SPEED
        surface, predicted = p_WQ[np.isin(cluster, cluster[is_own])], dt * tracks.v_W[row]
        shift, spread = register_surface(
            reference.p_WQ, surface, predicted, prior, deviation[row], moved
        )
        is_measured = spread <= (_MAX_SPREAD_RATIO * prior) ** 2
        v_W[row, is_measured], variance[row] = shift[is_measured] / dt, spread / dt**2
    return v_W, variance, new_references


_BEHIND = 0.01
"""Minimum depth difference at which an obstacle's surface, beside one of its sides, shows that the
obstacle ends at this side (end along a world axis) [m].

The difference is measured from a straight line, which extends the side outward along the axis, to
the surface behind it in the image. The value applies to an obstacle at a depth of 1 m, and grows
with the square of the depth.
"""
_STEPS = np.arange(1, 24)
"""Distances from a side (end along an axis) of an obstacle at which the image is searched for free
space [pixel]."""
_EMPTY_PIXELS = 12
"""Number of consecutive pixels without depth that count as free space beyond a side (end along an
axis) of an obstacle."""
_MIN_SINE = 0.3
"""Minimum sine of the angle between the line of sight and a world axis, at which images show where
obstacles end along that axis [-].

At smaller angles an obstacle is assumed to end at its measured side.
"""
_BACKGROUND_DEPTH = 100.0
"""Depth that replaces the infinite depth of pixels in the search for free space beside obstacles
[m]."""


def sample_surfaces(
    label: NDArray[np.int16], rows: IntArray, view: View
) -> tuple[FloatArray, FloatArray, IntArray, IntArray]:
    """Samples points on the visible surfaces of tracked obstacles in an image.

    Args:
        label: (H W,) index of the cluster of each pixel, -1: no cluster.
        rows: (C + 1,) row of the track of each cluster, -1: a cluster that is not sampled. The last
            element is -1, for pixels without a cluster.
        view: depth image.

    Returns:
        (S, 3) points in the world [m]; (S,) area of a pixel at each of them [m^2]; (S,) rows of
        their tracks; (S,) number of pixels that each point represents.
    """
    z, K, X_WC = view
    pixel = np.flatnonzero(label >= 0)
    row = rows[label[pixel]]
    step = np.maximum(np.bincount(row + 1) // _PIXELS, 1)[row + 1]
    is_used = (row >= 0) & (np.arange(len(row)) % step == 0)
    pixel = pixel[is_used]
    depth = z.ravel()[pixel].astype(float)
    p_CQ = pixel_rays(z.shape, *K.tolist())[pixel] * depth[:, None]
    points = p_CQ @ X_WC[:3, :3].T + X_WC[:3, 3]
    return points, depth * depth / (K[0] * K[1]), row[is_used], step[is_used]


def count_open_sides(
    points: FloatArray,
    row: IntArray,
    sides: FloatArray,
    label: NDArray[np.int16],
    rows: IntArray,
    view: View,
    table: TablePlane,
) -> FloatArray:
    """Counts the points at the sides of obstacles (ends along the world axes) with free space
    beyond them.

    From each point at a side, a straight line outward along the world axis is followed in the image
    until the first pixel that decides. Of several rows, the first one applies:

        pixel                                                        the obstacle
        of the obstacle, behind the line                             ends at the side
        of anything else, over 3 cm behind the point                 ends at the side
        the 12th consecutive pixel without depth                     ends at the side
        of anything else, over 3 cm before the point                 may continue
        of anything else, over 3 cm above the table                  may continue
        outside the image                                            may continue
        none of 23 pixels decides                                    may continue

    If the angle between the world axis and the line of sight to the point has a sine below 0.3
    (`_MIN_SINE`), no pixel beside the obstacle is informative; the obstacle is assumed to end
    there.

    Args:
        points: (S, 3) points of the obstacles' visible surfaces in the world [m].
        row: (S,) row of the track of each point.
        sides: (M, 3, 2) coordinate of the lowest and highest side of each track along each world
            axis [m]; points beyond it are at the side.
        label: (H W,) index of the cluster of each pixel, -1: no cluster.
        rows: (C + 1,) row of the track of each cluster, -1: a cluster whose sides are not measured.
            The last element is -1, for pixels without a cluster.
        view: depth image.
        table: support plane in the world.

    Returns:
        (2, M, 3, 2) number of points at each side with free space beyond, and of all points there.
    """
    z, K, X_WC = view
    low, high = np.moveaxis(sides[row], 2, 0)
    i, k, side = np.nonzero(np.stack([points <= low, points >= high], axis=2))
    outward = (2 * side - 1)[:, None] * np.eye(3)[k]
    sight = points[i] - X_WC[:3, 3]
    across = np.linalg.norm(np.cross(outward, sight), axis=1) / np.linalg.norm(sight, axis=1)
    depth = (sight @ X_WC[:3, 2])[:, None]
    length = _STEPS * depth / (K[0] * np.maximum(across, _MIN_SINE)[:, None])
    # Continuation of the obstacle beyond the side, relative to the camera.
    beyond = sight[:, None] + length[..., None] * outward[:, None]
    p_CQ = beyond @ X_WC[:3, :3]
    pixel = pixel_at(p_CQ, z.shape, K)
    is_inside, is_own = pixel >= 0, rows[label[pixel]] == row[i, None]
    other = np.minimum(z.ravel()[pixel], _BACKGROUND_DEPTH)
    has_depth = is_inside & (other > 0.0)
    end = np.where(is_own, p_CQ[..., 2] + _BEHIND * depth**2, depth + DEPTH_MARGIN)
    last = np.maximum.accumulate(np.where(has_depth, _STEPS, 0), axis=1)
    is_free = np.where(has_depth, other > end, is_inside & (_STEPS - last >= _EMPTY_PIXELS))
    height = table.height(X_WC[:3, 3]) + other / p_CQ[..., 2] * (beyond @ table.normal_W)
    is_before = (other < depth - DEPTH_MARGIN) | (height > DEPTH_MARGIN)
    first = (is_free | ~is_inside | (has_depth & ~is_own & is_before)).argmax(axis=1)
    # No pixel beside the obstacle is informative for a side along the line of sight.
    ends = is_free[np.arange(len(i)), first] | (across < _MIN_SINE)
    key = np.ravel_multi_index((row[i], k, side), sides.shape)
    counts = [np.bincount(key, weight, sides.size) for weight in (ends, np.ones(len(i)))]
    return np.reshape(counts, (2, *sides.shape))


_PIXELS = 800
"""Approximate number of pixels at which the surface of an obstacle is sampled in an image."""
DEPTH_MARGIN = 0.03
"""Maximum depth difference between a measured surface and a point that counts as lying on it
[m]."""
_SIDE_TAIL = 0.02
"""Fraction of an obstacle's area beyond each of its sides (robust ends along the world axes) [-].

The sides are defined by this fraction. The area is the visible or the largest earlier one,
whichever is larger.
"""
_OPEN_SHARE = 0.7
"""Minimum fraction of points with free space beyond them, among the points at a side (end along an
axis) of an obstacle [-]. With less, the obstacle may continue beyond the side."""
_MIN_AREA_SHARE = 0.15
"""Minimum visible area of an obstacle, relative to its largest visible area in earlier frames [-].
With less, the position of the obstacle is not measured."""
_GROWTH = 1.1
"""Visible area of an obstacle, relative to its largest visible area in earlier frames, above which
the obstacle counts as entering the image [-]. Its measured sides (ends along the axes) are then
uncertain."""
_GROWTH_FACTOR = 6.0
"""Factor by which the standard deviation of the measured sides (ends along the axes) increases for
an obstacle that is entering the image [-]."""
_SIDE_GRAIN = 0.7
"""Standard deviation of a measured side (end along an axis) of an obstacle due to the image's
resolution [pixel]."""
_OCCLUSION_FACTOR = 3.0
"""Relative increase of the standard deviation of an obstacle's measured sides (ends along the
axes), divided by the occluded fraction of the obstacle's area [-]."""
_SIDE_LEARNING = 0.05
"""Weight of one frame in the running mean of the distance between two opposite sides (ends along an
axis) of an obstacle [-]."""


@dataclass(frozen=True, eq=False)
class Sides:
    """Sides of M tracked obstacles in one frame: robust ends of each obstacle along the world axes.

    Beyond each side lie 2 % (`_SIDE_TAIL`) of the largest visible area of the obstacle, in this or
    earlier frames.

    Attributes:
        place: (M, 3, 2) world coordinates of the lowest and highest side along each axis [m]; NaN
            without visible points.
        ends: (M, 3, 2) whether the obstacle ends at the side; False: it may continue, occluded or
            outside the image.
        area: (M,) visible area, perpendicular to the line of sight [m^2].
        grain: (M,) width of a pixel, or of a voxel in a cloud, at the obstacle [m]; 0 without
            visible points.
    """

    place: FloatArray
    ends: BoolArray
    area: FloatArray
    grain: FloatArray


def find_sides(
    frame: Segmentation, cluster_row: IntArray, known_area: FloatArray, voxel: float
) -> Sides:
    """Finds the sides of tracked obstacles (their ends along the world axes) in all images of a
    frame.

    Args:
        frame: segmented frame; in a cloud every obstacle ends at its sides.
        cluster_row: (C,) row of the track of each cluster; -1: not measured, because the cluster
            belongs to several tracks.
        known_area: (M,) largest visible area of each track in earlier frames [m^2].
        voxel: edge length of a voxel [m], for the areas of points in a cloud.
    """
    count, rows = len(known_area), np.append(cluster_row, -1)
    parts = [
        sample_surfaces(label, rows, view)
        for label, view in zip(frame.labels, frame.views, strict=False)
    ]
    if parts:
        points, area, row, weight = (np.concatenate(column) for column in zip(*parts, strict=True))
    else:
        row = np.repeat(cluster_row, [len(cloud) for cloud in frame.clouds_W])
        points = np.concatenate([np.zeros((0, 3)), *frame.clouds_W])[row >= 0]
        row = row[row >= 0]
        area, weight = np.full(len(points), voxel**2), np.ones(len(points))
    number = np.bincount(row, minlength=count)
    grain = np.sqrt(np.bincount(row, area, minlength=count) / np.maximum(number, 1))
    area = area * weight
    visible_area = np.asarray(np.bincount(row, area, minlength=count), dtype=float)
    place = np.full((count, 3, 2), np.nan)
    for m in np.unique(row):
        is_own, tail = row == m, _SIDE_TAIL * max(visible_area[m], known_area[m])
        for k, along in enumerate(points[is_own].T):
            order = along.argsort()
            size = area[is_own][order]
            # An area `tail` lies beyond each side.
            place[m, k, 0] = np.interp(tail, size.cumsum(), along[order])
            place[m, k, 1] = np.interp(tail, size[::-1].cumsum(), along[order[::-1]])
    ends = np.isfinite(place)
    if parts:
        table = frame.table or TablePlane(offset=-np.inf)
        free, total = np.sum(
            [
                count_open_sides(part[0], part[2], place, label, rows, view, table)
                for part, label, view in zip(parts, frame.labels, frame.views, strict=True)
            ],
            axis=0,
        )
        ends = free / np.maximum(total, 1.0) >= _OPEN_SHARE
    return Sides(place, ends, visible_area, grain)


def measure_positions(
    sides: Sides, known_sides: FloatArray, known_area: FloatArray, deviation: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Computes the positions of tracked obstacles along each axis from their visible sides, and the
    variances of the positions.

    Sides are the ends of an obstacle along an axis. For a known side, earlier frames have shown at
    which distance from the position it lies. The coordinate of a visible side in this frame, minus
    this signed distance, is one measurement of the position. The position is the mean over the m
    sides (1 or 2 along each axis) that are both visible and known.

    Symbols: sigma is the standard deviation of depth, delta the width of a pixel at the obstacle,
    and rho the occluded fraction of `known_area`. The position has the variance

        (sigma^2 + (_SIDE_GRAIN delta)^2) (1 + _OCCLUSION_FACTOR rho)^2 / m

    An obstacle is entering the image if its visible area is more than `_GROWTH` times `known_area`.
    Then this variance is multiplied by the square of `_GROWTH_FACTOR`.

    Args:
        sides: sides in this frame.
        known_sides: (M, 3, 2) lowest and highest side along each world axis, relative to the
            position [m]; NaN: unknown.
        known_area: (M,) largest visible area of each track in earlier frames [m^2].
        deviation: (M,) standard deviations of depth at the obstacles, from `depth_deviation` [m].

    Returns:
        (M, 3) positions in the world [m], NaN along an axis without a visible known side, or if
        less than 15 % (`_MIN_AREA_SHARE`) of `known_area` is visible; (M, 3) variances [m^2].
    """
    position = sides.place - known_sides
    usable = sides.ends & np.isfinite(position)
    visible = sides.area / np.maximum(known_area, 1e-12)
    usable &= (visible >= _MIN_AREA_SHARE)[:, None, None]
    count = usable.sum(axis=2)
    total = np.where(usable, position, 0.0).sum(axis=2)
    occluded = np.clip(1.0 - visible, 0.0, 1.0)[:, None]
    sigma = np.hypot(deviation, _SIDE_GRAIN * sides.grain)[:, None]
    sigma = sigma * (1.0 + _OCCLUSION_FACTOR * occluded)
    sigma = np.where((visible > _GROWTH)[:, None], _GROWTH_FACTOR * sigma, sigma)
    variance = sigma**2 / np.maximum(count, 1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan), variance


def learn_sides(sides: Sides, known_sides: FloatArray, p_W: FloatArray) -> FloatArray:
    """Updates the known sides (ends along the world axes) of tracked obstacles, relative to their
    positions, by the sides in a frame.

    A side that is visible for the first time is stored. If both sides along an axis are known and
    visible, only the distance between them is averaged over frames. Their midpoint does not change
    relative to the position, so that the position does not drift.

    Args:
        sides: sides in the frame.
        known_sides: (M, 3, 2) lowest and highest side along each world axis, relative to the
            positions [m]; NaN: unknown.
        p_W: (M, 3) positions of the obstacles in the world [m].

    Returns:
        (M, 3, 2) updated known sides [m].
    """
    measured = np.where(sides.ends, sides.place - p_W[:, :, None], np.nan)
    error = measured - known_sides
    error -= error.mean(axis=2, keepdims=True)
    updated = known_sides + _SIDE_LEARNING * np.where(np.isfinite(error), error, 0.0)
    return np.where(np.isnan(known_sides), measured, updated)
