"""The descriptor layer: obstacles and tool as ellipsoids, found or given."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import ArrayLike
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import Context, LeafSystem

from drake_oa.common.messages import EllipsoidSet, FloatArray, ObstacleClouds
from drake_oa.common.ports import AbstractInput
from drake_oa.descriptor.descriptor import Method, describe
from drake_oa.geometry.ellipsoid import checked_points


class EllipsoidDescriptor(LeafSystem):
    """Dilates each obstacle by the tool and encloses the result in an ellipsoid.

    .. pydrake_system::

      name: EllipsoidDescriptor
      input_ports:
      - obstacles_W
      - goal (optional)
      output_ports:
      - ellipsoids_W

    - obstacles_W: abstract `ObstacleClouds`, points of the obstacles in the world frame
      [m]; may be empty.
    - goal (optional): (3,) a tool point that is known to be free besides `free_W`, the goal
      of a motion whose goal may be moved [m].
    - ellipsoids_W: abstract `EllipsoidSet` in the world frame, with the stamp, names,
      velocities, table and note of the clouds; an obstacle without a finite point is dropped
      and noted. One that would hold a free point, or all but do so, has several rows.

    There is no state. The output is computed when it is asked for, once for each
    change of the input.
    """

    def __init__(
        self,
        tool_W: ArrayLike,
        *,
        method: Method = "enclosing",
        free_W: ArrayLike = (),
        tool_parts: Sequence[FloatArray] = (),
    ) -> None:
        """Declares the ports.

        Args:
            tool_W: (K, 3) vertices of the tool's convex geometry from the TCP, in world
                orientation [m]: the tool keeps it while it passes obstacles.
                [[0, 0, 0]] for a point.
            method: "enclosing": the smallest ellipsoid that holds every dilated point.
                "least_squares": the paper's superquadric, which leaves some outside.
            free_W: (F, 3) tool points that are known to be free: start and goal [m].
            tool_parts: (K_i, 3) vertices of the tool's convex parts, for obstacles near
                those points [m]; none: the whole tool.

        Raises:
            ValueError: if the tool or a part of it is empty, not (K, 3) or not finite, or free_W is
                not (F, 3) or not finite.
        """
        super().__init__()
        free = np.array(free_W, dtype=float)
        self._free_W = checked_points(free, "free_W") if len(free) else np.zeros((0, 3))
        self._describe = partial(
            describe,
            tool_W=np.array(checked_points(tool_W, "tool_W")),
            method=method,
            tool_parts=[np.array(checked_points(part, "tool_parts")) for part in tool_parts],
        )
        self._obstacles = AbstractInput(self, "obstacles_W", ObstacleClouds)
        self._goal = self.DeclareVectorInputPort("goal", 3)
        self.DeclareAbstractOutputPort(
            "ellipsoids_W",
            lambda: Value(EllipsoidSet()),
            self._calc_ellipsoids,
            prerequisites_of_calc={self._obstacles.ticket(), self._goal.ticket()},
        )

    def _calc_ellipsoids(self, context: Context, output: AbstractValue) -> None:
        obstacles = self._obstacles.read(context)
        free_W = self._free_W
        if self._goal.HasValue(context):
            free_W = np.vstack([free_W, self._goal.Eval(context)])
        output.set_value(self._describe(obstacles, free_W=free_W))


class GivenEllipsoidSource(LeafSystem):
    """Hands out one set of ellipsoids, always the same.

    .. pydrake_system::

      name: GivenEllipsoidSource
      output_ports:
      - ellipsoids_W

    - ellipsoids_W: abstract `EllipsoidSet` in the world frame.

    Drake's `ConstantValueSource` counts as new at every instant, and with it all that is
    computed from it; this output depends on nothing.
    """

    def __init__(self, ellipsoids: EllipsoidSet) -> None:
        """Declares the port.

        Args:
            ellipsoids: what is handed out; with a stamp of `np.inf` they are never out of
                date, with another one the policy is held when it has become too old.
        """
        super().__init__()
        self.DeclareAbstractOutputPort(
            "ellipsoids_W",
            lambda: Value(ellipsoids),
            lambda context, output: output.set_value(ellipsoids),
            prerequisites_of_calc={self.nothing_ticket()},
        )
