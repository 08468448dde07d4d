"""Compiled geometry of proposals, behind `drake_oa.regulation.verification`."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from drake_oa.common.messages import FloatArray
from drake_oa.regulation.spatial_kernels import point_distance

_SAMPLES = 41

ALONG, ACROSS, CENTER, ASKED = range(4)
"""Columns of a shadow: extents lambda', place of the centre, clearance; all over L."""


@njit(cache=True, error_model="numpy")
def _planned(s: float) -> float:
    """Share of the baseline that a minimum-jerk motion has covered at s."""
    s = min(max(s, 0.0), 1.0)
    return s * s * s * (10.0 + s * (6.0 * s - 15.0))


@njit(cache=True, error_model="numpy")
def shadows(
    p_WG: FloatArray,
    R_WL: FloatArray,
    baseline: FloatArray,
    s_now: float,
    p_WO: FloatArray,
    R_WO: FloatArray,
    semi_axes: FloatArray,
    v_WO: FloatArray,
    clearance: FloatArray,
    seconds: float,
    angles: FloatArray,
    out: FloatArray,
) -> None:
    """What of the obstacles in the way rises above the baseline on each side.

    In the way is what comes nearer to the planned motion than the asked clearance, where
    it is then. Of all of those together the half ellipse centred on the baseline takes the
    extent along the baseline and the height on that side.

    Args:
        p_WG, R_WL, baseline, p_WO, R_WO, semi_axes, v_WO, clearance: see
            `spatial_rollout.SpatialScenes`.
        s_now: normalised time now.
        seconds: tau T [s].
        angles: (A,) of the sides omega in the local YZ plane.
        out: (S, A, 4) takes `ALONG`, `ACROSS`, `CENTER`, `ASKED`; `ASKED` is 0 where
            nothing is in the way.
    """
    M = p_WO.shape[1]
    for s in range(len(baseline)):
        L = baseline[s]
        x0, x1, x2 = R_WL[s, 0, 0], R_WL[s, 1, 0], R_WL[s, 2, 0]
        nearest = np.full(M, np.inf)
        when = np.zeros(M)
        for j in range(M):
            if math.isnan(p_WO[s, j, 0]):
                continue
            t = 0.0
            for i in range(_SAMPLES):
                at = s_now + max(1.0 - s_now, 0.0) * i / (_SAMPLES - 1)
                time = (at - s_now) * seconds
                left = L * (_planned(at) - 1.0)
                d, t = point_distance(
                    p_WG[s, 0] + left * x0 - p_WO[s, j, 0] - time * v_WO[s, j, 0],
                    p_WG[s, 1] + left * x1 - p_WO[s, j, 1] - time * v_WO[s, j, 1],
                    p_WG[s, 2] + left * x2 - p_WO[s, j, 2] - time * v_WO[s, j, 2],
                    R_WO,
                    semi_axes,
                    s,
                    j,
                    t,
                )
                if d < nearest[j]:
                    nearest[j], when[j] = d, time
        for a in range(len(angles)):
            cos, sin = math.cos(angles[a]), math.sin(angles[a])
            low, high, top, asked = np.inf, -np.inf, -np.inf, 0.0
            for j in range(M):
                if not nearest[j] < clearance[s, j]:
                    continue
                # Matrix of the shadow in the plane of x and omega, and its centre there.
                q11, q12, q22, cx, cy = 0.0, 0.0, 0.0, 0.0, 0.0
                for k in range(3):
                    u, w = 0.0, 0.0
                    for i in range(3):
                        omega = cos * R_WL[s, i, 1] + sin * R_WL[s, i, 2]
                        u += R_WL[s, i, 0] * R_WO[s, j, i, k]
                        w += omega * R_WO[s, j, i, k]
                    square = semi_axes[s, j, k] ** 2
                    q11 += u * u * square
                    q12 += u * w * square
                    q22 += w * w * square
                for i in range(3):
                    omega = cos * R_WL[s, i, 1] + sin * R_WL[s, i, 2]
                    e = p_WO[s, j, i] + when[j] * v_WO[s, j, i] - p_WG[s, i]
                    cx += e * R_WL[s, i, 0]
                    cy += e * omega
                cx += L
                height = math.sqrt(q22)
                level = min(max(-cy, -height), height)
                half = math.sqrt(max((q11 - q12 * q12 / q22) * (1.0 - level * level / q22), 0.0))
                middle = q12 / q22 * level
                reach = math.sqrt(q11)
                right = reach if q12 / reach >= level else middle + half
                left_end = -reach if -q12 / reach >= level else middle - half
                low, high = min(low, cx + left_end), max(high, cx + right)
                top = max(top, cy + height)
                asked = max(asked, clearance[s, j] + min(cy + height, 0.0))
            if asked == 0.0:
                low, high, top = 0.5 * L, 0.5 * L, 0.0
            out[s, a, ALONG] = max(0.5 * (high - low) / L, 0.02)
            out[s, a, ACROSS] = max(top / L, 0.02)
            out[s, a, CENTER] = min(max(0.5 * (low + high) / L, 0.02), 0.98)
            out[s, a, ASKED] = asked / L
