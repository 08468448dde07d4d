"""Where the tool point is in reach about the base's axis while the tool points down.

At each height it is an annulus: what the arm reaches turns with its first joint, about the
vertical axis of an upright base.
"""

from __future__ import annotations

import math

import numpy as np
from pydrake.math import RollPitchYaw

from drake_oa.geometry.annulus import Annulus
from drake_oa.robot.config import Robot
from drake_oa.robot.plant import base_pose
from drake_oa.robot.reachability import Reachability

_DOWN = math.radians(15.0)
"""How far from the base's axis the tool may point."""
_UPRIGHT = math.radians(1.0)
"""How far from the vertical that axis may be."""
_STEP, _BETWEEN = 0.01, 0.1
"""Of the radii and of the heights at which what an arm reaches is looked at [m]."""
_AZIMUTHS, _UNREACHED = 72, 0.25
"""At how many azimuths, and at which share of them a point in the annulus may be out of reach."""
_FOLDED, _BASE = 0.04, 0.15
"""What is left to where the folded arm meets its limits, and to the axis [m]."""


def is_tool_down(robot: Robot) -> bool:
    """Whether the base stands upright and the tool points down along its axis."""
    up = base_pose(robot).rotation().matrix()[:, 2]
    tool = RollPitchYaw(robot.rpy_WE).ToRotationMatrix().matrix()[:, 2]
    return bool(up[2] >= math.cos(_UPRIGHT) and -tool[2] >= math.cos(_DOWN))


def given_annulus(robot: Robot) -> Annulus | None:
    """The one of the robot's block, in the world; None: it has none, or that of another arm."""
    given, usual = robot.annulus, Robot()
    if given is None:
        return None
    of_arm = ("model", "base_link", "hand_link", "p_HE")
    if given == usual.annulus and any(getattr(robot, f) != getattr(usual, f) for f in of_arm):
        return None
    p_WB = robot.X_WB.translation
    radii = np.array([given.height, given.inner, given.outer])
    radii[0] += p_WB[2]
    return Annulus(radii, (p_WB[0], p_WB[1]))


def found_annulus(reach: Reachability, robot: Robot) -> Annulus:
    """The one of what an arm reaches at most azimuths about its base.

    The map is of one orientation of the tool in the world; what is reached at one azimuth and not
    at another is so with the tool turned about the vertical, or the first joint at its limit.

    Raises:
        ValueError: if there is none.
    """
    p_WB = robot.X_WB.translation
    low, extent = reach.origin - p_WB, reach.spacing * np.array(reach.within_limits.shape)
    first, last = math.ceil(low[2] / _BETWEEN), math.floor((low + extent)[2] / _BETWEEN)
    radius = np.arange(0.0, float(np.abs([low, low + extent]).max()), _STEP)
    azimuth = np.linspace(-np.pi, np.pi, _AZIMUTHS, endpoint=False)
    found = []
    for height in _BETWEEN * np.arange(first, last + 1):
        x, y = np.multiply.outer(radius, [np.cos(azimuth), np.sin(azimuth)]).swapaxes(0, 1)
        p_BQ = np.stack([x, y, np.full_like(x, height)], axis=-1)
        margin = np.quantile(reach.reach_margin(p_WB + p_BQ), _UNREACHED, axis=1)
        reached = np.flatnonzero(margin >= 0.0)
        if not len(reached):
            continue
        gaps = np.flatnonzero(margin[: reached[-1]] < 0.0)
        begin = radius[gaps[-1] + 1] if len(gaps) else 0.0
        inner, outer = max(begin + _FOLDED, _BASE), radius[reached[-1]] - _STEP
        if outer > inner:
            found.append((p_WB[2] + height, inner, outer))
    if len(found) < 2:
        raise ValueError("the arm reaches no annulus about its base with the tool down")
    return Annulus(np.array(found).T.copy(), (p_WB[0], p_WB[1]))
