"""A logged motion on ports, as it was."""

from __future__ import annotations

from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from drake_oa.common.messages import EllipsoidSet, FloatArray, PolicyState
from drake_oa.runs.replay import LoggedMotion


class LogPlayer(LeafSystem):
    """Plays a logged motion: at each instant what was logged last.

    .. pydrake_system::

      name: LogPlayer
      output_ports:
      - positions
      - ellipsoids_W
      - policy_state
      - body_poses

    - positions: (n,) positions of the world's plant, in its order [rad, m].
    - ellipsoids_W: abstract `EllipsoidSet` in the world frame, the observation that had
      arrived last.
    - policy_state: abstract `PolicyState`; its z_W is the desired velocity: the log knows
      the direction alone.
    - body_poses: list of one `RigidTransform`, whose origin is the actual tool point E;
      its axes are the world's.

    There is no state: the outputs depend on time alone.
    """

    def __init__(self, motion: LoggedMotion, positions: FloatArray, *, speed: float = 1.0) -> None:
        """Declares the ports.

        Args:
            motion: what is played.
            positions: (T, n) positions of the world's plant at its instants [rad, m].
            speed: logged seconds that pass in one simulated second.

        Raises:
            ValueError: if speed is not positive, or T is not that of the motion.
        """
        super().__init__()
        if not 0.0 < speed < float("inf"):
            raise ValueError(f"speed must be positive, not {speed}")
        if len(positions) != len(motion.log.t):
            raise ValueError(
                f"positions: {len(positions)} rows for the {len(motion.log.t)} instants of the log"
            )
        self._motion = motion
        self._world = positions
        self._speed = speed
        now = {self.time_ticket()}
        self.DeclareVectorOutputPort("positions", positions.shape[1], self._calc_positions, now)
        self.DeclareAbstractOutputPort(
            "ellipsoids_W", lambda: Value(EllipsoidSet()), self._calc_ellipsoids, now
        )
        self.DeclareAbstractOutputPort(
            "policy_state", lambda: Value(PolicyState()), self._calc_policy, now
        )
        self.DeclareAbstractOutputPort(
            "body_poses", Value[list[RigidTransform]], self._calc_poses, now
        )

    def _time(self, context: Context) -> float:
        return self._speed * float(context.get_time())

    def _calc_positions(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._world[self._motion.row(self._time(context))])

    def _calc_ellipsoids(self, context: Context, output: AbstractValue) -> None:
        output.set_value(self._motion.ellipsoids(self._time(context)))

    def _calc_policy(self, context: Context, output: AbstractValue) -> None:
        output.set_value(self._motion.policy_state(self._time(context)))

    def _calc_poses(self, context: Context, output: AbstractValue) -> None:
        p_WE = self._motion.log.p_WE[self._motion.row(self._time(context))]
        output.set_value([RigidTransform(p_WE)])
