"""A constant-velocity Kalman filter for each obstacle.

The state of one axis is (position, velocity), measured by the obstacle's sides (`sides`) and
by the displacement of its surface since the previous frame. Acceleration is taken as
white noise of spectral density q, so that a step of dt adds

    Q = q [[dt^3/3, dt^2/2], [dt^2/2, dt]]

(Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and
Navigation", 2001, ch. 6: continuous white noise acceleration). The axes are those of the
world. They do not mix, since what is measured of them does not.

From the filter's velocity and its significance follows whether an obstacle moves, and where to.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from drake_oa.common.messages import BoolArray, FloatArray, IntArray
from drake_oa.perception.memory import (
    DOUBTED,
    INITIAL_SPEED,
    LONGEST_GAP,
    MOVED,
    PATIENCE,
    MotionEstimate,
    Tracks,
    changed,
)
from drake_oa.perception.sides import (
    SIDE_DEVIATION,
    SeenSides,
    learned_sides,
    measured_position,
)

_ACCELERATION = 0.01
"""Spectral density of the acceleration of an obstacle at rest, each axis [m^2/s^3]."""
_MANEUVER = 0.05
"""Spectral density of the acceleration of a moving obstacle, each axis [m^2/s^3]."""
_LARGEST_SPEED = 2.0
"""Largest deviation of a velocity that has become unknown again [m/s]."""
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
_START_FRAMES = 2
"""Significant frames in a row after which an obstacle moves."""
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


def first_seen(p_W: FloatArray) -> MotionEstimate:
    """Obstacles at p_W (M, 3) [m] of unknown velocity."""
    shape = p_W.shape
    return MotionEstimate(
        p_W,
        np.zeros(shape),
        np.full(shape, SIDE_DEVIATION**2),
        np.zeros(shape),
        np.full(shape, INITIAL_SPEED**2),
    )


def predicted(estimate: MotionEstimate, dt: float, q: FloatArray | float) -> MotionEstimate:
    """The estimate dt [s] >= 0 later, for accelerations of the densities q (M, 1) [m^2/s^3]."""
    return MotionEstimate(
        estimate.p_W + dt * estimate.v_W,
        estimate.v_W,
        estimate.var_p + dt * (2.0 * estimate.cov_pv + dt * estimate.var_v) + q * dt**3 / 3.0,
        estimate.cov_pv + dt * estimate.var_v + q * dt**2 / 2.0,
        estimate.var_v + q * dt,
    )


def corrected(estimate: MotionEstimate, p_W: FloatArray, variance: FloatArray) -> MotionEstimate:
    """The estimate after a measurement.

    Args:
        estimate: the prediction.
        p_W: (M, 3) measured positions [m]; NaN where there is none.
        variance: (M, 3) of the measurement [m^2].
    """
    known = np.isfinite(p_W)
    innovation = np.where(known, p_W - estimate.p_W, 0.0)
    total = estimate.var_p + variance
    gain_p = np.where(known, estimate.var_p / total, 0.0)
    gain_v = np.where(known, estimate.cov_pv / total, 0.0)
    return MotionEstimate(
        estimate.p_W + gain_p * innovation,
        estimate.v_W + gain_v * innovation,
        (1.0 - gain_p) * estimate.var_p,
        (1.0 - gain_p) * estimate.cov_pv,
        estimate.var_v - gain_v * estimate.cov_pv,
    )


def led(
    estimate: MotionEstimate, shift: FloatArray, variance: FloatArray, dt: float
) -> MotionEstimate:
    """The estimate after a measured shift since dt [s] ago.

    Args:
        estimate: the prediction.
        shift: (M, 3) [m]; NaN where none was measured.
        variance: (M, 3) of it [m^2].
        dt: > 0.
    """
    known = np.isfinite(shift)
    innovation = np.where(known, shift / dt - estimate.v_W, 0.0)
    total = estimate.var_v + variance / dt**2
    gain_p = np.where(known, estimate.cov_pv / total, 0.0)
    gain_v = np.where(known, estimate.var_v / total, 0.0)
    return MotionEstimate(
        estimate.p_W + gain_p * innovation,
        estimate.v_W + gain_v * innovation,
        estimate.var_p - gain_p * estimate.cov_pv,
        (1.0 - gain_v) * estimate.cov_pv,
        (1.0 - gain_v) * estimate.var_v,
    )


def is_outlier(estimate: MotionEstimate, p_W: FloatArray, variance: FloatArray) -> BoolArray:
    """(M, 3) whether a measurement is farther off along an axis than noise explains.

    Args:
        estimate: the prediction.
        p_W: (M, 3) measured positions [m]; NaN where there is none.
        variance: (M, 3) of the measurement [m^2].
    """
    innovation = np.where(np.isfinite(p_W), p_W - estimate.p_W, 0.0)
    limit = _OUTLIER**2 * (estimate.var_p + variance)
    return np.asarray(innovation**2 > limit)


def unsettled(
    estimate: MotionEstimate,
    which: BoolArray,
    registered: BoolArray,
    p_W: FloatArray,
    dt: float,
) -> MotionEstimate:
    """Forgets how well some obstacles (M,) are known: they do what was not expected.

    The measured jump is what the position may be off. The velocity is as open as at first,
    or half the jump's speed if that is more, up to 2 m/s, unless it was measured too.

    Args:
        estimate: the prediction.
        which: (M, 3) of which obstacles, and along which axes; the others stay as they are.
        registered: (M, 3) whether the velocity was measured.
        p_W: (M, 3) measured positions [m]; NaN where there is none.
        dt: time since the last frame [s].
    """
    jump = np.where(np.isfinite(p_W), p_W - estimate.p_W, 0.0)
    speed = np.maximum(INITIAL_SPEED, np.abs(jump) / max(dt, 1e-3) * 0.5)
    speed = np.minimum(speed, _LARGEST_SPEED)
    return replace(
        estimate,
        var_p=np.where(which, estimate.var_p + jump**2, estimate.var_p),
        cov_pv=np.where(which, 0.0, estimate.cov_pv),
        var_v=np.where(which & ~registered, speed**2, estimate.var_v),
    )


def speed_statistic(estimate: MotionEstimate) -> FloatArray:
    """(M,) v^T P_v^-1 v: chi-square of 3 degrees of freedom for an obstacle at rest."""
    return np.asarray((estimate.v_W**2 / estimate.var_v).sum(axis=1))


_SHRINKING = 0.99  # of the area of an obstacle that is seen whole, a frame


def predicted_tracks(tracks: Tracks, dt: float) -> Tracks:
    """Obstacles dt [s] >= 0 later; those that move take their points along.

    One that was not measured for `COAST_TIME` stops where it is then, and
    all do after a gap of `LONGEST_GAP`.
    """
    gap = dt > LONGEST_GAP
    moving = tracks.moving & (tracks.unseen + dt <= COAST_TIME) & (not gap)
    estimate = tracks.estimate
    lost = (tracks.moving & ~moving) | gap
    if lost.any():
        # Nothing is known of what it did meanwhile.
        rest = first_seen(estimate.p_W)
        parts = {
            name: np.where(lost[:, None], getattr(rest, name), getattr(estimate, name))
            for name in ("v_W", "var_p", "cov_pv", "var_v")
        }
        estimate = MotionEstimate(estimate.p_W, **parts)
    # Where it does not move significantly, noise must not carry it away while hidden.
    hidden = (tracks.unseen > 0.0)[:, None] | (tracks.blind > BLIND_TIME)
    still = ~moving[:, None] & hidden
    estimate = changed(estimate, v_W=np.where(still, 0.0, estimate.v_W))
    noise = np.where(moving, _MANEUVER, _ACCELERATION)
    estimate = predicted(estimate, min(dt, LONGEST_GAP), noise[:, None])
    step = np.where(moving[:, None], estimate.p_W - tracks.p_shift_W, 0.0)
    return changed(
        tracks,
        estimate=estimate,
        shift_W=tracks.shift_W + step,
        p_shift_W=tracks.p_shift_W + step,
        moving=moving,
    )


def measured_tracks(
    tracks: Tracks,
    seen: SeenSides,
    shift: FloatArray,
    spread: FloatArray,
    dt: float,
) -> Tracks:
    """Obstacles after a frame, dt [s] after the one before.

    Args:
        tracks: as predicted.
        seen: their sides in it.
        shift: (M, 3) how far their surfaces have gone since [m]; NaN where nothing tells.
        spread: (M, 3) its variances [m^2].
        dt: see there.
    """
    p_W, variance = measured_position(seen, tracks.sides, tracks.area)
    estimate, registered = tracks.estimate, np.isfinite(shift)
    if registered.any():
        estimate = led(estimate, shift, spread, dt)
    off = is_outlier(estimate, p_W, variance)
    again = off & (tracks.odd > 0)
    if again.any():
        estimate = unsettled(estimate, again, registered, p_W, dt)
    p_W = np.where(off & ~again, np.nan, p_W)
    told = np.isfinite(p_W) | registered
    measured: BoolArray = np.asarray(told.any(axis=1))
    estimate = corrected(estimate, p_W, variance)
    whole = seen.ends.all(axis=(1, 2))
    learned = learned_sides(seen, tracks.sides, estimate.p_W)
    return _decided(
        changed(
            tracks,
            estimate=estimate,
            sides=np.where(off[:, :, None], tracks.sides, learned),
            area=np.maximum(seen.area, np.where(whole, _SHRINKING, 1.0) * tracks.area),
            unseen=np.where(measured, 0.0, tracks.unseen + dt),
            blind=np.where(told, 0.0, tracks.blind + dt),
            odd=np.where(off, tracks.odd + 1, 0),
            age=tracks.age + dt,
        ),
        measured,
        np.asarray(registered.any(axis=1)),
        dt,
    )


def with_motion_of(tracks: Tracks, row: int, other: int) -> Tracks:
    """The obstacles, of which one has been found to move as another does."""
    source = np.arange(len(tracks))
    source[row] = other
    estimate = tracks.estimate
    estimate = changed(
        estimate,
        v_W=estimate.v_W[source],
        var_v=estimate.var_v[source],
        cov_pv=np.where((source != np.arange(len(tracks)))[:, None], 0.0, estimate.cov_pv),
    )
    names = "moving", "significant", "still", "blind"
    parts = {name: getattr(tracks, name)[source] for name in names}
    return changed(tracks, estimate=estimate, **parts)


def _decided(tracks: Tracks, measured: BoolArray, registered: BoolArray, dt: float) -> Tracks:
    """Decides which obstacles move, and shifts the points of those that do."""
    estimate = tracks.estimate
    statistic = speed_statistic(estimate)
    speed = _lengths(estimate.v_W)
    away = estimate.p_W - tracks.p_shift_W
    distance = _lengths(away)
    doubted = tracks.moving | registered | (tracks.doubt > DOUBTED)
    fast = (speed > _START_SPEED) & measured
    starts = (statistic > START) & fast
    starts &= tracks.moving | (doubted & (distance > MOVED))
    likely = (statistic > _STOP) & fast & (tracks.doubt > _STRONG_DOUBT)
    enough = _START_FRAMES * PATIENCE
    at_once = registered & (statistic > _CERTAIN)
    count = tracks.significant + np.where(starts, np.where(at_once, enough, PATIENCE), 1)
    significant = np.where(starts | likely, count, 0)
    calm = (statistic < _STOP) | (speed < _FLOOR)
    still = np.where(calm, tracks.still + dt, 0.0)
    moving = tracks.moving | (significant >= enough)
    moving &= still < _STOP_TIME
    # What is at rest is found elsewhere only along what was measured.
    found = np.where(moving[:, None] | (tracks.blind == 0.0), away, 0.0)
    follows = measured & (moving | (doubted & (_lengths(found) > _JUMP)))
    step = np.where(follows[:, None], found, 0.0)
    settling = np.where((measured & ~follows)[:, None], _SETTLING * away, 0.0)
    return changed(
        tracks,
        moving=moving,
        significant=significant,
        still=still,
        shift_W=tracks.shift_W + step,
        p_shift_W=tracks.p_shift_W + step + settling,
    )


def _lengths(vectors: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt((vectors * vectors).sum(axis=1)))


_MOST = 160
"""Points of a surface that are looked at."""
_NEIGHBOURS = 8
"""Points that a normal is of."""
_ROUNDS = 4
_TELLS = 0.5
"""An axis is measured whose deviation is less than this share of what was unknown."""
_TOGETHER = 12.0
"""Points that have the same noise: it is smooth over pixels."""
_GATE = 0.02
"""Distance between points of two frames beyond which they are not the same [m]."""


def registered(
    before: FloatArray,
    now: FloatArray,
    guess: FloatArray,
    *,
    noise: float,
    prior: float,
    gate: float,
) -> tuple[FloatArray, FloatArray]:
    """The shift from one frame's points (N, 3) to the next one's (M, 3).

    Args:
        before, now: surfaces in the world [m]; a few points at least.
        guess: (3,) the shift that is expected [m].
        noise: standard deviation of a point along the normal [m].
        prior: how far off the guess may be, a standard deviation [m].
        gate: points farther apart are not the same [m].

    Returns:
        (3,) the shift [m], and its variances (3,) [m^2]; those of the prior where nothing tells.
    """
    if min(len(before), len(now)) < _NEIGHBOURS:
        return np.array(guess), np.full(3, prior**2)
    tree, own = cKDTree(now), cKDTree(before)
    moving = before[:: -(-len(before) // _MOST)]
    # Means of as many points as those that they are laid on: a bent surface is flattened alike.
    moving = before[own.query(moving, k=_NEIGHBOURS)[1]].mean(axis=1)
    shift, weak = np.array(guess, dtype=float), np.eye(3) / prior**2
    information = weak
    for reach in np.geomspace(2.0 * gate, gate, _ROUNDS):
        distance, rows = tree.query(moving + shift, k=_NEIGHBOURS, distance_upper_bound=reach)
        # Where a whole neighbourhood is there.
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
        weight = weight / (1.0 + (off / (3.0 * noise)) ** 2) / (_TOGETHER * noise**2)
        told = np.einsum("n,ni,nj->ij", weight, normal, normal)
        pull = np.einsum("n,ni,n->i", weight, normal, left) + weak @ guess
        shift = np.linalg.solve(told + weak, pull)
        # A normal that noise has tilted seems to tell of what is along its surface.
        rough = np.minimum(spread[:, 0] / (_NEIGHBOURS - 3), noise**2)
        tilted = weight @ (rough / np.maximum(spread[:, 1], noise**2))
        size, along = np.linalg.eigh(told - tilted * np.eye(3))
        information = (along * np.maximum(size, 0.0)) @ along.T + weak
    return shift, np.diag(np.linalg.inv(information)).copy()


def shown_of(seen: FloatArray, row: IntArray, ids: IntArray) -> dict[int, FloatArray]:
    """What a frame's points (Q, 3) show of the obstacles (M,) that they belong to, rows (Q,)."""
    found = {name: seen[row == number] for number, name in enumerate(ids.tolist())}
    return {name: points for name, points in found.items() if len(points)}


