"""What keeps an obstacle that moves, appears or vanishes on its course."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from drake_oa.common.messages import FloatArray
from drake_oa.common.ports import valid_period
from drake_oa.scenario.obstacles import offset_at
from drake_oa.world.moving_obstacles import drive_force


class ObstacleMover(LeafSystem):
    """Drives an obstacle on slides along its waypoints, and away while it is absent.

    .. pydrake_system::

      name: ObstacleMover
      input_ports:
      - obstacle_state
      output_ports:
      - force

    - obstacle_state: (6,) offset and velocity of the obstacle in the world [m, m/s].
    - force: (3,) on its slides [N], with which it is on its course a step of the plant later.
    """

    def __init__(
        self,
        waypoints: FloatArray,
        *,
        mass: float,
        step: float,
        present: Sequence[float] = (),
    ) -> None:
        """Declares the ports.

        Args:
            waypoints: (N, 4) rows t, x, y, z with increasing t [s, m].
            mass: of the obstacle [kg].
            step: of the plant [s].
            present: [from] or [from, until], when it is there [s]; empty: always. N >= 1 then.

        Raises:
            ValueError: for waypoints of another shape, or times that do not increase; a mass
                or step that is not positive; a presence that is neither of these.
        """
        super().__init__()
        waypoints = np.array(waypoints, dtype=float)
        if waypoints.ndim != 2 or waypoints.shape[1] != 4 or not (len(waypoints) or present):
            raise ValueError(f"waypoints must be (N, 4) with N >= 1, not {waypoints.shape}")
        if len(present) > 2 or (np.diff(present) <= 0.0).any():
            raise ValueError(f"present must be [from] or [from, until] [s], not {present}")
        if not np.isfinite(waypoints).all() or (np.diff(waypoints[:, 0]) <= 0.0).any():
            raise ValueError("waypoints must be finite, and their times must increase")
        if not mass > 0.0:
            raise ValueError(f"mass must be positive [kg], not {mass}")
        self._waypoints, self._mass, self._step = waypoints, float(mass), valid_period(step)
        self._present = tuple(present)
        self._state = self.DeclareVectorInputPort("obstacle_state", 6)
        self.DeclareVectorOutputPort("force", 3, self._calc_force)

    def _calc_force(self, context: Context, output: BasicVector) -> None:
        x = self._state.Eval(context)
        target = offset_at(self._waypoints, context.get_time() + self._step, self._present)
        output.SetFromVector(drive_force(x[:3], x[3:], target, self._mass, self._step))
