"""Frozen values that travel between the layers on abstract ports.

Every value is one immutable struct of arrays. Copying it is free
(``__deepcopy__`` returns the value itself), so a Drake Context that holds one
clones in constant time, and no receiver can change what another one reads.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


PART_ID_STRIDE = 2**20
"""Rows that describe parts of one obstacle have names that differ by multiples of this."""


class Frozen:
    """Shares itself on copy and locks its arrays on construction."""

    def __post_init__(self) -> None:
        own = self.__dict__
        for name, value in own.items():
            if value.__class__ is np.ndarray and value.flags.writeable:
                locked = value.view()
                locked.flags.writeable = False
                own[name] = locked

    def __copy__(self) -> Self:
        return self

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return self


def zeros(*shape: int, kind: Any = float) -> Any:
    """Field of a frozen value that by default is an array of zeros."""
    return field(default_factory=lambda: np.zeros(shape, dtype=kind))


@dataclass(frozen=True, eq=False)
class TablePlane(Frozen):
    """The supporting plane ``normal_W . p_WQ = offset``.

    Attributes:
        normal_W: (3,) unit normal in the world frame, pointing to free space.
        offset: distance of the plane from the world origin along it [m].
    """

    normal_W: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    offset: float = 0.0

    def height(self, p_WQ: FloatArray) -> FloatArray:
        """Signed height [m] above the plane of points p_WQ, (..., 3) -> (...)."""
        return np.asarray(p_WQ @ self.normal_W - self.offset)

    def distance_to(self, other: TablePlane) -> float:
        """Bound on the distance of two planes below the origin and up to 1 m from there [m]."""
        turn = np.linalg.norm(self.normal_W - other.normal_W)
        return abs(self.offset - other.offset) + float(turn)


@dataclass(frozen=True, eq=False)
class ObstacleClouds(Frozen):
    """Observation of the obstacles at one instant.

    Attributes:
        stamp: simulation time at which the scene looked so [s]; -inf before the
            first frame.
        clouds_W: one (N_i, 3) array of surface points in the world frame [m] an
            obstacle; empty when nothing stands on the table.
        ids: (M,) integers that name the obstacles.
        table: the supporting plane, or None when no plane was found or known.
        note: empty, or why this frame is degraded (for example "no valid pixel").
        v_WO: (M, 3) velocities in the world frame [m/s], exactly zero for an obstacle
            that does not move significantly; zeros when not given.
    """

    stamp: float = -np.inf
    clouds_W: tuple[FloatArray, ...] = ()
    ids: IntArray = zeros(0, kind=np.int64)
    table: TablePlane | None = None
    note: str = ""
    v_WO: FloatArray = zeros(0, 3)

    def __post_init__(self) -> None:
        if not len(self.v_WO) and len(self.clouds_W):
            object.__setattr__(self, "v_WO", np.zeros((len(self.clouds_W), 3)))
        super().__post_init__()

    def __len__(self) -> int:
        return len(self.clouds_W)


@dataclass(frozen=True, eq=False)
class EllipsoidSet(Frozen):
    """The unified system-obstacle descriptors: M ellipsoids.

    Each is the obstacle dilated by the tool, so that the tool may be treated as
    the point E.

    Attributes:
        stamp: stamp of the observation it was made from [s].
        p_WO: (M, 3) centers in the world frame [m].
        R_WO: (M, 3, 3) rotations; the columns are the principal axes.
        semi_axes: (M, 3) semi-axes along those columns [m].
        v_WO: (M, 3) velocities of the centers in the world frame [m/s].
        ids: (M,) integers that name the rows, each different: the obstacle's name, and a
            multiple of `PART_ID_STRIDE` more for the second and further parts of it.
        table: the supporting plane, handed through from perception, or None.
        note: empty, or why the observation is degraded.
    """

    stamp: float = -np.inf
    p_WO: FloatArray = zeros(0, 3)
    R_WO: FloatArray = zeros(0, 3, 3)
    semi_axes: FloatArray = zeros(0, 3)
    v_WO: FloatArray = zeros(0, 3)
    ids: IntArray = zeros(0, kind=np.int64)
    table: TablePlane | None = None
    note: str = ""

    def __len__(self) -> int:
        return len(self.p_WO)


class HoldReason(StrEnum):
    """Reason for which the motion is held, for decisions; a note states it in words."""

    NONE = "none"
    DECIDING = "deciding"
    """The first motion is being decided on."""
    SPEED_SCALE = "speed_scale"
    """The speed is scaled to nothing from outside."""
    SUPERVISOR = "supervisor"
    """The speed is scaled to nothing by the supervisor; set by the monitor of a run."""
    OBSTACLES = "obstacles"
    """They are not seen, in the way, or no way past them is known."""


@dataclass(frozen=True, eq=False)
class PolicyState(Frozen):
    """State of the dynamic movement primitive.

    Attributes:
        p_WE: (3,) position of the end effector E in the world frame [m].
        z_W: (3,) scaled velocity, the derivative of p_WE by normalized time
            s = t / (tau T), in the world frame [m].
        phase: canonical phase k, 1 at the start and falling to 0.
        tau: temporal scaling (1: the demonstrated duration).
        p_WS: (3,) start of the motion [m].
        p_WG: (3,) goal, or the point that the motion goes to first [m].
        R_WL: (3, 3) local frame: x from start to goal, z up.
        stamp: time of this state [s].
        speed: ds/dt, the rate of normalized time [1/s]; 1 / (tau T) when running
            freely, 0 when held.
        hold: what holds the motion.
        note: the same in words; empty where nothing does.
    """

    p_WE: FloatArray = zeros(3)
    z_W: FloatArray = zeros(3)
    phase: float = 1.0
    tau: float = 1.0
    p_WS: FloatArray = zeros(3)
    p_WG: FloatArray = zeros(3)
    R_WL: FloatArray = field(default_factory=lambda: np.eye(3))
    stamp: float = 0.0
    speed: float = 0.0
    hold: HoldReason = HoldReason.NONE
    note: str = ""

    @property
    def baseline(self) -> float:
        """Distance from start to goal [m]."""
        return math.dist(self.p_WG, self.p_WS)


@dataclass(frozen=True, eq=False)
class PlannedMotion(Frozen):
    """The motion that the inference expects, from now to the goal or to a point before it.

    Attributes:
        s: (T,) normalized times, increasing; (0,): no motion is known.
        p_WE: (T, 3) the tool point there in the world frame [m].
        q: (T, n) positions of the arm's joints there [rad]; (0, n): none are planned.
        p_WS: (3,) start of the motion that the times belong to, in the world frame [m]; (0,):
            they belong to the one under way.
    """

    s: FloatArray = zeros(0)
    p_WE: FloatArray = zeros(0, 3)
    q: FloatArray = zeros(0, 0)
    p_WS: FloatArray = zeros(0)

    def __len__(self) -> int:
        return len(self.s)

    def joints(self, s: float | FloatArray) -> FloatArray:
        """Interpolates positions of the joints (..., n) at normalized times (...) [rad]."""
        return np.stack([np.interp(s, self.s, joint) for joint in self.q.T], axis=-1)


@dataclass(frozen=True, eq=False)
class Route(Frozen):
    """The side to pass each obstacle on, the rings it was chosen from, and the ranked sides.

    Rows follow the rows of the EllipsoidSet that it was made for.

    Attributes:
        direction_W: (M, 3) chosen direction omega_d on the local YZ circle, as a
            unit vector in the world frame.
        normal_W: (M, 3) unit normal x_L x omega_d of the plane in which each obstacle
            is passed: turning about it turns from the baseline toward the chosen side.
        remaining_clearance: (M,) clearance to keep on that side [m]; 0: no guidance needed.
        index: (M,) the chosen column of the rings.
        angles: (K,) angles of the circle [rad], 0 along local y, pi/2 along z.
        costs: name of a ring -> (M, K) its cost in [0, 1] on that circle.
        path_length: estimated length of the avoiding path [m].
        p_WS: (3,) start of the motion that it was decided for [m].
        p_WG: (3,) goal of that motion [m].
        R_WL: (3, 3) local frame of that motion.
        ids: (M,) the obstacles' names.
        blocked: whether no side is allowed for one of them.
        note: empty, or why no side is allowed.
        side_cost: (N,) costs that user-supplied rings add to N evenly spread sides, as path length
            over the baseline; inf: forbidden.
    """

    direction_W: FloatArray = zeros(0, 3)
    normal_W: FloatArray = zeros(0, 3)
    remaining_clearance: FloatArray = zeros(0)
    index: IntArray = zeros(0, kind=np.int64)
    angles: FloatArray = zeros(0)
    costs: dict[str, FloatArray] = field(default_factory=dict)
    path_length: float = 0.0
    p_WS: FloatArray = zeros(3)
    p_WG: FloatArray = zeros(3)
    R_WL: FloatArray = field(default_factory=lambda: np.eye(3))
    ids: IntArray = zeros(0, kind=np.int64)
    blocked: bool = False
    note: str = ""
    side_cost: FloatArray = zeros(1)

    @property
    def baseline(self) -> float:
        """Distance from start to goal [m]; 0 when nothing was decided yet."""
        return math.dist(self.p_WG, self.p_WS)


OUT_OF_WORLD = 25.0
"""Distance from the world's origin beyond which a thing counts as absent [m]."""


