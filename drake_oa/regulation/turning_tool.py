"""A tool that may be turned about an axis, and which turns there are."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from drake_oa.common.messages import FloatArray, Frozen
from drake_oa.geometry.rotation import unit_axis
from drake_oa.regulation.tool_turn_kernels import tool_clearance


@dataclass(frozen=True)
class TurnParameters:
    """Which turns there are, and what they cost.

    Attributes:
        largest: largest turn either way [rad].
        step: between the turns that are tried [rad].
        speed: how fast the tool turns at most [rad/s].
        margin: distance that the tool keeps from obstacles while it turns [m].
        price: of a radian, in baselines.
        hysteresis: price of a radian away from the turn in use, in baselines.
        period: time between looks at other turns [s].

    Raises:
        ValueError: for a value that is not finite, negative, or 0 where that makes no sense.
    """

    largest: float = math.pi / 2.0
    step: float = math.pi / 12.0
    speed: float = 1.0
    margin: float = 0.03
    price: float = 0.1
    hysteresis: float = 0.02
    period: float = 0.25

    def __post_init__(self) -> None:
        for name in ("largest", "step", "speed", "period"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be finite and positive, not {getattr(self, name)}")
        for name in ("margin", "price", "hysteresis"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(
                    f"{name} must be finite and not negative, not {getattr(self, name)}"
                )

    @property
    def turns(self) -> list[float]:
        """Those that are tried, the smallest first, either way [rad]."""
        count = math.floor(self.largest / self.step + 1e-9)
        steps = [self.step * n for n in range(1, count + 1)]
        if self.largest - count * self.step > 1e-6:
            steps.append(self.largest)
        return [0.0, *(sign * turn for turn in steps for sign in (1.0, -1.0))]


@dataclass(frozen=True, eq=False)
class TurningTool(Frozen):
    """A tool of convex parts that is turned about an axis of the world through E.

    Attributes:
        parts: (K_i, 3) vertices of each part from E, in W, at turn 0 [m].
        axis: (3,) unit vector in W.
        center: (B, 3) centres of the boxes round the parts [m].
        R: (B, 3, 3) their rotations R_WB.
        half: (B, 3) half their edges [m].
    """

    parts: tuple[FloatArray, ...]
    axis: FloatArray
    center: FloatArray
    R: FloatArray
    half: FloatArray

    @classmethod
    def of(
        cls, parts: tuple[FloatArray, ...] | list[FloatArray], axis: FloatArray, R_WE: FloatArray
    ) -> TurningTool:
        """A tool by its parts.

        Args:
            parts: (K_i, 3) vertices from E in W [m].
            axis: (3,) in W, of any length but 0.
            R_WE: (3, 3) orientation of the tool at turn 0, along which its boxes are.

        Raises:
            ValueError: for an axis without direction, or no parts.
        """
        if not len(parts):
            raise ValueError("a tool needs at least one part")
        low = np.array([(part @ R_WE).min(axis=0) for part in parts])
        high = np.array([(part @ R_WE).max(axis=0) for part in parts])
        return cls(
            tuple(np.array(part, dtype=float) for part in parts),
            unit_axis(axis),
            np.ascontiguousarray(0.5 * (low + high) @ R_WE.T),
            np.ascontiguousarray(np.broadcast_to(R_WE, (len(parts), 3, 3))),
            0.5 * (high - low),
        )

    @property
    def corners(self) -> FloatArray:
        """(K, 3) vertices of all parts at turn 0 [m]."""
        return np.concatenate(self.parts)

    def clearance(
        self, points: FloatArray, places: FloatArray, turns: FloatArray, most: float
    ) -> FloatArray:
        """Least distance to points (N, 3) at places (P, 3) and turns (A,), (P, A).

        It is 0 inside, and `most` where it is more [m].
        """
        return np.asarray(
            tool_clearance(
                np.ascontiguousarray(points, dtype=float),
                np.ascontiguousarray(places, dtype=float),
                np.ascontiguousarray(turns, dtype=float),
                self.axis,
                self.center,
                self.R,
                self.half,
                most,
            )
        )
