"""Immutable messages that the layers exchange on abstract ports.

A message is a frozen dataclass of read-only arrays. Copying it is free (``__deepcopy__`` returns
the message itself): a Drake Context that holds one clones in constant time, and no receiver can
change the input of another. Suffix _W: in the world frame; p_WO: position of O in W; R_WO:
orientation of O in W; E: tool point, the end effector; S, G: start and goal of the motion.
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
"""Difference between the IDs of consecutive parts of one obstacle; ID % stride is the track ID."""


class Frozen:
    """Base class of immutable dataclasses: arrays are read-only, copies are the object itself."""

    def __post_init__(self) -> None:
        fields = self.__dict__
        for name, value in fields.items():
            if value.__class__ is np.ndarray and value.flags.writeable:
                locked = value.view()
                locked.flags.writeable = False
                fields[name] = locked

    def __copy__(self) -> Self:
        return self

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return self


def zeros(*shape: int, kind: Any = float) -> Any:
    """Returns a dataclass field with an array of zeros as default: shape `shape`, dtype `kind`."""
    return field(default_factory=lambda: np.zeros(shape, dtype=kind))


@dataclass(frozen=True, eq=False)
class TablePlane(Frozen):
    """Support plane of the objects, usually a table: points Q with ``normal_W . p_WQ = offset``.

    Attributes:
        normal_W: (3,) unit normal in the world frame, pointing to free space.
        offset: signed distance of the plane from the world origin along the normal [m].
    """

    normal_W: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    offset: float = 0.0

    def height(self, p_WQ: FloatArray) -> FloatArray:
        """Computes the signed heights [m] of points p_WQ above the plane: (..., 3) -> (...)."""
        return np.asarray(p_WQ @ self.normal_W - self.offset)

    def distance_to(self, other: TablePlane) -> float:
        """Computes an upper bound of the height difference of two planes within 1 m of the origin.

        The bound [m] is ``|offset_1 - offset_2| + |normal_1 - normal_2| * 1 m``.
        """
        turn = np.linalg.norm(self.normal_W - other.normal_W)
        return abs(self.offset - other.offset) + float(turn)


@dataclass(frozen=True, eq=False)
class ObstacleClouds(Frozen):
    """Point clouds of the M obstacles at one instant.

    Attributes:
        stamp: time of the observation [s]; -inf before the first frame.
        clouds_W: for each obstacle an (N_i, 3) array of surface points in the world frame [m].
        ids: (M,) track IDs of the obstacles.
        table: support plane; None if none was found.
        note: reason why this frame is degraded, such as "no valid pixel"; otherwise empty.
        v_WO: (M, 3) velocities in the world frame [m/s], exactly zero for an obstacle
            without significant motion; zeros by default.
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
    """Obstacle descriptors: M ellipsoids, each of an obstacle dilated by the tool.

    Because of the dilation, the tool is treated as the point E.

    Attributes:
        stamp: time of the observation that is described [s].
        p_WO: (M, 3) centers in the world frame [m].
        R_WO: (M, 3, 3) rotations; the columns are the principal axes.
        semi_axes: (M, 3) semi-axes along those columns [m].
        v_WO: (M, 3) velocities of the centers in the world frame [m/s].
        ids: (M,) unique IDs of the rows: track ID + part * `PART_ID_STRIDE`, with part 0 for the
            first ellipsoid of an obstacle.
        table: support plane from perception, or None.
        note: reason why the observation is degraded; otherwise empty.
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
    """Reason for which the motion is held (stopped on its path); a separate note explains it."""

    NONE = "none"
    """The motion is not held."""
    DECIDING = "deciding"
    """The first decision of the motion is being computed."""
    SPEED_SCALE = "speed_scale"
    """The input `speed_scale` is 0."""
    SUPERVISOR = "supervisor"
    """The supervisor holds the motion. Set by the run monitor; the policy reports SPEED_SCALE."""
    OBSTACLES = "obstacles"
    """Obstacles are not observed, contain the tool or goal, or cannot be passed on any side."""


@dataclass(frozen=True, eq=False)
class PolicyState(Frozen):
    """State of the dynamic movement primitive (DMP) that generates the motion.

    Attributes:
        p_WE: (3,) position of the tool point E in the world frame [m].
        z_W: (3,) scaled velocity, the derivative of p_WE by normalized time
            s = t / (tau T), in the world frame [m]; T is the demonstrated duration [s].
        phase: phase k of the canonical system, 1 at the start and decaying to 0.
        tau: temporal scaling of the duration T [1].
        p_WS: (3,) start of the motion in the world frame [m].
        p_WG: (3,) goal in the world frame [m].
        R_WL: (3, 3) local frame: x from start to goal, z up.
        stamp: time of this state [s].
        speed: ds/dt, the rate of normalized time [1/s]; 1 / (tau T) at full speed, 0 when held.
        hold: reason for holding the motion.
        note: explanation of `hold`; empty if the motion is not held.
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
    """Motion of tool point and arm that the inference layer predicts from the current time on.

    Attributes:
        s: (T,) normalized times, increasing; (0,): no motion is planned.
        p_WE: (T, 3) positions of the tool point at these times in the world frame [m].
        q: (T, n) joint positions at these times [rad]; (0, n): no joint positions are planned.
        p_WS: (3,) start of the planned motion in the world frame [m]; (0,): the plan belongs to
            the current motion.
    """

    s: FloatArray = zeros(0)
    p_WE: FloatArray = zeros(0, 3)
    q: FloatArray = zeros(0, 0)
    p_WS: FloatArray = zeros(0)

    def __len__(self) -> int:
        return len(self.s)

    def joints(self, s: float | FloatArray) -> FloatArray:
        """Interpolates the joint positions (..., n) [rad] linearly at normalized times (...)."""
        return np.stack([np.interp(s, self.s, joint) for joint in self.q.T], axis=-1)


