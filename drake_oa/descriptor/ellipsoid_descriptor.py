"""Systems of the descriptor layer, which output ellipsoids of perceived or given obstacles."""

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
    """System that computes an ellipsoid for each obstacle, dilated by the tool.

    .. pydrake_system::

      name: EllipsoidDescriptor
      input_ports:
      - obstacles_W
      - goal (optional)
      output_ports:
      - ellipsoids_W

    - obstacles_W: abstract `ObstacleClouds`, points of the obstacles in the world frame
      [m]; may be empty.
    - goal (optional): (3,) goal of the motion in the world frame [m], a position of the tool point
      that is known to be free. Not connected: only the constructor's `free_W` is known to be free.
    - ellipsoids_W: abstract `EllipsoidSet` in the world frame, with the stamp, IDs, velocities and
      support plane (`table`) of the clouds, and their `note`, the reason why the observation is
      degraded. An obstacle without finite points is omitted, and the note names the obstacle. If an
      enclosing ellipsoid would contain a position that is known to be free, or be closer than 2 cm
      to one, the obstacle is divided into parts. If their ellipsoids have a larger distance from
      the free positions, the obstacle has several rows, one for each of these ellipsoids.

    The system has no state. The output is cached until an input changes. The computation is
    described in `drake_oa.descriptor.descriptor.describe`.
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
            tool_W: (K, 3) vertices of the tool's convex hull relative to the tool point, in world
                orientation [m]. The orientation is assumed constant. [[0, 0, 0]] for a point.
            method: "enclosing": the minimum-volume ellipsoid that contains all dilated points.
                "least_squares": the least-squares ellipsoid of Pairet et al., RA-L 2019; some
                points stay outside.
            free_W: (F, 3) positions of the tool point in the world frame that are known to be free,
                such as the start [m].
            tool_parts: vertices (K_i, 3) of each convex part of the tool, relative to the tool
                point in world orientation [m]. Each part of a divided obstacle is dilated by
                each part of the tool; empty: by the whole tool.

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
    """Source of a constant set of ellipsoids, the obstacles of a scenario without perception.

    .. pydrake_system::

      name: GivenEllipsoidSource
      output_ports:
      - ellipsoids_W

    - ellipsoids_W: abstract `EllipsoidSet` in the world frame.

    The system replaces Drake's `ConstantValueSource`, whose output counts as changed at each time
    step, so that all dependent values are computed again. The output of this system never changes.
    """

    def __init__(self, ellipsoids: EllipsoidSet) -> None:
        """Declares the output port.

        Args:
            ellipsoids: constant output. With a stamp of `np.inf` the output is never too old;
                otherwise the policy holds the motion as soon as the stamp is older than
                `policy.max_observation_age`.
        """
        super().__init__()
        self.DeclareAbstractOutputPort(
            "ellipsoids_W",
            lambda: Value(ellipsoids),
            lambda context, output: output.set_value(ellipsoids),
            prerequisites_of_calc={self.nothing_ticket()},
        )
