"""Immutable messages that the layers exchange on abstract ports.

A message is a frozen dataclass of read-only arrays. Copying it is free (``__deepcopy__`` returns
the message itself): a Drake Context that contains a message clones in constant time, and no
receiver can change the input of another. The suffix _W means "in the world frame W": p_WO is the
position and R_WO the orientation of an obstacle O in W. E is the tool point, S the start and G the
goal of the motion.
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
"""Difference between the IDs of two consecutive ellipsoids (parts) of one obstacle.

The ID of an ellipsoid is track ID + part * PART_ID_STRIDE, with part = 0, 1, ...; the track ID, the
number of the obstacle in perception, is the remainder ID % PART_ID_STRIDE."""


class Frozen:
    """Base class of immutable dataclasses with read-only arrays.

    A copy of an instance is the instance itself.
    """

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
    """Returns a dataclass field whose default is an array of zeros.

    Args:
        shape: shape of the array.
        kind: data type of the elements.
    """
    return field(default_factory=lambda: np.zeros(shape, dtype=kind))


@dataclass(frozen=True, eq=False)
class TablePlane(Frozen):
    """Support plane of the objects, usually a table.

    Points Q of the plane satisfy ``normal_W . p_WQ = offset``.

    Attributes:
        normal_W: (3,) unit normal in the world frame, pointing to the free space above the table.
        offset: signed distance of the plane from the world origin along the normal [m].
    """

    normal_W: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    offset: float = 0.0

    def height(self, p_WQ: FloatArray) -> FloatArray:
        """Computes the signed heights (...) of points above the plane [m].

        Args:
            p_WQ: (..., 3) positions of the points in the world frame [m].
        """
        return np.asarray(p_WQ @ self.normal_W - self.offset)

    def distance_to(self, other: TablePlane) -> float:
        """Computes an upper bound of the height difference between this plane and another [m].

        The bound ``|offset_1 - offset_2| + |normal_1 - normal_2| * 1 m`` is valid within 1 m of the
        world origin.
        """
        turn = np.linalg.norm(self.normal_W - other.normal_W)
        return abs(self.offset - other.offset) + float(turn)


@dataclass(frozen=True, eq=False)
class ObstacleClouds(Frozen):
    """Point clouds of M perceived obstacles at one instant.

    Attributes:
        stamp: time of the observation [s]; -inf before the first observation.
        clouds_W: for each obstacle an (N_i, 3) array of surface points in the world frame [m].
        ids: (M,) distinct track IDs: numbers that obstacles keep from one observation to the next.
        table: support plane of the objects; None if no plane was detected.
        note: reason why this observation is degraded, such as "no valid pixel"; otherwise empty.
        v_WO: (M, 3) velocities of the obstacles in the world frame [m/s], exactly zero for an
            obstacle that perception classifies as at rest; zeros by default.

    Raises:
        ValueError: if an array has another shape, a cloud is not of floats, or IDs repeat.
    """

    stamp: float = -np.inf
    clouds_W: tuple[FloatArray, ...] = ()
    ids: IntArray = zeros(0, kind=np.int64)
    table: TablePlane | None = None
    note: str = ""
    v_WO: FloatArray = zeros(0, 3)

    def __post_init__(self) -> None:
        count = len(self.clouds_W)
        if not len(self.v_WO) and count:
            object.__setattr__(self, "v_WO", np.zeros((count, 3)))
        super().__post_init__()
        for cloud in self.clouds_W:
            if getattr(cloud, "ndim", 0) != 2 or cloud.shape[1] != 3 or cloud.dtype.kind != "f":
                actual = f"{type(cloud).__name__} {np.shape(cloud)} of {np.asarray(cloud).dtype}"
                raise ValueError(f"clouds_W: must be (N, 3) arrays of floats, not {actual}")
        shapes = [getattr(array, "shape", None) for array in (self.ids, self.v_WO)]
        if shapes != [(count,), (count, 3)] or len(set(self.ids.tolist())) < count:
            expected = f"({count},) of distinct integers and ({count}, 3) of floats"
            raise ValueError(f"ids, v_WO: must be arrays {expected}, not {self.ids}, {shapes[1]}")

    def __len__(self) -> int:
        return len(self.clouds_W)


@dataclass(frozen=True, eq=False)
class EllipsoidSet(Frozen):
    """Descriptors of obstacles: M ellipsoids, one or several per obstacle.

    Each ellipsoid describes an obstacle or a part of it, dilated by the tool or a part of the tool.

    Because of the dilation, the tool is treated as its tool point E.

    Attributes:
        stamp: time of the observation from which the ellipsoids were computed [s]; -inf before the
            first observation, inf for ellipsoids that a scenario states.
        p_WO: (M, 3) centers in the world frame [m].
        R_WO: (M, 3, 3) rotations, whose columns are the principal axes in the world frame.
        semi_axes: (M, 3) semi-axes along the principal axes [m].
        v_WO: (M, 3) velocities of the centers in the world frame [m/s].
        ids: (M,) unique IDs of the ellipsoids: track ID of the obstacle + part * `PART_ID_STRIDE`,
            with part = 0, 1, ... for the ellipsoids that describe one obstacle.
        table: support plane of the objects; None if perception detected no plane.
        note: reason why the observation is degraded, such as "no valid pixel"; otherwise empty.
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
    """Reason for which a motion is held, that is, stopped on its path."""

    NONE = "none"
    """Absence of a hold: the motion is not held."""
    DECIDING = "deciding"
    """Hold at the start of a motion until the first motion has been selected by simulations."""
    SPEED_SCALE = "speed_scale"
    """Hold because the input port `speed_scale` of the policy (`DmpIntegrator`), the fraction of
    full speed, is 0."""
    SUPERVISOR = "supervisor"
    """Hold because the safety system `MotionGuard` has set the speed scale of the policy to 0. Only
    logs and reports use this value; the policy itself reports SPEED_SCALE."""
    GOAL = "goal"
    """Hold because the input port `goal` of the policy is not finite; its last finite value remains
    the goal."""
    OBSTACLES = "obstacles"
    """Hold because of obstacles: the last observation is missing or too old, the ellipsoid of an
    obstacle contains the tool point or the goal, or the obstacles cannot be passed."""


