"""The workspace of a tool that points down, as the robot's block gives it."""

from __future__ import annotations

import numpy as np

from drake_oa.geometry.annulus import Annulus
from drake_oa.robot.config import Robot


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
