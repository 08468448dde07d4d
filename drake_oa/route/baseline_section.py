"""The obstacle as a motion past it on a chosen side meets it.

The regressor chain is trained on ellipses centred on the baseline. Obstacles seldom
stand so. Once the side is chosen, what matters of an obstacle is what rises above the
baseline on that side, in the plane of the baseline and the chosen direction: this
module encloses that part by half an ellipse centred on the baseline, so that
the trained map applies, and the coupling term acts about that centre.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drake_oa.common.messages import EllipsoidSet, FloatArray, IntArray
from drake_oa.geometry.ellipsoid import shape_matrix, signed_distance
from drake_oa.geometry.ellipsoid_kernels import feasible_clearance

_SAMPLES = 41
_OUTLINE = 180
_LEAST_EXTENT = 0.02
_LEAST_CLEARANCE = 0.2


@dataclass(frozen=True, eq=False)
class Passing:
    """M obstacles as the motion meets them.

    Attributes:
        center_W: (M, 3) centres of the half ellipses, on the baseline [m].
        extents: (M, 2) lambda': semi-axes along the baseline and across it [m].
        remaining_clearance: (M,) clearance to keep from the half ellipse [m]; 0 where no
            coupling is needed: the baseline already keeps what can be kept, or the
            way past another obstacle does.
        weight: (M,) share of the coupling term, 1 / n for n obstacles that have one
            half ellipse in common.
    """

    center_W: FloatArray
    extents: FloatArray
    remaining_clearance: FloatArray
    weight: FloatArray


def passing(
    p_WS: FloatArray,
    p_WG: FloatArray,
    R_WL: FloatArray,
    ellipsoids: EllipsoidSet,
    direction_W: FloatArray,
    groups: IntArray,
    asked_clearance: float,
) -> Passing:
    """Half ellipses that enclose what rises above the baseline on the chosen side.

    In the plane of the baseline x and the direction omega the shadow of an ellipsoid
    is the ellipse of the matrix Q = U^T B U with U = [x, omega] and B its shape
    matrix. With o the height of the baseline above its centre along omega:

    - across, lambda2' = sqrt(Q22) - o, the height of the part above the baseline;
    - along, lambda1' and the centre are those of the part's extent along x. For a
      centre above the baseline (o < 0) lambda1' grows by sqrt((b - o) / b),
      b = sqrt(Q22), so that half an ellipse still encloses it.

    Both grow by one factor, at least 1, where the shadow stands oblique to the
    baseline, its highest point not over the middle of the part.

    A part that does not rise above the baseline but comes nearer than Delta has the
    least extent, and the clearance that is left. No more clearance is asked than the
    start and the goal have, which is all that can be kept, but a fifth of Delta at least.

    Obstacles of one group, passed on one side, share one half ellipse that encloses
    theirs; one that the way past another clears anyway is left out.

    Args:
        p_WS: (3,) start [m].
        p_WG: (3,) goal [m].
        R_WL: (3, 3) local frame.
        ellipsoids: the M obstacles.
        direction_W: (M, 3) chosen directions omega, orthogonal to the baseline.
        groups: (M,) numbers of the groups that are passed on one side.
        asked_clearance: asked clearance Delta [m].
    """
    count = len(ellipsoids)
    if count == 0:
        return Passing(np.zeros((0, 3)), np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    x = R_WL[:, 0]
    baseline = float((p_WG - p_WS) @ x)
    to_O = ellipsoids.p_WO - p_WS
    o = -np.sum(to_O * direction_W, axis=1)
    middle, extents = _half_ellipses(ellipsoids, x, direction_W, o)

    place = np.linspace(0.0, 1.0, _SAMPLES)[:, None, None] * (p_WG - p_WS) + p_WS
    distance = signed_distance(place, ellipsoids.p_WO, ellipsoids.R_WO, ellipsoids.semi_axes)
    nearest = distance.argmin(axis=0)
    feasible = feasible_clearance(asked_clearance, distance[0], distance[-1])
    # An obstacle at the start or the goal still has to be turned away from.
    feasible = np.maximum(feasible, _LEAST_CLEARANCE * asked_clearance)
    between = (nearest > 0) & (nearest < _SAMPLES - 1)
    needed = between & (distance.min(axis=0) < feasible)
    gap = np.where(extents[:, 1] > 0.0, 0.0, np.maximum(distance.min(axis=0), 0.0))
    center = np.clip(to_O @ x + middle, 0.0, baseline)
    extents = np.maximum(extents, _LEAST_EXTENT * baseline)
    kept = np.where(needed, np.maximum(feasible - gap, 0.0), 0.0)
    weight = np.ones(count)
    for group in np.unique(groups):
        rows = np.flatnonzero((groups == group) & (kept > 0.0))
        cleared = _cleared_by_another(center[rows], extents[rows], kept[rows], baseline)
        kept[rows[cleared]] = 0.0
        rows = rows[~cleared]
        if len(rows) > 1:
            center[rows], extents[rows] = _envelope(center[rows], extents[rows])
            kept[rows] = kept[rows].max()
            weight[rows] = 1.0 / len(rows)
    return Passing(p_WS + center[:, None] * x, extents, kept, weight)


def _half_ellipses(
    ellipsoids: EllipsoidSet, x: FloatArray, direction_W: FloatArray, o: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Centres along x, from the obstacle's own (M,), and semi-axes (M, 2) of the half ellipses.

    Where nothing rises above the baseline the second semi-axis is 0.
    """
    B = shape_matrix(ellipsoids.R_WO, ellipsoids.semi_axes)
    Q11 = np.einsum("i,mij,j->m", x, B, x)
    Q12 = np.einsum("i,mij,mj->m", x, B, direction_W)
    Q22 = np.einsum("mi,mij,mj->m", direction_W, B, direction_W)
    height = np.sqrt(Q22)
    rises = o < height

    # The part's extent along x: the chord at the baseline, or the ellipse's own
    # extreme where that lies above it.
    level = np.clip(o, -height, height)
    middle = Q12 / Q22 * level
    half = np.sqrt(np.maximum((Q11 - Q12**2 / Q22) * (1.0 - level**2 / Q22), 0.0))
    reach = np.sqrt(Q11)
    right = np.where(Q12 / reach >= level, reach, middle + half)
    left = np.where(-Q12 / reach >= level, -reach, middle - half)
    above = np.maximum(-o, 0.0)
    along = 0.5 * (right - left) * np.sqrt(1.0 + above / height)
    center = 0.5 * (left + right)
    extents = np.stack([along, np.where(rises, height - o, 0.0)], axis=1)
    extents *= _enclosing_scale(Q11, Q12, Q22, o, center, extents)[:, None]
    return center, extents


