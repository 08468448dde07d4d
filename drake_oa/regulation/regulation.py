"""What was verified last, among what, and whether it still stands; what others make of it.

`Regulation.coupling` are the parameters that the action level takes, `taken_route` the sides
that are drawn, `concern` what is logged.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np

from drake_oa.common.messages import (
    CouplingParameters,
    EllipsoidSet,
    FloatArray,
    Frozen,
    HoldCause,
    PlannedMotion,
    PolicyState,
    TablePlane,
)
from drake_oa.policy.coupling import ALPHA, KAPPA, N_COLUMNS, NORMAL, PSI
from drake_oa.posture.posture_planner import ArmWay
from drake_oa.posture.waypoint_tree import Aside
from drake_oa.regulation.proposals import ANGLE, N_GENES

_NOISE = 5e-3
"""By how much an obstacle at rest may seem to move or grow from frame to frame [m]."""
_MISSED = 5e-3
"""How far from the goal a motion may end without a word [m]."""
_OFF_PATH = 0.025
"""A motion that is farther than this from the verified one is verified again [m]."""


def no_genes() -> FloatArray:
    """(7,) where there are none."""
    return np.full(N_GENES, np.nan)


class Hold(Enum):
    """Why the motion must not go on, if it must not."""

    NONE = ""
    NO_MOTION = "no motion that clears obstacle {obstacle} found"
    NO_MOTION_INSIDE = (
        "no motion that clears obstacle {obstacle} above the table and in the workspace found"
    )
    AT_WAYPOINT = "at the point beside the obstacle"
    WAYPOINT_LOST = "the way to the point beside the obstacle is given up"


@dataclass(frozen=True, eq=False)
class Regulation(Frozen):
    """The motion that was verified last, and among what.

    Attributes:
        ellipsoids: the obstacles then.
        table: the supporting plane then, or None.
        p_WS: (3,) start of the motion [m].
        p_WG: (3,) its goal then, or the point that it goes to first [m].
        p_WE: (3,) where it was when it was looked at last [m].
        travelled: length of the way until there [m].
        remaining: length of the verified way from where it was verified [m].
        row: row of the obstacle that the term is put on; -1: no term.
        term: (13,) the avoidance term, see `coupling.turn_step`.
        tau: temporal scaling; 0: nothing was verified.
        in_range: whether the chain was asked within its trained range; so too where a motion
            for the arm's sake was drawn without it.
        genes: (7,) of the choice, NaN where there are none.
        shortfall: what is missing of the feasible clearance in the motion [m].
        short_of: name of the obstacle that it is missing of; -1: none.
        lowered: by how much the feasible clearance is less than the asked one [m].
        lowered_for: name of the obstacle that it is least of; -1: none.
        goal_error: distance to the goal at the motion's end [m].
        hold: why the motion must not go on.
        held_by: name of the obstacle that no motion clears; -1: none.
        anew: whether a motion that begins where this one rests will do in its place.
        tried: when such a one was looked for last [s].
        aside: the point V that the motion goes to first, which then is its p_WG.
        rests_since: since when the policy rests [s]; inf: it does not.
        for_arm: whether it was chosen as the arm cannot follow the shortest one.
        lacked: its shortfall then [m].
        sought: when a motion that the arm can follow was looked for last [s].
        motion: the motion from then to the goal.
        way: the arm's posture along it, where it is planned.
    """

    ellipsoids: EllipsoidSet = field(default_factory=EllipsoidSet)
    table: TablePlane | None = None
    p_WS: FloatArray = field(default_factory=lambda: np.zeros(3))
    p_WG: FloatArray = field(default_factory=lambda: np.zeros(3))
    p_WE: FloatArray = field(default_factory=lambda: np.zeros(3))
    travelled: float = 0.0
    remaining: float = 0.0
    row: int = -1
    term: FloatArray = field(default_factory=lambda: np.zeros(N_COLUMNS))
    tau: float = 0.0
    in_range: bool = True
    genes: FloatArray = field(default_factory=no_genes)
    shortfall: float = 0.0
    short_of: int = -1
    lowered: float = 0.0
    lowered_for: int = -1
    goal_error: float = 0.0
    hold: Hold = Hold.NONE
    held_by: int = -1
    anew: bool = False
    tried: float = -math.inf
    aside: Aside = field(default_factory=Aside)
    rests_since: float = math.inf
    for_arm: bool = False
    lacked: float = 0.0
    sought: float = -math.inf
    motion: PlannedMotion = field(default_factory=PlannedMotion)
    way: ArmWay = field(default_factory=ArmWay)

    @property
    def held(self) -> bool:
        """Whether the motion must not go on."""
        return self.hold is not Hold.NONE

    @property
    def note(self) -> str:
        """Why it must not, in words; empty where it may."""
        return self.hold.value.format(obstacle=self.held_by)

    def coupling(self, ellipsoids: EllipsoidSet) -> CouplingParameters:
        """The parameters for obstacles now: one row an ellipsoid, at most one with a term."""
        count = len(ellipsoids)
        alpha, psi, kappa = np.zeros(count), np.ones(count), np.zeros(count)
        in_range = np.ones(count, dtype=bool)
        center_W, normal_W = np.array(ellipsoids.p_WO), np.zeros((count, 3))
        if self.row >= 0:
            same = np.flatnonzero(ellipsoids.ids == self.ellipsoids.ids[self.row])[:1]
            alpha[same] = self.term[ALPHA]
            psi[same] = self.term[PSI]
            kappa[same] = self.term[KAPPA]
            in_range[same] = self.in_range
            center_W[same] = self.term[:3]
            normal_W[same] = self.term[NORMAL : NORMAL + 3]
        return CouplingParameters(
            alpha,
            psi,
            kappa,
            in_range,
            center_W,
            normal_W,
            tau=self.tau,
            hold=HoldCause.OBSTACLES if self.held else HoldCause.NONE,
            note=self.note,
            anew=self.anew,
            p_WV=self.aside.p_WV,
        )


def begun_anew(after: Regulation, policy: PolicyState) -> tuple[Regulation, PolicyState]:
    """What was verified, and the policy, as they are when it has begun anew where it rests."""
    rests = replace(policy, p_WS=policy.p_WE, z_W=np.zeros(3), phase=1.0)
    return replace(after, p_WS=policy.p_WE, travelled=0.0, genes=no_genes()), rests


def concern(regulation: Regulation) -> str:
    """What is to be said about a motion that does not do all that was asked, or ""."""
    found = []
    if regulation.shortfall > 0.0:
        found.append(
            f"{1e3 * regulation.shortfall:.1f} mm of the clearance to obstacle "
            f"{regulation.short_of} cannot be kept"
        )
    if regulation.lowered > _NOISE:
        found.append(
            f"the asked clearance is lowered by {1e3 * regulation.lowered:.1f} mm, as here or at "
            f"the goal obstacle {regulation.lowered_for} is taken to be that near"
        )
    if regulation.way.concern:
        found.append(regulation.way.concern)
    if regulation.goal_error > _MISSED:
        found.append(f"the goal is missed by {1e3 * regulation.goal_error:.1f} mm")
    return " and ".join(found)


def side_only(regulation: Regulation) -> FloatArray:
    """No genes but the side: who comes back to a term is not to come back on another side."""
    genes = no_genes()
    genes[ANGLE] = regulation.genes[ANGLE]
    return genes


def travelled(before: Regulation, policy: PolicyState) -> float:
    """Length of the way that the motion has gone [m]."""
    if before.tau == 0.0 or not np.array_equal(before.p_WS, policy.p_WS):
        return math.dist(policy.p_WE, policy.p_WS)
    return before.travelled + math.dist(policy.p_WE, before.p_WE)


def hardly_moved(before: EllipsoidSet, now: EllipsoidSet) -> bool:
    """Whether the same obstacles are where they were expected, and as large, up to noise."""
    if not np.array_equal(before.ids, now.ids):
        return False
    since = now.stamp - before.stamp if len(now) else 0.0
    moved = np.abs(now.p_WO - before.p_WO - since * before.v_WO).max(initial=0.0)
    grown = np.abs(now.semi_axes - before.semi_axes).max(initial=0.0)
    return bool(max(moved, grown) <= _NOISE)


def stays(before: Regulation, here: Regulation) -> bool:
    """Whether the motion that was verified goes on among the same resting obstacles."""
    one, other = before.ellipsoids, here.ellipsoids
    return (
        before.tau != 0.0
        and np.array_equal(before.p_WS, here.p_WS)
        and np.array_equal(before.p_WG, here.p_WG)
        and not other.v_WO.any()
        and (
            one is other
            or all(
                np.array_equal(getattr(one, name), getattr(other, name))
                for name in ("ids", "p_WO", "R_WO", "semi_axes", "v_WO")
            )
        )
        and _same_plane(before.table, here.table)
        and _on_path(before.motion, here.p_WE)
    )


def _on_path(motion: PlannedMotion, p_WE: FloatArray) -> bool:
    """Whether the policy is where the motion goes: evasion displaces it."""
    if len(motion) < 2:
        return True
    start, way = motion.p_WE[:-1], np.diff(motion.p_WE, axis=0)
    square = np.maximum(np.einsum("ij,ij->i", way, way), 1e-18)
    share = np.clip(np.einsum("ij,ij->i", p_WE - start, way) / square, 0.0, 1.0)
    off = start + share[:, None] * way - p_WE
    return bool(np.einsum("ij,ij->i", off, off).min() <= _OFF_PATH**2)


def _same_plane(one: TablePlane | None, other: TablePlane | None) -> bool:
    if one is None or other is None:
        return one is other
    return one.offset == other.offset and np.array_equal(one.normal_W, other.normal_W)
