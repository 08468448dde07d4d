"""How near an arm will come to what is around it on ways of it, for `drake_oa.safety.evasion`."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from drake_oa.common.messages import BoolArray, FloatArray, IntArray
from drake_oa.common.thinking import count
from drake_oa.geometry.annulus import ANYWHERE, Annulus, annulus_margin
from drake_oa.geometry.points import GuardShapes, ObstaclePoints
from drake_oa.posture.null_space_coupling import null_space_basis
from drake_oa.safety import lookahead_kernels as kernels
from drake_oa.safety.config import EvasionParameters, EvasionSettings


def posed_arm(
    J: FloatArray,
    p_WE: FloatArray,
    q: FloatArray,
    limits: tuple[FloatArray, FloatArray, FloatArray],
    shapes: GuardShapes,
    X_WB: FloatArray,
    moved: BoolArray,
    parameters: EvasionParameters,
) -> kernels.Arm:
    """Lays out an arm.

    Args:
        J: (6, n) Jacobian of the tool point's angular and linear velocity in the world.
        p_WE: (3,) the tool point [m].
        q: (n,) positions.
        limits: lower and upper limits of position, and of speed.
        shapes: the robot's primitives.
        X_WB: (B, 4, 4) poses of its bodies.
        moved: (B, n) whether a joint moves a body; the joints are in a row.
        parameters: what is kept of the limits.
    """
    screws = np.array(J.T, order="C")
    # The velocity of the point of each joint's body that is at the origin.
    screws[:, 3:] -= np.cross(screws[:, :3], p_WE)
    joint = moved.sum(axis=1).astype(np.int64)[shapes.shape_body]
    on = joint > 0
    X_WG = X_WB[shapes.shape_body[on]] @ shapes.X_BG[on]
    lower, upper, speed = (np.array(limit, dtype=float) for limit in limits)
    return kernels.Arm(
        screws=screws,
        p_WE=np.array(p_WE, dtype=float),
        q=np.array(q, dtype=float),
        lower=lower + parameters.joint_margin,
        upper=upper - parameters.joint_margin,
        speed=parameters.speed_share * speed,
        free=np.ascontiguousarray(null_space_basis(J)),
        joint=joint[on],
        X_WG=np.ascontiguousarray(X_WG),
        size=np.ascontiguousarray(shapes.size[on]),
        bound=np.ascontiguousarray(shapes.bound[on]),
    )


@dataclass(frozen=True, eq=False)
class Ways:
    """What is expected of C ways of the arm.

    Attributes:
        clearance: (C,) least distance on each [m]; -inf where the arm cannot go it, or it was
            not looked at to its end.
        distance: (C,) the same as far as it was looked at, whether or not the arm can go it [m].
        when: (C,) when it is least [s].
        row: (C,) the obstacle's row, see `lookahead_kernels.NOTHING`.
    """

    clearance: FloatArray
    distance: FloatArray
    when: FloatArray
    row: IntArray


class Lookout:
    """Looks ahead from one instant of a motion."""

    def __init__(
        self,
        arm: kernels.Arm,
        obstacles: ObstaclePoints,
        table: FloatArray,
        age: float,
        parameters: EvasionSettings,
        *,
        table_height: float = -math.inf,
        annulus: Annulus | None = None,
    ) -> None:
        """Takes what does not depend on the way.

        Args:
            arm: as it is posed.
            obstacles: their points and velocities.
            table: (4,) unit normal and offset of the plane [m]; NaN: there is none.
            age: time since the obstacles were seen [s].
            parameters: what is kept.
            table_height: least height of the tool point over the table [m].
            annulus: where the tool point may be; None: anywhere.
        """
        self._arm, self._parameters = arm, parameters
        self._obstacles = kernels.Obstacles(obstacles.blocks, float(age), table)
        self._height = table_height
        self._annulus = ANYWHERE if annulus is None else annulus
        self._times = parameters.times
        self._rules = kernels.LookaheadRules(
            damping=1e-5,
            miss=0.015,
            growth=parameters.growth,
            table_allowance=parameters.table_allowance,
            most=parameters.margin + parameters.release + parameters.padding + 0.03,
        )

    @property
    def free(self) -> FloatArray:
        """(n, m) orthonormal velocities of the joints that do not move the tool."""
        return self._arm.free

    def look(
        self,
        shifts: FloatArray,
        turns: FloatArray | None = None,
        *,
        plenty: float = math.inf,
        behind: float = math.inf,
        until: float = math.inf,
    ) -> Ways:
        """What is expected of ways of the arm.

        Args:
            shifts: (C, K, 3) of the tool from where it is, at the times that are looked at [m].
            turns: (C, K, n) how far the joints have turned besides, of which what does not move
                the tool counts [rad]; None: they do not.
            plenty, behind: see `lookahead_kernels.clearance_ahead` [m].
            until: only so far ahead [s].
        """
        arm = self._arm
        times = self._times[self._times <= until + 1e-9]
        shifts = shifts[:, : len(times)]
        if turns is None:
            turns = np.zeros((*shifts.shape[:2], len(arm.q)))
        # The others are not to put an end to the ways that are looked at.
        inside = np.flatnonzero(self._inside(shifts))
        found, out = np.empty((len(inside), 5)), np.zeros((len(shifts), 5))
        kernels.clearance_ahead(
            np.ascontiguousarray(shifts[inside]),
            np.ascontiguousarray(turns[inside, : len(times)]),
            times,
            arm,
            self._obstacles,
            self._rules,
            plenty + self._parameters.padding,
            behind,
            found,
        )
        count(poses=int(found[:, 4].sum()))
        out[:, 2] = kernels.NOTHING
        out[inside] = found
        distance = out[:, 0] - self._parameters.padding
        clearance = np.where(out[:, 3] > 0.0, distance, -np.inf)
        return Ways(clearance, distance, out[:, 1].copy(), out[:, 2].astype(np.int64))

    def _inside(self, shifts: FloatArray) -> BoolArray:
        """Whether ways stay in the workspace, or at least do not leave it further."""
        p_WE = self._arm.p_WE + shifts
        return np.asarray(
            (self._margin(p_WE) >= min(float(self._margin(self._arm.p_WE)), 0.0) - 1e-9).all(axis=1)
        )

    def _margin(self, p_WE: FloatArray) -> FloatArray:
        margin = np.full(p_WE.shape[:-1], np.inf)
        table = self._obstacles.table
        if not math.isnan(table[3]):
            margin = p_WE @ table[:3] - table[3] - self._height
        return np.minimum(margin, annulus_margin(p_WE, self._annulus))
