"""A constant-velocity Kalman filter for each obstacle.

The state of one axis is (position, velocity), measured by the obstacle's sides (`seen_sides`) and
by the displacement of its surface since the previous frame. Acceleration is taken as
white noise of spectral density q, so that a step of dt adds

    Q = q [[dt^3/3, dt^2/2], [dt^2/2, dt]]

(Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and
Navigation", 2001, ch. 6: continuous white noise acceleration). The axes are those of the
world. They do not mix, since what is measured of them does not.

From the filter's velocity and its significance follows whether an obstacle moves, and where to.

Where an obstacle is, measured by its sides: so that what hides a part of it does not move it.

The centroid of what is seen shifts when an arm passes before it. A side, the place
beyond which a small fixed area of the obstacle lies, does not, as long as the image
shows free space beyond it. Each side is compared with where it was before.
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
"""Standard deviation of the measured place of a side, or of a surface point [m]."""
_ACCELERATION = 0.01
"""Spectral density of the acceleration of an obstacle at rest, each axis [m^2/s^3]."""
_MANEUVER = 0.05
"""Spectral density of the acceleration of a moving obstacle, each axis [m^2/s^3]."""
_START_SPEED = 0.03
"""Speed above which an obstacle may be found to move [m/s]."""
START = 21.1
"""Speed statistic above which a velocity is significant: exceeded at rest once in 10,000 frames."""
_CERTAIN = 100.0
"""Speed statistic above which an obstacle moves at once."""
_FLOOR = 0.02
"""Speed below which a frame shows an obstacle at rest [m/s]."""
_STOP = 7.8
"""Speed statistic below which a frame shows an obstacle at rest."""
_STOP_TIME = 0.1
"""Time at rest after which an obstacle no longer moves [s]."""
_OUTLIER = 5.0
"""Standard deviations beyond which a measurement is an outlier; two in a row are a maneuver."""
_JUMP = 0.01
"""Distance at which an obstacle at rest is taken to have been moved [m]."""
_SETTLING = 0.1
"""Share of a frame in the place of an obstacle at rest."""
_STRONG_DOUBT = 0.15
"""Share of missing points with which a velocity that is only likely is believed."""
COAST_TIME = 0.5
"""Time for which a moving obstacle that is not seen keeps its velocity [s]."""
BLIND_TIME = 0.2
"""Time without a measurement along an axis after which one at rest has no velocity there [s]."""


_PATIENCE = 3
"""Weight of a frame whose velocity is significant, of one that is only likely: 1."""
_ENOUGH = 2 * _PATIENCE
"""Weight of frames after which an obstacle moves."""
_MOVED = 0.004
"""Distance from its place at rest beyond which an obstacle may move [m]."""
_DOUBTED = 0.04
"""Share of missing points above which an obstacle may move."""
LONGEST_GAP = 1.0
"""Time between frames beyond which no velocity is believed [s]."""
INITIAL_SPEED = 0.4
"""Standard deviation of the velocity of an obstacle that is seen first [m/s]."""


@dataclass(frozen=True, eq=False)
class Tracks(Frozen):
    """M obstacles, one a row.

    Attributes:
        ids: (M,) track IDs.
        state: (M, 3, 2) filtered position [m] and velocity [m/s] along each axis of the world. The
            position is that of a point fixed to the obstacle, at first its centroid.
        covariance: (M, 3, 2, 2) of the state.
        shift_W: (M, 3) from the frame O, in which its points are kept, to the world:
            p_WQ = p_OQ + shift_W [m].
        p_shift_W: (M, 3) the filter's position when it was shifted last [m].
        sides: (M, 3, 2) the lowest and highest side along the world's axes, from the
            position [m]; NaN while unknown.
        area: (M,) the largest visible area, across the line of sight [m^2].
        moving: (M,) whether it moves.
        motion_evidence: (M,) recent maximum of the share of its visible part that was not where it was
            remembered.
        significant: (M,) frames in a row whose velocity was significant, each counted
            `_PATIENCE` times, and once where it was only likely.
        still: (M,) time since its velocity was significant [s].
        unmeasured_time: (M, 3) time since it was measured along each axis of the world [s].
        odd: (M, 3) whether the last measurement along each axis was an outlier.
        apart: (M,) frames in a row in which it was seen in parts.
        sync_tolerance: (M,) time as one cluster with a larger obstacle [s].
    """

    ids: IntArray = zeros(0, kind=np.int64)
    state: FloatArray = zeros(0, 3, 2)
    covariance: FloatArray = zeros(0, 3, 2, 2)
    shift_W: FloatArray = zeros(0, 3)
    p_shift_W: FloatArray = zeros(0, 3)
    sides: FloatArray = zeros(0, 3, 2)
    area: FloatArray = zeros(0)
    moving: BoolArray = zeros(0, kind=bool)
    motion_evidence: FloatArray = zeros(0)
    significant: IntArray = zeros(0, kind=np.int64)
    still: FloatArray = zeros(0)
    unmeasured_time: FloatArray = zeros(0, 3)
    odd: BoolArray = zeros(0, 3, kind=bool)
    apart: IntArray = zeros(0, kind=np.int64)
    sync_tolerance: FloatArray = zeros(0)

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def p_W(self) -> FloatArray:
        """(M, 3) positions [m]."""
        return self.state[..., 0]

    @property
    def v_W(self) -> FloatArray:
        """(M, 3) velocities [m/s]."""
        return self.state[..., 1]


def new_tracks(p_W: FloatArray) -> Tracks:
    """Makes obstacles at p_W (M, 3) [m] that are seen first: at rest, without a name and sides."""
    parts = {
        name: np.zeros((len(p_W), *part.shape[1:]), dtype=part.dtype)
        for name, part in vars(Tracks()).items()
    }
    parts["state"][..., 0], parts["covariance"][:], parts["sides"][:] = (
        p_W,
        _FIRST_COVARIANCE,
        np.nan,
    )
    return Tracks(**parts | {"p_shift_W": p_W})


_FIRST_COVARIANCE = np.diag([SIDE_DEVIATION**2, INITIAL_SPEED**2])


def corrected(tracks: Tracks, kind: int, measured: FloatArray, variance: FloatArray) -> Tracks:
    """Corrects the states by measured positions (kind 0) or velocities (kind 1).

    Args:
        tracks: as predicted.
        kind: column of the state.
        measured: (M, 3) [m or m/s]; NaN where there is none.
        variance: (M, 3) of the measurement.
    """
    P, known = tracks.covariance, np.isfinite(measured)
    innovation = np.where(known, measured - tracks.state[..., kind], 0.0)
    gain = P[..., kind] / (P[..., kind, kind] + variance)[..., None] * known[..., None]
    return replace(
        tracks,
        state=tracks.state + gain * innovation[..., None],
        covariance=P - gain[..., None] * P[..., kind, None, :],
    )


def speed_statistic(tracks: Tracks) -> FloatArray:
    """(M,) v^T P_v^-1 v: chi-square of 3 degrees of freedom for an obstacle at rest."""
    return np.asarray((tracks.v_W**2 / tracks.covariance[..., 1, 1]).sum(axis=1))


_SHRINKING = 0.99  # of the area of an obstacle that is seen whole, a frame


def predicted_tracks(tracks: Tracks, dt: float) -> Tracks:
    """Predicts obstacles dt [s] >= 0 later; those that move take their points along.

    One that was not measured for `COAST_TIME` stops where it is then, and
    all do after a gap of `LONGEST_GAP`.
    """
    gap = dt > LONGEST_GAP
    moving = tracks.moving & (tracks.unmeasured_time.min(axis=1) + dt <= COAST_TIME) & (not gap)
    lost = (tracks.moving & ~moving) | gap
    P = np.where(lost[:, None, None, None], _FIRST_COVARIANCE, tracks.covariance)
    # Where it does not move significantly, noise must not carry it away while hidden.
    hidden = (tracks.unmeasured_time > BLIND_TIME) | lost[:, None]
    state = np.array(tracks.state)
    state[..., 1][~moving[:, None] & hidden] = 0.0
    dt = min(dt, LONGEST_GAP)
    F = np.array([[1.0, dt], [0.0, 1.0]])
    Q = np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])
    q = np.where(moving, _MANEUVER, _ACCELERATION)[:, None, None, None]
    state = state @ F.T
    step = np.where(moving[:, None], state[..., 0] - tracks.p_shift_W, 0.0)
    return replace(
        tracks,
        state=state,
        covariance=F @ P @ F.T + q * Q,
        shift_W=tracks.shift_W + step,
        p_shift_W=tracks.p_shift_W + step,
        moving=moving,
    )


def measured_tracks(
    tracks: Tracks,
    seen: SeenSides,
    deviation: FloatArray,
    v_W: FloatArray,
    spread: FloatArray,
    dt: float,
) -> Tracks:
    """Corrects obstacles by a frame, dt [s] after the one before.

    An outlier is left out. Two in a row are a maneuver: the position is as uncertain as the jump,
    and the velocity, unless it is measured too, as at first.

    Args:
        tracks: as predicted.
        seen: their sides in it.
        deviation: (M,) from `depth_deviation` [m].
        v_W: (M, 3) measured velocities of their surfaces [m/s]; NaN where nothing tells.
        spread: (M, 3) their variances [m^2/s^2].
        dt: see there.
    """
    p_W, variance = measured_position(seen, tracks.sides, tracks.area, deviation)
    registered, known_sides = np.isfinite(v_W), tracks.sides
    tracks = corrected(tracks, 1, v_W, spread)
    jump = np.where(np.isfinite(p_W), p_W - tracks.p_W, 0.0)
    off = jump**2 > _OUTLIER**2 * (tracks.covariance[..., 0, 0] + variance)
    again = off & tracks.odd
    if again.any():
        P = np.array(tracks.covariance)
        P[again, 0, 0] += jump[again] ** 2
        P[again, 0, 1] = P[again, 1, 0] = 0.0
        P[again & ~registered, 1, 1] = INITIAL_SPEED**2
        tracks = replace(tracks, covariance=P)
    p_W = np.where(off & ~again, np.nan, p_W)
    told = np.isfinite(p_W) | registered
    tracks = corrected(tracks, 0, p_W, variance)
    whole = seen.ends.all(axis=(1, 2))
    learned = learned_sides(seen, known_sides, tracks.p_W)
    tracks = replace(
        tracks,
        sides=np.where(off[:, :, None], known_sides, learned),
        area=np.maximum(seen.area, np.where(whole, _SHRINKING, 1.0) * tracks.area),
        unmeasured_time=np.where(told, 0.0, tracks.unmeasured_time + dt),
        odd=off,
    )
    measured, found = np.asarray(told.any(axis=1)), np.asarray(registered.any(axis=1))
    return _decided(tracks, measured, found, dt)


def _decided(tracks: Tracks, measured: BoolArray, registered: BoolArray, dt: float) -> Tracks:
    """Decides which obstacles move, and shifts the points of those that do."""
    statistic, speed = speed_statistic(tracks), np.linalg.norm(tracks.v_W, axis=1)
    away = tracks.p_W - tracks.p_shift_W
    doubted = tracks.moving | registered | (tracks.motion_evidence > _DOUBTED)
    fast = (speed > _START_SPEED) & measured
    distant = np.linalg.norm(away, axis=1) > _MOVED
    starts = (statistic > START) & fast & (tracks.moving | (doubted & distant))
    likely = (statistic > _STOP) & fast & (tracks.motion_evidence > _STRONG_DOUBT)
    at_once = registered & (statistic > _CERTAIN)
    count = tracks.significant + np.where(starts, np.where(at_once, _ENOUGH, _PATIENCE), 1)
    # Distant obstacles are not measured in each frame.
    significant = np.where(measured, np.where(starts | likely, count, 0), tracks.significant)
    calm = (statistic < _STOP) | (speed < _FLOOR)
    still = np.where(calm, tracks.still + dt, 0.0)
    moving = (tracks.moving | (significant >= _ENOUGH)) & (still < _STOP_TIME)
    # What is at rest is found elsewhere only along what was measured.
    found = np.where(moving[:, None] | (tracks.unmeasured_time == 0.0), away, 0.0)
    jumped = doubted & (np.linalg.norm(found, axis=1) > _JUMP)
    follows = measured & (moving | jumped)
    step = np.where(follows[:, None], found, 0.0)
    settling = np.where((measured & ~follows)[:, None], _SETTLING * away, 0.0)
    return replace(
        tracks,
        moving=moving,
        significant=significant,
        still=still,
        shift_W=tracks.shift_W + step,
        p_shift_W=tracks.p_shift_W + step + settling,
    )


_MOST = 160
"""Points of a surface that are looked at."""
_NEIGHBORS = 8
"""Points that a normal is of."""
_ROUNDS = 4
_TELLS = 0.5
"""An axis is measured whose deviation is less than this share of what was unknown."""
_TOGETHER = 12.0
"""Points that have the same noise: it is smooth over pixels."""
_GATE = 0.02
"""Distance between points of two frames beyond which they are not the same [m]."""
_SPEED_STEP = 0.1
"""Speed at which an obstacle crosses a depth step within the age of its reference [m/s]."""
_NEAR = 1.2
"""Depth from which the deviation of a point grows with the square of its depth [m]."""
_LONGEST_AGE = 0.19
"""Age above which a reference is used though it resolves less [s]."""


class Reference(NamedTuple):
    """Surface of an obstacle in an earlier frame.

    Attributes:
        stamp: time of that frame [s].
        p_WQ: (N, 3) points of the surface [m].
    """

    stamp: float
    p_WQ: FloatArray


def registered(
    before: FloatArray,
    now: FloatArray,
    guess: FloatArray,
    prior: float,
    deviation: float = SIDE_DEVIATION,
) -> tuple[FloatArray, FloatArray]:
    """The shift from one frame's points (N, 3) to those of a later one (M, 3).

    Args:
        before, now: surfaces in the world [m]; a few points at least.
        guess: (3,) the shift that is expected [m].
        prior: how far off the guess may be, a standard deviation [m].
        deviation: standard deviation of a point [m].

    Returns:
        (3,) the shift [m], and its variances (3,) [m^2]; those of the prior where nothing tells.
    """
    if min(len(before), len(now)) < _NEIGHBORS:
        return np.array(guess), np.full(3, prior**2)
    tree, own = cKDTree(now), cKDTree(before)
    moving = before[:: -(-len(before) // _MOST)]
    # Means of as many points as those that they are laid on: a bent surface is flattened alike.
    moving = before[own.query(moving, k=_NEIGHBORS)[1]].mean(axis=1)
    shift, weak = np.array(guess, dtype=float), np.eye(3) / prior**2
    information = weak
    for reach in np.geomspace(2.0 * max(_GATE, prior), max(_GATE, 2.0 * deviation), _ROUNDS):
        distance, rows = tree.query(moving + shift, k=_NEIGHBORS, distance_upper_bound=reach)
        # Where a whole neighborhood is there.
        there = np.isfinite(distance).all(axis=1)
        if not there.any():
            break
        patches = now[rows[there]]
        middle = patches.mean(axis=1)
        apart = patches - middle[:, None]
        spread, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", apart, apart))
        normal = axes[:, :, 0]
        left = np.einsum("ni,ni->n", normal, middle - moving[there])
        off = np.abs(left - normal @ shift)
        # Edges have no normal, and outliers no say.
        weight = (1.0 - spread[:, 0] / np.maximum(spread[:, 1], 1e-12)) ** 2
        weight = weight / (1.0 + (off / (3.0 * deviation)) ** 2) / (_TOGETHER * deviation**2)
        told = np.einsum("n,ni,nj->ij", weight, normal, normal)
        pull = np.einsum("n,ni,n->i", weight, normal, left) + weak @ guess
        shift = np.linalg.solve(told + weak, pull)
        # A normal that noise has tilted seems to tell of what is along its surface.
        rough = np.minimum(spread[:, 0] / (_NEIGHBORS - 3), deviation**2)
        tilted = weight @ (rough / np.maximum(spread[:, 1], deviation**2))
        size, along = np.linalg.eigh(told - tilted * np.eye(3))
        information = (along * np.maximum(size, 0.0)) @ along.T + weak
    return shift, np.diag(np.linalg.inv(information)).copy()


def depth_deviation(p_W: FloatArray, views: Sequence[View]) -> FloatArray:
    """Standard deviations (M,) of the depth at places p_W (M, 3), as the nearest camera has it [m].

    Beyond `_NEAR` it grows with the square of the depth; a step of the depth is twice as large.
    """
    depths = [(p_W - view.X_WC[:3, 3]) @ view.X_WC[:3, 2] for view in views]
    nearest = np.min(depths, axis=0) if depths else np.ones(len(p_W))
    return np.asarray(SIDE_DEVIATION * np.maximum(1.0, nearest / _NEAR) ** 2)


def registered_tracks(
    tracks: Tracks,
    references: dict[int, Reference],
    seen: FloatArray,
    point_row: IntArray,
    cluster: IntArray,
    deviation: FloatArray,
    stamp: float,
) -> tuple[FloatArray, FloatArray, dict[int, Reference]]:
    """Velocities of obstacles by the shifts of their surfaces since their reference frames.

    The depth of a structured-light camera comes in steps that grow with its square. From one frame
    to the next a distant obstacle seems to rest while its depth stays within a step. A
    reference is therefore kept until a step is less than `_SPEED_STEP` times its age, and used
    once, so that no displacement is counted twice.

    Args:
        tracks: the M obstacles, as predicted.
        references: earlier surfaces, by name.
        seen: (Q, 3) points of this frame [m].
        point_row: (Q,) their obstacles.
        cluster: (Q,) their clusters: what an obstacle has become one cluster with may show its
            surface too.
        deviation: (M,) from `depth_deviation` [m].
        stamp: time of the frame [s].

    Returns:
        (M, 3) velocities [m/s], NaN where nothing tells, their variances (M, 3) [m^2/s^2], and
        the references of the next frame.
    """
    v_W, variance = np.full((len(tracks), 3), np.nan), np.ones((len(tracks), 3))
    kept = {}
    for row, name in enumerate(tracks.ids.tolist()):
        mine = point_row == row
        if not mine.any():
            continue
        now = seen[mine]
        middle = now.mean(axis=0)
        then = references.get(name)
        dt = np.inf if then is None else stamp - then.stamp
        if then is None or dt > LONGEST_GAP:
            kept[name] = Reference(stamp, now)
            continue
        if 2.0 * deviation[row] > _SPEED_STEP * dt and dt < _LONGEST_AGE:
            kept[name] = then
            continue
        kept[name] = Reference(stamp, now)
        moved = np.abs(middle - then.p_WQ.mean(axis=0)).max() > _MOVED
        if not (moved or tracks.moving[row] or tracks.motion_evidence[row] > _DOUBTED):
            continue
        unknown = dt * INITIAL_SPEED
        shift, spread = registered(
            then.p_WQ,
            seen[np.isin(cluster, cluster[mine])],
            dt * tracks.v_W[row],
            unknown,
            deviation[row],
        )
        tells = spread <= (_TELLS * unknown) ** 2
        v_W[row, tells], variance[row] = shift[tells] / dt, spread / dt**2
    return v_W, variance, kept


_BEHIND = 0.01
"""Depth difference between an obstacle's surface and its continuation beyond a side, at 1 m [m]."""
_STEPS = np.arange(1, 24)
"""Steps along which the surroundings of an obstacle's side are looked at [pixel]."""
_EMPTY = 12
"""Number of pixels without depth in a row that show that nothing is beside an obstacle."""
_ACROSS = 0.3
"""Minimum sine of the angle between a side's axis and the line of sight."""
_FARTHEST = 100.0
"""Depth of pixels that show a background too far to be measured [m]."""