@dataclass(frozen=True, eq=False)
class CouplingParameters(Frozen):
    """Parameters of avoidance terms: one row an obstacle, then one a candidate side.

    Attributes:
        alpha: (M,) strength: turning rate in units of 1/T, T the demonstrated
            duration.
        psi: (M,) width of the response to the heading [rad].
        kappa: (M,) decay with the squared distance [1/m^2].
        in_range: (M,) False where the query lay outside what the chain was trained
            for: it was then evaluated at the nearest input inside.
        center_W: (M, 3) the points the terms act about [m]; (0, 3): the obstacles'
            centers.
        normal_W: (M, 3) normals of the planes in which to pass; they go before the
            route's, and where there is one the route does not guide. A zero row, or
            (0, 3): not given.
        tau: temporal scaling of the motion, which goes before the one from the route's
            length; 0: not given.
        hold: whether the motion must not go on, and what for.
        note: the same in words.
        restart: whether it is to begin anew from where it rests.
        verified: whether the rows are terms of their own, about `center_W`, which a look at the
            true shapes has chosen: they belong to no ellipsoid, and none holds the motion.
        ellipsoids: obstacles of verified rows of the chain, past which guidance leads.
    """

    alpha: FloatArray = zeros(0)
    psi: FloatArray = zeros(0)
    kappa: FloatArray = zeros(0)
    in_range: BoolArray = zeros(0, kind=bool)
    center_W: FloatArray = zeros(0, 3)
    normal_W: FloatArray = zeros(0, 3)
    tau: float = 0.0
    hold: HoldReason = HoldReason.NONE
    note: str = ""
    restart: bool = False
    verified: bool = False
    ellipsoids: EllipsoidSet = field(default_factory=EllipsoidSet)

    def __len__(self) -> int:
        return len(self.alpha)

    def as_array(self) -> FloatArray:
        """(M, 3) rows of alpha, psi, kappa."""
        return np.column_stack((self.alpha, self.psi, self.kappa))


DECIDING = "no motion from here is verified yet"
"""The note of a motion that is held while its first one is being decided on."""