def _enclosing_scale(
    Q11: FloatArray,
    Q12: FloatArray,
    Q22: FloatArray,
    o: FloatArray,
    middle: FloatArray,
    extents: FloatArray,
) -> FloatArray:
    """How much the half ellipses must grow to hold the parts above the baseline, (M,)."""
    angle = np.linspace(0.0, 2.0 * np.pi, _OUTLINE, endpoint=False)
    cos, sin = np.cos(angle), np.sin(angle)
    height = np.sqrt(Q22)
    depth = np.sqrt(np.maximum(Q11 - Q12**2 / Q22, 0.0))
    along = (Q12 / height)[:, None] * sin + depth[:, None] * cos - middle[:, None]
    across = height[:, None] * sin - o[:, None]
    above = (across > 0.0) & (extents[:, 1:] > 0.0)
    safe = np.where(extents > 0.0, extents, 1.0)
    gauge = (along / safe[:, :1]) ** 2 + (across / safe[:, 1:]) ** 2
    return np.sqrt(np.where(above, gauge, 1.0).max(axis=1, initial=1.0))


def _cleared_by_another(
    center: FloatArray, extents: FloatArray, remaining_clearance: FloatArray, baseline: float
) -> np.ndarray:
    """Which of n obstacles lie below the triangle start - peak over another - goal, (n,).

    A motion past that other one bulges out of the triangle.
    """
    peak = extents[:, 1] + remaining_clearance
    before, after = center, baseline - center
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.minimum(before[:, None] / before, after[:, None] / after)
    height = np.nan_to_num(share, nan=0.0, posinf=0.0) * peak
    # Of two equal ones the first stays, whatever the rounding.
    below = height >= peak[:, None] * (1.0 - 1e-9)
    np.fill_diagonal(below, False)
    return np.asarray((below & ~(below.T & np.tri(len(peak), k=-1, dtype=bool).T)).any(axis=1))


def _envelope(center: FloatArray, extents: FloatArray) -> tuple[float, FloatArray]:
    """Centre and semi-axes of a half ellipse on the baseline that encloses n of them."""
    low, high = (center - extents[:, 0]).min(), (center + extents[:, 0]).max()
    middle = 0.5 * (low + high)
    axes = np.array([0.5 * (high - low), extents[:, 1].max()])
    angle = np.linspace(0.0, np.pi, _SAMPLES)
    along = center[:, None] + extents[:, :1] * np.cos(angle) - middle
    across = extents[:, 1:] * np.sin(angle)
    gauge = np.sqrt((along / axes[0]) ** 2 + (across / axes[1]) ** 2).max()
    return middle, axes * gauge