def surfaces(
    label: NDArray[np.int16], rows: IntArray, view: View
) -> tuple[FloatArray, FloatArray, IntArray, IntArray]:
    """Samples the surfaces of obstacles in an image.

    Args:
        label: (H W,) cluster of each pixel, -1: none.
        rows: (C + 1,) obstacle of each cluster, -1: not asked for, and -1 at last.
        view: the depth image.

    Returns:
        The points (S, 3) in the world frame [m]; the area (S,) that a pixel covers at
        each of them [m^2]; their obstacles (S,); for how many pixels each stands (S,).
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


def open_sides(
    points: FloatArray,
    row: IntArray,
    sides: FloatArray,
    label: NDArray[np.int16],
    rows: IntArray,
    view: View,
    table: TablePlane,
) -> FloatArray:
    """Counts the points at the sides of obstacles with free space beyond them.

    From each point of a side the image is followed outward until it shows something
    else: what lies behind shows where the obstacle ends; what lies before it, what stands
    beside it (the robot, another obstacle), or the image's border, does not. Where nothing
    at all is shown for long, the background is too far away to be measured. The obstacle itself
    shows its end too, where it lies behind what it would have beyond the side.

    Args:
        points: (S, 3) in the world frame [m].
        row: (S,) obstacle of each.
        sides: (M, 3, 2) lowest and highest place of each obstacle along each axis [m].
        label, rows, view: as of `surfaces`.
        table: in the world.

    Returns:
        (2, M, 3, 2) how many do, and of how many.
    """
    z, K, X_WC = view
    low, high = np.moveaxis(sides[row], 2, 0)
    i, k, side = np.nonzero(np.stack([points <= low, points >= high], axis=2))
    outward = (2 * side - 1)[:, None] * np.eye(3)[k]
    sight = points[i] - X_WC[:3, 3]
    across = np.linalg.norm(np.cross(outward, sight), axis=1) / np.linalg.norm(sight, axis=1)
    depth = (sight @ X_WC[:3, 2])[:, None]
    length = _STEPS * depth / (K[0] * np.maximum(across, _ACROSS)[:, None])
    # Where the obstacle would be if it went on beyond the side, from the camera.
    beyond = sight[:, None] + length[..., None] * outward[:, None]
    p_CQ = beyond @ X_WC[:3, :3]
    pixel = pixel_at(p_CQ, z.shape, K)
    is_inside, is_own = pixel >= 0, rows[label[pixel]] == row[i, None]
    other = np.minimum(z.ravel()[pixel], _FARTHEST)
    is_told = is_inside & (other > 0.0)
    end = np.where(is_own, p_CQ[..., 2] + _BEHIND * depth**2, depth + DEPTH_MARGIN)
    last = np.maximum.accumulate(np.where(is_told, _STEPS, 0), axis=1)
    is_free = np.where(is_told, other > end, is_inside & (_STEPS - last >= _EMPTY))
    height = table.height(X_WC[:3, 3]) + other / p_CQ[..., 2] * (beyond @ table.normal_W)
    is_before = (other < depth - DEPTH_MARGIN) | (height > DEPTH_MARGIN)
    first = (is_free | ~is_inside | (is_told & ~is_own & is_before)).argmax(axis=1)
    # Along the line of sight nothing beside it tells.
    ends = is_free[np.arange(len(i)), first] | (across < _ACROSS)
    key = np.ravel_multi_index((row[i], k, side), sides.shape)
    counts = [np.bincount(key, weight, sides.size) for weight in (ends, np.ones(len(i)))]
    return np.reshape(counts, (2, *sides.shape))


_PIXELS = 800  # about how many pixels of a cluster are looked at
DEPTH_MARGIN = 0.03
"""Depth difference that tells what is before or behind a surface from what is on it [m]."""
_SIDE_TAIL = 0.02
"""Share of an obstacle's area that lies beyond its side."""
_OPEN_SHARE = 0.7
"""Share of the surroundings of a side that must be free for the obstacle to end there."""
_LEAST_AREA = 0.15
"""Share of the known area that must be seen for an obstacle to be measured by its sides."""
_WIDENED = 1.1
"""Ratio of seen to known area above which an obstacle is coming into view."""
_WIDENED_FACTOR = 6.0
"""Factor of the deviation of sides of an obstacle that is coming into view."""
_SIDE_GRAIN = 0.7
"""Standard deviation of a side [pixel]."""
_HIDDEN_FACTOR = 3.0
"""Relative growth of the deviation of a side of an obstacle that is all occluded."""
_SIDE_LEARNING = 0.05
"""Share of a frame in the remembered distance between two sides."""