@dataclass(frozen=True, eq=False)
class PolicyState(Frozen):
    """State of the dynamic movement primitive (DMP) that generates the motion of the tool point.

    Attributes:
        p_WE: (3,) position of the tool point E in the world frame [m].
        z_W: (3,) scaled velocity, the derivative of p_WE by normalized time
            s = t / (tau T), in the world frame [m]; T is the demonstrated duration [s].
        phase: phase k of the canonical system, 1 at the start and decaying to 0.
        tau: temporal scaling, by which the demonstrated duration T is multiplied [-].
        p_WS: (3,) start of the motion in the world frame [m].
        p_WG: (3,) goal in the world frame [m].
        R_WL: (3, 3) orientation of the local frame L of the motion in the world: x from start to
            goal, z up.
        stamp: time of this state [s].
        speed: ds/dt, the rate of normalized time s [1/s]; 1 / (tau T) at full speed, 0 when held.
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
        """Distance from start to goal of the motion [m]."""
        return math.dist(self.p_WG, self.p_WS)


@dataclass(frozen=True, eq=False)
class PlannedMotion(Frozen):
    """Motion of tool point and arm, planned from the current time to the end of the motion.

    Normalized time is the time since the start of the motion, divided by tau times the demonstrated
    duration; tau is the temporal scaling.

    Attributes:
        s: (T,) normalized times, increasing; (0,): no motion is planned.
        p_WE: (T, 3) positions of the tool point at these times in the world frame [m].
        q: (T, n) joint positions of the arm at these times [rad]; (0, n): no joint positions are
            planned.
        p_WS: (3,) start of the motion to which the plan belongs, in the world frame [m]. When the
            movement primitive has restarted from another point, the plan is outdated. (0,): the
            plan is valid for every start.
    """

    s: FloatArray = zeros(0)
    p_WE: FloatArray = zeros(0, 3)
    q: FloatArray = zeros(0, 0)
    p_WS: FloatArray = zeros(0)

    def __len__(self) -> int:
        return len(self.s)

    def joints(self, s: float | FloatArray) -> FloatArray:
        """Interpolates the planned joint positions linearly.

        Args:
            s: (...) normalized times. Before the first and after the last time of the plan, the
                first or last joint positions are returned.

        Returns:
            (..., n) joint positions [rad].
        """
        return np.stack([np.interp(s, self.s, joint) for joint in self.q.T], axis=-1)


@dataclass(frozen=True, eq=False)
class Route(Frozen):
    """Selected side on which each of M obstacles is passed, and the cost rings of this selection.

    A cost ring (Pairet et al., RA-L 2019) rates K directions in which an obstacle can be passed.
    The directions are evenly spaced on a circle around the baseline (the straight line from start
    to goal). Heading guidance is the coupling term that turns the motion to the selected side. Rows
    are those of the EllipsoidSet from which the sides were selected.

    Attributes:
        direction_W: (M, 3) selected direction omega_d, a unit vector in the world frame orthogonal
            to the baseline.
        normal_W: (M, 3) unit normal x_L x omega_d of the plane in which each obstacle is passed,
            with the direction x_L of the baseline; a positive rotation about this normal turns the
            baseline toward the selected side.
        remaining_clearance: (M,) clearance from each ellipsoid that heading guidance aims at on the
            selected side [m]: the requested clearance, or the distance from the ellipsoid to the
            start or goal if that is smaller; 0: no guidance.
        index: (M,) index of the selected direction among the K directions.
        angles: (K,) angles of the directions about the x axis of the local frame L [rad], 0 along
            its y axis, pi/2 along its z axis.
        costs: costs (M, K) in [0, 1] by the name of the ring.
        path_length: estimated length of the path past all obstacles on the selected sides [m].
        p_WS: (3,) start of the motion for which the sides were selected, in the world frame [m].
        p_WG: (3,) goal of this motion in the world frame [m].
        R_WL: (3, 3) orientation of the local frame L of this motion in the world: x from start to
            goal, z up.
        ids: (M,) IDs of the ellipsoids.
        blocked: whether every side of at least one obstacle is forbidden.
        note: if `blocked`, the reason, which names the obstacles; otherwise empty.
        side_cost: (N,) costs of N evenly spaced sides by user-supplied cost rings: for each side,
            the cost of passing all obstacles on it, as additional path length divided by the
            distance from start to goal [-]; inf: the side is forbidden. (1,) zero: no such rings.
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
        """Distance from start to goal of the motion for which the sides were selected [m]; 0 before
        the first selection.
        """
        return math.dist(self.p_WG, self.p_WS)


