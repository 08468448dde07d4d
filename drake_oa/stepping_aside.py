"""Where the tool may step aside to, so that the arm gets past what it is stuck beside."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from drake_oa.evasion import DIRECTIONS
from drake_oa.values import FloatArray, Frozen, PlannedMotion

_STEPS = (0.2, 0.1)
"""How far from where it rests [m]."""
_UP = 0.5
"""What a way up counts beside one away from the obstacle: most things stand on the table."""
_APART = 0.025
"""Distance between the samples of a straight way [m]."""


def _nowhere() -> FloatArray:
    return field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, eq=False)
class Aside(Frozen):
    """A step aside, and what has been tried for one; positions in the world frame.

    Attributes:
        p_WV: (3,) point V that the tool goes to first [m]; (0,): none.
        p_WG: (3,) goal that it was chosen for [m]; (0,) without one.
        p_WE: (3,) where the tool was stuck last [m]; (0,): nowhere.
        row: of `points_aside` from there, which is to be tried next.
    """

    p_WV: FloatArray = _nowhere()
    p_WG: FloatArray = _nowhere()
    p_WE: FloatArray = _nowhere()
    row: int = 0


def points_aside(p_WE: FloatArray, p_WO: FloatArray) -> FloatArray:
    """Points V that are tried in turn, those away from an obstacle and above first.

    Args:
        p_WE: (3,) where the tool rests [m].
        p_WO: (3,) centre of the obstacle [m].

    Returns:
        (52, 3) p_WV [m]: all of one distance, then all of the next.
    """
    away = p_WE - p_WO
    wanted = away / max(float(np.linalg.norm(away)), 1e-9) + [0.0, 0.0, _UP]
    order = np.argsort(-(DIRECTIONS @ wanted), kind="stable")
    return np.concatenate([p_WE + step * DIRECTIONS[order] for step in _STEPS])


def straight_motion(p_WE: FloatArray, p_WV: FloatArray) -> PlannedMotion:
    """The motion of the tool straight from E to V, (3,) each [m]."""
    way = p_WV - p_WE
    count = 2 + int(np.linalg.norm(way) / _APART)
    s = np.linspace(0.0, 1.0, count)
    return PlannedMotion(s, p_WE + s[:, None] * way)
