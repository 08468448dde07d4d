"""A depth camera whose images come late, as a real one's, and are rendered meanwhile."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State
from pydrake.systems.sensors import CameraInfo, ImageDepth32F

from drake_oa.common.messages import FloatArray, Frozen
from drake_oa.common.ports import valid_period
from drake_oa.world.background_camera import BackgroundCamera, Rendered


@dataclass(frozen=True, eq=False)
class _Taken(Frozen):
    """When images were taken, and of which state: the one before the last, and the last."""

    stamp: tuple[float, ...] = ()
    state: tuple[FloatArray, ...] = field(default=())


class LateCamera(LeafSystem):
    """Takes a depth image every period, and hands it out some time after.

    .. pydrake_system::

      name: LateCamera
      input_ports:
      - plant_state
      output_ports:
      - depth_image
      - camera_pose
      - image_time
      - plant_state

    - plant_state (in): (n,) vector [q, v] of the simulated plant, everything that moves.
    - depth_image: ImageDepth32F along the optical axis [m]; 0 is too near, inf too far; with
      noise NaN is missing, for whatever reason.
    - camera_pose: RigidTransform X_WC of the camera when the image was taken.
    - image_time: (1,) time at which it was taken [s].
    - plant_state (out): (n,) the state then.

    The first image is there at once: a camera runs before the robot does. The Context holds
    times and states; the image is a function of them, rendered in the background from when it
    is taken on, with its noise, and waited for where it is asked for before it is ready.
    """

    def __init__(
        self,
        camera: BackgroundCamera,
        intrinsics: CameraInfo,
        *,
        num_states: int,
        period: float,
        delay: float,
    ) -> None:
        """Declares ports, state and events.

        Args:
            camera: what renders.
            intrinsics: of its image.
            num_states: size n of the plant's state.
            period: time between images [s].
            delay: time from taking an image to its coming [s].

        Raises:
            ValueError: unless 0 < delay < period.
        """
        super().__init__()
        period = valid_period(period)
        if not 0.0 < delay < period:
            raise ValueError(f"delay must be between 0 and the period {period} s, not {delay}")
        self._camera, self._delay = camera, delay
        size = (intrinsics.width(), intrinsics.height())
        self._state_port = self.DeclareVectorInputPort("plant_state", num_states)
        self._taken = self.DeclareAbstractState(Value(_Taken()))
        shown = {
            self.time_ticket(),
            self.abstract_state_ticket(self._taken),
            self._state_port.ticket(),
        }
        self.DeclareAbstractOutputPort(
            "depth_image", lambda: Value(ImageDepth32F(*size)), self._calc_image, shown
        )
        self.DeclareAbstractOutputPort(
            "camera_pose", lambda: Value(RigidTransform()), self._calc_pose, shown
        )
        self.DeclareVectorOutputPort("image_time", 1, self._calc_time, shown)
        self.DeclareVectorOutputPort("plant_state", num_states, self._calc_state, shown)
        self.DeclareInitializationUnrestrictedUpdateEvent(self._take)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, period, self._take)

    def release(self) -> None:
        """See `BackgroundCamera.release`."""
        self._camera.release()

    def _read(self, context: Context) -> _Taken:
        taken: _Taken = context.get_abstract_state(self._taken).get_value()
        return taken

    def _take(self, context: Context, state: State) -> None:
        before = self._read(context)
        x = np.array(self._state_port.Eval(context))
        self._camera.ask(x, context.get_time())
        after = _Taken((*before.stamp[-1:], context.get_time()), (*before.state[-1:], x))
        state.get_mutable_abstract_state(self._taken).set_value(after)

    def _shown(self, context: Context) -> tuple[float, FloatArray]:
        """Time and state of the image that has come last."""
        taken, now = self._read(context), context.get_time()
        if not taken.stamp:
            return now, self._state_port.Eval(context)
        arrived = taken.stamp[-1] + self._delay <= now + 1e-9 or len(taken.stamp) == 1
        row = -1 if arrived else 0
        return taken.stamp[row], taken.state[row]

    def _rendered(self, context: Context) -> Rendered:
        time, state = self._shown(context)
        return self._camera.ask(state, time).result()

    def _calc_image(self, context: Context, output: AbstractValue) -> None:
        image: Any = output.get_mutable_value()
        image.mutable_data[:, :, 0] = self._rendered(context).depth

    def _calc_pose(self, context: Context, output: AbstractValue) -> None:
        output.set_value(self._rendered(context).X_WC)

    def _calc_time(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, self._shown(context)[0])

    def _calc_state(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._shown(context)[1])