@dataclass(frozen=True, eq=False)
class Route(Frozen):
    """Selected passing side of each of M obstacles, and the cost rings it was selected from.

    A cost ring (Pairet et al., RA-L 2019) rates K directions of passing, evenly spaced on a circle
    around the baseline (the straight line from start to goal). Rows are those of the EllipsoidSet
    of the decision.

    Attributes:
        direction_W: (M, 3) selected direction omega_d on the circle in the local YZ plane, as a
            unit vector in the world frame.
        normal_W: (M, 3) unit normal x_L x omega_d of the plane in which each obstacle
            is passed; a positive rotation about it turns the baseline toward the selected side.
        remaining_clearance: (M,) clearance that guidance aims at on that side [m]; 0: no guidance.
        index: (M,) selected column of the rings.
        angles: (K,) angles of the directions [rad], 0 along local y, pi/2 along local z.
        costs: ring name -> (M, K) costs in [0, 1].
        path_length: estimated length of the avoiding path [m].
        p_WS: (3,) start of the motion for which the route was decided [m].
        p_WG: (3,) goal of that motion [m].
        R_WL: (3, 3) local frame of that motion.
        ids: (M,) IDs of the ellipsoids.
        blocked: whether every side of some obstacle is forbidden.
        note: reason why every side is forbidden; otherwise empty.
        side_cost: (N,) costs of N evenly spaced sides by user-supplied rings, as additional path
            length over the baseline; inf: forbidden.
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
        """Distance from start to goal [m]; 0 before the first decision."""
        return math.dist(self.p_WG, self.p_WS)


OUT_OF_WORLD = 25.0
"""Coordinate in the world frame beyond which an obstacle counts as absent [m]."""


@dataclass(frozen=True, eq=False)
class CouplingParameters(Frozen):
    """Parameters of M coupling terms, which turn the motion away from obstacles.

    With the angle theta between heading and obstacle, and the distance d, the turning rate is
    alpha sign(theta) exp(-theta^2 / psi^2) exp(-kappa d^2).

    Attributes:
        alpha: (M,) strength: turning rate in units of 1/T, T the demonstrated duration.
        psi: (M,) width of the response to the heading [rad].
        kappa: (M,) decay with the squared distance [1/m^2].
        in_range: (M,) False if the input of the regressor chain was outside its trained range and
            was clipped to it.
        center_W: (M, 3) centers of the terms in the world frame [m]; (0, 3): the centers of the
            ellipsoids.
        normal_W: (M, 3) normals of the planes in which the obstacles are passed. A nonzero row
            replaces the normal of the route and switches guidance off for it; (0, 3): no normals.
        tau: temporal scaling of the motion, replaces the scaling by the route's path length; 0:
            not set.
        hold: reason for holding the motion; NONE: it is not held.
        note: explanation of `hold`.
        restart: whether a motion at rest restarts from its current position.
        verified: whether roll-outs have verified the motion. The terms then act about `center_W`,
            do not belong to the perceived ellipsoids, and these do not hold the motion.
        ellipsoids: ellipsoids of verified terms that guidance steers past.
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
        """Returns the parameters as an (M, 3) array with columns alpha, psi, kappa."""
        return np.column_stack((self.alpha, self.psi, self.kappa))


DECIDING = "no motion from here is verified yet"
"""Note of a motion that is held until its first decision is active."""