@dataclass(frozen=True, eq=False)
class SeenSides:
    """Sides of M obstacles in one frame.

    Attributes:
        place: (M, 3, 2) lowest and highest along each axis of the world [m]; NaN where
            nothing of an obstacle is seen.
        ends: (M, 3, 2) whether the obstacle ends there.
        area: (M,) what is seen of it, across the line of sight [m^2].
        grain: (M,) width of a pixel, or a voxel, there [m]; 0 where nothing is seen.
    """

    place: FloatArray
    ends: BoolArray
    area: FloatArray
    grain: FloatArray


def seen_sides(
    frame: Segmentation,
    cluster_row: IntArray,
    known_area: FloatArray,
    voxel: float,
) -> SeenSides:
    """Finds the sides in a frame: those of all that its images show.

    Args:
        frame: the frame, segmented; of a cloud every side is taken to be seen.
        cluster_row: (C,) obstacle of each cluster, -1: not to be measured.
        known_area: (M,) largest area seen of each obstacle before [m^2].
        voxel: edge of a voxel, for clouds [m].
    """
    count, rows = len(known_area), np.append(cluster_row, -1)
    parts = [
        surfaces(label, rows, view) for label, view in zip(frame.labels, frame.views, strict=False)
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
    seen = np.asarray(np.bincount(row, area, minlength=count), dtype=float)
    place = np.full((count, 3, 2), np.nan)
    for m in np.unique(row):
        mine, tail = row == m, _SIDE_TAIL * max(seen[m], known_area[m])
        for k, along in enumerate(points[mine].T):
            order = along.argsort()
            size = area[mine][order]
            # Beyond each side lies an area of `tail`.
            place[m, k, 0] = np.interp(tail, size.cumsum(), along[order])
            place[m, k, 1] = np.interp(tail, size[::-1].cumsum(), along[order[::-1]])
    ends = np.isfinite(place)
    if parts:
        table = frame.table or TablePlane(offset=-np.inf)
        free, requested = np.sum(
            [
                open_sides(part[0], part[2], place, label, rows, view, table)
                for part, label, view in zip(parts, frame.labels, frame.views, strict=True)
            ],
            axis=0,
        )
        ends = free / np.maximum(requested, 1.0) >= _OPEN_SHARE
    return SeenSides(place, ends, seen, grain)


def measured_position(
    seen: SeenSides, sides: FloatArray, known_area: FloatArray, deviation: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Positions (M, 3) of obstacles by their sides [m], and their variances [m^2].

    Args:
        seen: the sides in this frame.
        sides: (M, 3, 2) where they were, from the position [m]; NaN: unknown.
        known_area: (M,) largest area seen of each before [m^2].
        deviation: (M,) from `depth_deviation` [m].

    Returns:
        The positions, NaN along an axis of which no known side is seen.
    """
    position = seen.place - sides
    usable = seen.ends & np.isfinite(position)
    share = seen.area / np.maximum(known_area, 1e-12)
    usable &= (share >= _LEAST_AREA)[:, None, None]
    count = usable.sum(axis=2)
    total = np.where(usable, position, 0.0).sum(axis=2)
    hidden = np.clip(1.0 - share, 0.0, 1.0)[:, None]
    wide = np.hypot(deviation, _SIDE_GRAIN * seen.grain)[:, None]
    wide = wide * (1.0 + _HIDDEN_FACTOR * hidden)
    wide = np.where((share > _WIDENED)[:, None], _WIDENED_FACTOR * wide, wide)
    variance = wide**2 / np.maximum(count, 1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan), variance


def learned_sides(seen: SeenSides, sides: FloatArray, p_W: FloatArray) -> FloatArray:
    """The sides (M, 3, 2) from the position p_W (M, 3), after this frame [m].

    A side that is seen for the first time is placed; of two that are known only the
    distance is learned, a share of it a frame: it must not move the position.
    """
    found = np.where(seen.ends, seen.place - p_W[:, :, None], np.nan)
    error = found - sides
    error -= error.mean(axis=2, keepdims=True)
    learned = sides + _SIDE_LEARNING * np.where(np.isfinite(error), error, 0.0)
    return np.where(np.isnan(sides), found, learned)
