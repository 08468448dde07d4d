"""Faults of a scenario as systems: of a camera, of the actuators, and pushes from outside.

    faults: [!CameraDropout {start: 1.0, duration: 0.5}, !TorqueSaturation {start: 2.0}]

A fault lasts for start <= t < start + duration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue, Value
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State
from pydrake.systems.sensors import CameraInfo, ImageDepth32F

from drake_oa.common.messages import FloatArray, Frozen
from drake_oa.common.ports import AbstractInput, valid_period
from drake_oa.scenario.faults import CameraDropout, Push, TorqueSaturation

_TIME_TOLERANCE = 1e-6
"""Rounding error of a time [s]."""


def _lasts(fault: CameraDropout | Push | TorqueSaturation, context: Context) -> bool:
    """Checks whether a fault lasts at the time of a Context."""
    return 0.0 <= context.get_time() + _TIME_TOLERANCE - fault.start < fault.duration


@dataclass(frozen=True, eq=False)
class _Frame(Frozen):
    """An image and the robot's state when it was taken."""

    stamp: float
    data: NDArray[np.float32]
    robot_state: FloatArray


class CameraFaults(LeafSystem):
    """What a camera's driver hands out while no new image arrives.

    .. pydrake_system::

      name: CameraFaults
      input_ports:
      - depth_image
      - robot_state
      output_ports:
      - depth_image
      - image_stamp
      - robot_state

    - depth_image (in): ImageDepth32F as the camera takes it [m].
    - robot_state (in): (num_states,) vector [q, v] of the robot.
    - depth_image (out): ImageDepth32F [m]: during a dropout the last one before it; all NaN
      while there was none.
    - image_stamp: (1,) time at which that image was taken [s]; -inf while there was none.
    - robot_state (out): the robot's state at that time, as a driver pairs them.

    Without a dropout the outputs are the inputs. The last frame, one of which is taken every
    `period`, is kept in the Context.
    """

    def __init__(
        self,
        faults: Sequence[CameraDropout],
        camera: CameraInfo,
        *,
        num_states: int,
        period: float = 1.0 / 15.0,
    ) -> None:
        """Declares ports, state and events.

        Args:
            faults: when no image arrives.
            camera: the depth camera's intrinsics.
            num_states: size of the robot's state.
            period: time between frames, that of the perception behind [s].

        Raises:
            ValueError: for a period that is not positive.
        """
        super().__init__()
        self._faults = tuple(faults)
        period = valid_period(period)
        missing = np.full((camera.height(), camera.width(), 1), np.nan, dtype=np.float32)
        nothing = _Frame(-np.inf, missing, np.zeros(num_states))
        self._image_port = AbstractInput(self, "depth_image", ImageDepth32F)
        self._robot_port = self.DeclareVectorInputPort("robot_state", num_states)
        self._last = self.DeclareAbstractState(Value(nothing))
        late = {self.time_ticket(), self.abstract_state_ticket(self._last)}
        self.DeclareAbstractOutputPort(
            "depth_image",
            lambda: Value(ImageDepth32F()),
            self._calc_image,
            {*late, self._image_port.ticket()},
        )
        self.DeclareVectorOutputPort("image_stamp", 1, self._calc_stamp, late)
        self.DeclareVectorOutputPort(
            "robot_state", num_states, self._calc_robot, {*late, self._robot_port.ticket()}
        )
        self.DeclareInitializationUnrestrictedUpdateEvent(self._keep)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, period, self._keep)

    def _last_frame(self, context: Context) -> _Frame | None:
        """The frame that stands in for the present one; None: that one arrives."""
        if not any(_lasts(fault, context) for fault in self._faults):
            return None
        frame: _Frame = context.get_abstract_state(int(self._last)).get_value()
        return frame

    def _keep(self, context: Context, state: State) -> None:
        if self._last_frame(context) is None:
            image: Any = self._image_port.read(context)
            x = np.array(self._robot_port.Eval(context))
            frame = _Frame(context.get_time(), image.data.copy(), x)
            state.get_mutable_abstract_state(int(self._last)).set_value(frame)

    def _calc_image(self, context: Context, output: AbstractValue) -> None:
        last = self._last_frame(context)
        if last is None:
            output.set_value(self._image_port.read(context))
            return
        height, width, _ = last.data.shape
        image: Any = output.get_mutable_value()
        image.resize(width, height)
        image.mutable_data[:] = last.data

    def _calc_stamp(self, context: Context, output: BasicVector) -> None:
        last = self._last_frame(context)
        output.SetAtIndex(0, context.get_time() if last is None else last.stamp)

    def _calc_robot(self, context: Context, output: BasicVector) -> None:
        last = self._last_frame(context)
        x: Any = self._robot_port.Eval(context) if last is None else last.robot_state
        output.SetFromVector(x)


class ExternalPush(LeafSystem):
    """Applies the wrenches of pushes to bodies of a plant.

    .. pydrake_system::

      name: ExternalPush
      input_ports:
      output_ports:
      - spatial_forces

    - spatial_forces: abstract list of `ExternallyAppliedSpatialForce`, one a push, at the
      origin of its body, in the world frame [N, N m]; zero before and after it. For the port
      `applied_spatial_force` of a `MultibodyPlant`.
    """

    def __init__(self, pushes: Sequence[tuple[Push, BodyIndex]]) -> None:
        """Declares the port.

        Args:
            pushes: each with the body that it acts on.
        """
        super().__init__()
        self._pushes = tuple(pushes)
        self.DeclareAbstractOutputPort(
            "spatial_forces",
            lambda: AbstractValue.Make([ExternallyAppliedSpatialForce()]),
            self._calc,
            {self.time_ticket()},
        )

    def _calc(self, context: Context, output: AbstractValue) -> None:
        forces = []
        for push, body in self._pushes:
            scale = float(_lasts(push, context))
            applied = ExternallyAppliedSpatialForce()
            applied.body_index = body
            applied.p_BoBq_B = np.zeros(3)
            applied.F_Bq_W = SpatialForce(
                tau=scale * np.array(push.torque), f=scale * np.array(push.force)
            )
            forces.append(applied)
        output.set_value(forces)


class WeakActuators(LeafSystem):
    """Cuts the actuation off at shrunken effort limits while a fault says so.

    .. pydrake_system::

      name: WeakActuators
      input_ports:
      - actuation
      output_ports:
      - actuation

    - actuation (in): (n,) what the controller asks for [N m, N].
    - actuation (out): (n,) what the actuators give: not more than `scale` of the effort
      limits while a `TorqueSaturation` lasts, else all of it.
    """

    def __init__(self, faults: Sequence[TorqueSaturation], effort_limits: FloatArray) -> None:
        """Declares the ports.

        Args:
            faults: times and remaining shares of the effort limits.
            effort_limits: (n,) of the actuators, in the plant's order [N m, N].
        """
        super().__init__()
        self._faults, self._limits = tuple(faults), effort_limits
        self._requested = self.DeclareVectorInputPort("actuation", len(effort_limits))
        self.DeclareVectorOutputPort(
            "actuation",
            len(effort_limits),
            self._calc,
            {self.time_ticket(), self._requested.ticket()},
        )

    def _calc(self, context: Context, output: BasicVector) -> None:
        scales = [fault.scale for fault in self._faults if _lasts(fault, context)]
        limit = min(scales, default=np.inf) * self._limits
        output.SetFromVector(np.clip(self._requested.Eval(context), -limit, limit))
