"""Depth cameras outside the simulation, whose images come from a device or another process.

The sender stamps images by the wall clock. `LiveCamera` converts these stamps to times of its
Context.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import GetScopedFrameByName
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context, OutputPort, State
from pydrake.systems.sensors import CameraConfig, CameraInfo

from drake_oa.common.config import ScenarioError, field_errors
from drake_oa.common.messages import FloatArray, Frozen, zeros
from drake_oa.perception.depth_perception import log_change
from drake_oa.world.cameras import TimedCamera
from drake_oa.world.depth_messages import Frame, LcmFrames

_STATE_HISTORY = 0.5
"""Minimum wall time for which a camera stores plant states [s].

The plant state at the capture time of an image is interpolated between the stored states."""
_MAX_AHEAD = 0.01
"""Maximum time by which the time stamp of an image may be ahead of the wall clock; images further
ahead are rejected [s]."""
_POLL_PERIOD = 0.005
"""Simulated time after which a camera checks again whether a new image was received [s]."""
_WAIT_PERIOD = 0.002
"""Wall time after which a camera checks again for its first image, while it waits at the
initialization [s]."""


@dataclass(frozen=True)
class ExternalInputs:
    """Inputs of cameras outside the simulation: the measured plant state, and functions that read
    the wall clock and convert its time to simulated time.

    Attributes:
        plant_state: output port (n,) of the measured plant state [q, v]; None: the state of the
            simulated plant is used.
        to_simulated: function that converts a recent time of the wall clock to simulated time [s];
            None: the camera estimates the offset between both clocks.
        clock: function that returns the time of the wall clock [s].
        wait: function that sleeps or performs other work, which the camera calls repeatedly while
            it waits for its first image.
    """

    plant_state: OutputPort | None = None
    to_simulated: Callable[[float], float] | None = None
    clock: Callable[[], float] = time.time
    wait: Callable[[], None] = lambda: time.sleep(_WAIT_PERIOD)


class _Instant(NamedTuple):
    """Plant state at one instant, with the times of the wall clock and of the Context at that
    instant.

    Attributes:
        wall: time of the wall clock [s].
        time: time of the Context [s].
        plant_state: (n,) state [q, v] of the plant.
    """

    wall: float
    time: float
    plant_state: FloatArray


@dataclass(frozen=True, eq=False)
class _LiveState(Frozen):
    """Abstract state of a `LiveCamera`: the last accepted image, and recent plant states.

    An image is accepted if it has the camera's size, its stamp is neither older than the maximum
    age nor more than 10 ms ahead of the wall clock, and it is newer than the last accepted image.

    Attributes:
        depth: (H, W) depths of the last accepted image [m]; None before the first image.
        stamp: capture time of the last accepted image by the wall clock [s]; -inf before the first
            image.
        time: capture time of the last accepted image by the clock of the Context [s]; -inf before
            the first image.
        plant_state: (n,) plant state [q, v] at the capture time of the last accepted image.
        note: reason why the last checked image or message was rejected; otherwise empty.
        history: recent plant states with their times, oldest first.
    """

    depth: NDArray[np.float32] | None = None
    stamp: float = -math.inf
    time: float = -math.inf
    plant_state: FloatArray = zeros(0)
    note: str = ""
    history: tuple[_Instant, ...] = ()


class LiveCamera(TimedCamera):
    """System that outputs the images of a depth camera outside the simulation, whose pose is fixed.

    .. pydrake_system::

      name: LiveCamera
      input_ports:
      - plant_state
      output_ports:
      - depth_image
      - camera_pose
      - image_time
      - plant_state

    - plant_state (in): (n,) present state [q, v] of the plant, measured or simulated.
    - depth_image: ImageDepth32F along the optical axis [m]; inf is too far, NaN is missing. Before
      the first image, all pixels are NaN.
    - camera_pose: RigidTransform X_WC of the camera, constant.
    - image_time: (1,) capture time of the image by the clock of the Context [s]; -inf before the
      first image. This time never decreases, and is never later than the reception of the image.
    - plant_state (out): (n,) state [q, v] of the plant at the capture time, interpolated between
      recent states.

    At initialization, or at an earlier evaluation of a port, the camera subscribes to the images
    and waits for the first one. Every 5 ms it stores the newest image in the Context. Images of
    another size, older than `max_age`, or with a stamp more than 10 ms ahead of the wall clock are
    rejected, and so are messages that cannot be unpacked. The start of a series of rejections, each
    new reason, and the end of the series are logged.

    Without the function `ExternalInputs.to_simulated`, which converts wall-clock times, the capture
    time is the image's wall-clock stamp plus the largest recent difference between the Context's
    time and the wall clock. The largest difference is used, because a simulator at real time may
    lag behind the wall clock for some time.
    """

    def __init__(
        self,
        source: LcmFrames,
        intrinsics: CameraInfo,
        X_WC: RigidTransform,
        *,
        num_states: int,
        wait: float = 0.0,
        max_age: float = 0.2,
        external: ExternalInputs | None = None,
    ) -> None:
        """Declares the ports, state and events of the camera.

        Args:
            source: receiver of the depth images.
            intrinsics: intrinsics of the camera; images of another size are rejected.
            X_WC: constant pose of the camera (x right, y down, z forward) in the world.
            num_states: size n of the plant's state [q, v].
            wait: maximum time to wait for the first image [s]; 0: no waiting.
            max_age: maximum age of an image at its reception, by the wall clock [s]; older images
                are rejected.
            external: functions that read the wall clock and convert its time to simulated time;
                None: the defaults of `ExternalInputs`. Its field `plant_state` is ignored: the
                camera reads the plant state at its input port.
        """
        super().__init__(intrinsics, num_states, _LiveState())
        external = external or ExternalInputs()
        self._source, self._X_WC, self._clock = source, RigidTransform(X_WC), external.clock
        self._wait, self._max_age = wait, max_age
        self._to_simulated, self._pause = external.to_simulated, external.wait
        self._initial: _LiveState | None = None
        self.DeclareInitializationUnrestrictedUpdateEvent(self._initialize)
        self.DeclarePeriodicUnrestrictedUpdateEvent(_POLL_PERIOD, _POLL_PERIOD, self._poll)

    def release(self) -> None:
        """Closes the receiver of the images; the next initialization opens it again."""
        self._source.close()
        self._initial = None

    def _read(self, context: Context) -> _LiveState:
        """Returns the camera's state in a Context; for a Context that is not initialized, waits for
        the first image and returns the state with this image.

        This initial state is also stored in the camera, because all events of one initialization
        read the Context as it was before the initialization.
        """
        latest: _LiveState = context.get_abstract_state(self._state_index).get_value()
        if not latest.history:
            latest = self._initial = self._initial or self._wait_for_first(context, latest)
        return latest

    def _initialize(self, context: Context, state: State) -> None:
        """Opens the receiver, and stores the camera's state with the first image in the Context, at
        the initialization of the simulation.
        """
        self._source.open()
        state.get_mutable_abstract_state(self._state_index).set_value(self._read(context))

    def _wait_for_first(self, context: Context, latest: _LiveState) -> _LiveState:
        """Opens the receiver, waits for the first image, and returns the camera's state with this
        image.

        Args:
            context: present Context.
            latest: state of the camera before waiting; its history is discarded.

        Raises:
            ScenarioError: if no image is received within the maximum time to wait.
        """
        self._source.open()
        started = time.monotonic()
        # The time of the Context is constant while the camera waits: earlier states are discarded.
        latest = self._check_source(context, replace(latest, history=()), last_check=-math.inf)
        while latest.depth is None and time.monotonic() - started < self._wait:
            self._pause()
            latest = self._check_source(context, replace(latest, history=()))
        if latest.depth is None and self._wait > 0.0:
            why = f": {latest.note}" if latest.note else ""
            raise ScenarioError(
                f"{self.get_name()}: no image received within {self._wait:g} s from "
                f"{self._source.name}{why}"
            )
        return latest

    def _poll(self, context: Context, state: State) -> None:
        """Stores the newest received image, and the present plant state, in the camera's state of
        the Context, at each periodic event.
        """
        latest = self._check_source(context, self._read(context))
        state.get_mutable_abstract_state(self._state_index).set_value(latest)
        self._initial = None

    def _check_source(
        self, context: Context, latest: _LiveState, last_check: float | None = None
    ) -> _LiveState:
        """Checks whether the receiver has a new image, and returns the camera's state, with this
        image unless it is rejected or not newer than the previous image.

        An image older than `max_age` is usually rejected with a reason. If it was captured at most
        `max_age` before the last check, it is ignored without a reason: it may have been recent
        when it was received, and have become too old before this check.

        Args:
            context: present Context.
            latest: state of the camera before the check.
            last_check: time of the last check by the wall clock [s]; None: the last time in the
                history of `latest`.
        """
        frame, note = None, latest.note
        try:
            frame = self._source.latest()
        except ValueError as error:
            note = str(error)
        # The clock is read after the reception, so that the image is not from the future.
        now, context_time = self._clock(), context.get_time()
        begin = now - max(self._max_age, _STATE_HISTORY)
        recent = [instant for instant in latest.history if begin <= instant.wall <= now]
        history = (*recent, _Instant(now, context_time, np.array(self._state_port.Eval(context))))
        if last_check is None:
            last_check = latest.history[-1].wall if latest.history else now
        if frame is not None and last_check - self._max_age <= frame.stamp < now - self._max_age:
            frame = None
        if frame is not None:
            note = self._rejection_reason(frame, now)
        log_change(self, latest.note, note, context_time)
        latest = replace(latest, note=note, history=history)
        if frame is None or note or frame.stamp <= latest.stamp:
            return latest
        if self._to_simulated is not None:
            captured_at = self._to_simulated(frame.stamp)
        else:
            captured_at = max(one.time - one.wall for one in history) + frame.stamp
        captured_at = min(captured_at, context_time)
        return replace(
            latest,
            depth=frame.depth,
            stamp=frame.stamp,
            time=max(latest.time, captured_at),
            plant_state=_state_at(history, frame.stamp),
        )

    def _rejection_reason(self, frame: Frame, now: float) -> str:
        """Checks size and time stamp of a received image, and returns the reason to reject it, or
        an empty text.

        Args:
            frame: received image.
            now: present time of the wall clock [s].
        """
        width, height = self._intrinsics.width(), self._intrinsics.height()
        rows, columns = frame.depth.shape
        if (columns, rows) != (width, height):
            return f"image of {columns} x {rows} pixels, the scenario has {width} x {height}"
        if frame.stamp < now - self._max_age:
            return (
                f"images are more than {self._max_age:g} s old when they are received: synchronize "
                "the clocks of both computers"
            )
        if not frame.stamp <= now + _MAX_AHEAD:
            return f"image's stamp is more than {_MAX_AHEAD:g} s ahead of this computer's clock"
        return ""

    def image(self, context: Context) -> NDArray[np.float32] | float:
        """Returns the depths (H, W) of the newest image [m]; NaN before the first image."""
        depth = self._read(context).depth
        return np.nan if depth is None else depth

    def pose(self, context: Context) -> RigidTransform:
        """Returns the constant pose X_WC of the camera."""
        return self._X_WC

    def capture_state(self, context: Context) -> tuple[float, FloatArray]:
        """Returns the capture time [s] of the newest image, and the plant state (n,) at the capture
        time.

        Before the first image, the time is -inf, and the state is the present state of the plant.
        """
        latest = self._read(context)
        present = latest.history[-1].plant_state
        return latest.time, present if latest.depth is None else latest.plant_state


def _state_at(history: tuple[_Instant, ...], stamp: float) -> FloatArray:
    """Interpolates the plant state (n,) at a time of the wall clock from a history of states.

    Args:
        history: plant states with their times, oldest first.
        stamp: time of the wall clock [s]; before or after the history, the first or last state is
            returned.
    """
    walls = [instant.wall for instant in history]
    states = np.transpose([instant.plant_state for instant in history])
    return np.array([np.interp(stamp, walls, values) for values in states])


def fixed_pose(plant: MultibodyPlant, config: CameraConfig) -> RigidTransform:
    """Returns the pose X_WC of a camera outside the simulation (C: frame of the depth image), and
    checks that this pose is fixed in the world.

    Args:
        plant: finalized plant of the world, which contains the camera's base frame.
        config: configuration of the camera.

    Raises:
        ScenarioError: if the base frame can move, or the pose is random.
    """
    where, base = f"cameras: camera '{config.name}': X_PB", config.X_PB.base_frame
    with field_errors(f"{where}.base_frame", RuntimeError):
        frame = GetScopedFrameByName(plant, base) if base else plant.world_frame()
    if not plant.IsAnchored(frame.body()):
        raise ScenarioError(
            f"{where}.base_frame: '{base}' moves; a camera outside the simulation must have a "
            "fixed pose: use a frame that is welded to the world"
        )
    if not config.X_PB.IsDeterministic():
        raise ScenarioError(f"{where}: is random; it must be the fixed pose of the camera")
    # Products in the order of RgbdSensor, so that the pose has the bits of a simulated camera's.
    X_WF = plant.EvalBodyPoseInWorld(plant.CreateDefaultContext(), frame.body())
    X_FB = frame.GetFixedPoseInBodyFrame() @ config.X_PB.GetDeterministicValue()
    _, depth = config.MakeCameras()
    X_WC: RigidTransform = (X_WF @ X_FB) @ depth.core().sensor_pose_in_camera_body()
    return X_WC