OUT_OF_WORLD = 25.0
"""Magnitude of an obstacle's world coordinate above which the obstacle counts as absent [m].

The simulated station raises an obstacle by 50 m before it appears and after it vanishes."""


@dataclass(frozen=True, eq=False)
class CouplingParameters(Frozen):
    """Parameters of M coupling terms, which turn the motion away from obstacles.

    The turning rate is alpha sign(theta) exp(-theta^2 / psi^2) exp(-kappa d^2). theta is the angle
    from the direction of the obstacle's center to the heading, and d the distance of the tool point
    from this center.

    Attributes:
        alpha: (M,) strength: turning rate in units of 1/T, with the demonstrated duration T.
        psi: (M,) width of the response to the heading [rad].
        kappa: (M,) decay with the squared distance [1/m^2].
        in_range: (M,) False if the input of the regressor chain (the networks that compute alpha,
            psi and kappa) was outside its trained range and was clipped to it.
        center_W: (M, 3) centers of the terms in the world frame [m]; (0, 3): the centers of the
            perceived ellipsoids.
        normal_W: (M, 3) normals in the world frame of the planes in which the obstacles are
            passed; (0, 3): no normals. A nonzero row replaces the row of `Route.normal_W`, the
            normal for the selected side. For this obstacle, the row also switches off heading
            guidance, the term that turns the motion to the selected side. The motion turns away
            from the center for both signs of a normal. The sign determines the side only for a
            heading straight toward the center.
        tau: temporal scaling of the motion (factor on the demonstrated duration). A nonzero value
            replaces the scaling that the policy computes from `Route.path_length`, the length of
            the path past the obstacles; 0: not set.
        hold: reason for holding the motion; NONE: the coupling terms do not hold the motion.
        note: explanation of `hold`.
        restart: whether a motion at rest restarts, with the current position as its new start.
        verified: whether roll-outs (simulations) have verified the motion. The coupling terms then
            act about `center_W` and do not belong to the perceived ellipsoids. A tool or goal
            inside a perceived ellipsoid then does not hold the motion.
        ellipsoids: if `verified`, the ellipsoids past which heading guidance turns the motion, in
            place of the perceived ones.
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
        """Returns the parameters as an (M, 3) array with columns alpha, psi, kappa.

        Their units are 1/T, with the demonstrated duration T, then rad, then 1/m^2.
        """
        return np.column_stack((self.alpha, self.psi, self.kappa))


DECIDING = "no motion from here is verified yet"
"""Text of the field `note` of `PolicyState` while a motion is held at its start, until the first
motion that simulations have verified is selected."""