class NowSeen(NamedTuple):
    """A frame: what it shows of the obstacles, by name, all its points (Q, 3) [m], and their rows.

    `row` (Q,) is of their obstacles, `cluster` (Q,) of their clusters: what an obstacle has become
    one cluster with may show its surface too.
    """

    shown: dict[int, FloatArray]
    points: FloatArray
    row: IntArray
    cluster: IntArray


def registered_tracks(
    tracks: Tracks,
    before: dict[int, FloatArray],
    now: NowSeen,
    dt: float,
) -> tuple[FloatArray, FloatArray]:
    """How far the obstacles that may move have gone since dt [s] ago, and how well it is known.

    Args:
        tracks: the M obstacles, as predicted.
        before: what the frame before showed of them, by name.
        now: this frame.
        dt: see there.

    Returns:
        (M, 3) shifts [m], NaN where nothing tells, and their variances (M, 3) [m^2].
    """
    shift, spread = np.full((len(tracks), 3), np.nan), np.ones((len(tracks), 3))
    unknown = dt * INITIAL_SPEED
    for row, name in enumerate(tracks.ids.tolist()):
        if name not in now.shown or name not in before or not 0.0 < dt <= LONGEST_GAP:
            continue
        then = before[name]
        moved = np.abs(now.shown[name].mean(axis=0) - then.mean(axis=0)).max() > MOVED
        if not (moved or tracks.moving[row] or tracks.doubt[row] > DOUBTED):
            continue
        shift[row], spread[row] = registered(
            then,
            now.points[np.isin(now.cluster, np.unique(now.cluster[now.row == row]))],
            dt * tracks.estimate.v_W[row],
            noise=SIDE_DEVIATION,
            prior=unknown,
            gate=_GATE,
        )
        shift[row, spread[row] > (_TELLS * unknown) ** 2] = np.nan
    return shift, spread
