"""Depth camera with delayed images, which are rendered in the background during the delay.

Rendering and noise run in one thread parallel to the simulation. Drake's render engines work only
in the thread that created them, so that this thread creates, uses and destroys all engines.
"""

from __future__ import annotations

import gc
import itertools
import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder, State
from pydrake.systems.primitives import ZeroOrderHold
from pydrake.systems.sensors import CameraConfig, CameraInfo, ImageDepth32F

from drake_oa.common.messages import FloatArray, Frozen
from drake_oa.common.ports import valid_period
from drake_oa.scenario.faults import CameraDropout
from drake_oa.scenario.scenario import Scenario
from drake_oa.world.cameras import TimedCamera, add_camera
from drake_oa.world.faults import is_active

_T = TypeVar("_T")
"""Type of a result computed in the render thread."""

Noise = Callable[[NDArray[np.float32], float], NDArray[np.float32]]
"""Function that returns the measured image for a true image [m] and its time [s]."""
_CACHE_SIZE = 4
"""Number of rendered images in the cache of a camera."""


class Rendered(NamedTuple):
    """Rendered depth image and the pose of its camera.

    Attributes:
        depth: (H, W) along the optical axis [m]; 0 is too near, inf too far, NaN missing.
        X_WC: pose of the camera.
    """

    depth: NDArray[np.float32]
    X_WC: RigidTransform


class _CameraWorld:
    """Diagram that renders the scenario's world at given plant states."""

    def __init__(self, scenario: Scenario, config: CameraConfig) -> None:
        builder = DiagramBuilder()
        self._sensor = add_camera(builder, scenario, config)
        # `AdvanceTo` releases Python's global lock while it renders; evaluating a port would not.
        image = ImageDepth32F(config.width, config.height)
        puller = builder.AddNamedSystem("puller", ZeroOrderHold(1.0, Value(image)))
        builder.Connect(self._sensor.depth_image_32F_output_port(), puller.get_input_port())
        builder.ExportOutput(puller.get_output_port(), "image")
        self._diagram = builder.Build()
        self._simulator = Simulator(self._diagram)
        self._number = 0

    def render(self, state: FloatArray) -> Rendered:
        """Renders the depth image at a plant state [q, v]."""
        context = self._simulator.get_mutable_context()
        self._diagram.get_input_port().FixValue(context, state)
        if self._number == 0:
            self._simulator.Initialize()
        self._number += 1
        self._simulator.AdvanceTo(self._number + 0.5)
        image = self._diagram.get_output_port().Eval(context)
        pose = self._sensor.body_pose_in_world_output_port()
        X_WC = pose.Eval(self._sensor.GetMyContextFromRoot(context))
        return Rendered(np.array(image.data[:, :, 0]), X_WC)


class BackgroundCamera:
    """Camera of a scenario whose images are rendered in the background thread.

    An image is a function of the requested state and time. Early, repeated or missing requests
    therefore change the wall time only, not the images.
    """

    def __init__(
        self, scenario: Scenario, config: CameraConfig, noise: Noise | None = None
    ) -> None:
        """Builds the rendered world in the background thread.

        Args:
            scenario: scenario with a robot.
            config: configuration of the camera.
            noise: noise of the images; None: ideal images.

        Raises:
            ScenarioError: if Drake rejects the camera.
        """
        self._scenario, self._config, self._noise = scenario, config, noise
        self._images: OrderedDict[tuple[bytes, float], Future[Rendered]] = OrderedDict()
        self._name = str(next(_numbers))
        _submit(self._world).result()
        # The render engine must also be destroyed in its thread.
        weakref.finalize(self, _end_world, self._name).atexit = False

    def _world(self) -> _CameraWorld:
        """Returns the rendered world of this thread; builds it again after a release."""
        worlds: dict[str, _CameraWorld] = vars(_worlds)
        if self._name not in worlds:
            worlds[self._name] = _CameraWorld(self._scenario, self._config)
        return worlds[self._name]

    def release(self) -> None:
        """Destroys the render engine and the cached images; the next request builds it again.

        Python never collects a diagram with Python systems, which would hold the engine forever.
        """
        _end_world(self._name)
        self._images.clear()

    def request(self, state: FloatArray, time: float) -> Future[Rendered]:
        """Requests an image of the scenario; the future holds it once it is rendered.

        Args:
            state: (n,) state [q, v] of the scenario's plant.
            time: capture time of the image, on which its noise depends [s].
        """
        key = (np.ascontiguousarray(state).tobytes(), float(time))
        if key not in self._images:
            noise, requested = self._noise, np.array(state)

            def measure() -> Rendered:
                """Renders the image and adds its noise."""
                image = self._world().render(requested)
                return image._replace(depth=noise(image.depth, time)) if noise else image

            self._images[key] = _submit(measure)
            if len(self._images) > _CACHE_SIZE:
                self._images.popitem(last=False)
        return self._images[key]


_numbers = itertools.count()
"""Numbers of the background cameras of this process, which name their worlds."""
_render_thread = ThreadPoolExecutor(1, "render")
"""Thread that creates, uses and destroys all rendered worlds."""
_worlds = threading.local()
"""Rendered worlds by camera name, local to the render thread so that they are destroyed in it."""


def _submit(call: Callable[[], _T]) -> Future[_T]:
    """Calls a function in the render thread."""

    def run() -> _T:
        """Calls the function without garbage collection."""
        # A garbage collection here would destroy render engines of other threads in this thread.
        collects = gc.isenabled()
        gc.disable()
        try:
            return call()
        finally:
            if collects:
                gc.enable()

    return _render_thread.submit(run)


def _end_world(name: str) -> None:
    """Destroys a rendered world, if it exists."""
    # At the end of the interpreter the thread no longer exists.
    with suppress(RuntimeError):
        _submit(lambda: vars(_worlds).pop(name, None))


@dataclass(frozen=True, eq=False)
class _Captures(Frozen):
    """Times and plant states of the last two captured images, older one first.

    Attributes:
        stamp: capture times [s], at most two.
        state: plant states (n,) at these times.
    """

    stamp: tuple[float, ...] = ()
    state: tuple[FloatArray, ...] = ()


class DelayedCamera(TimedCamera):
    """Simulated depth camera that captures an image every period and outputs it after a delay.

    .. pydrake_system::

      name: DelayedCamera
      input_ports:
      - plant_state
      output_ports:
      - depth_image
      - camera_pose
      - image_time
      - plant_state

    - plant_state (in): (n,) state [q, v] of the simulated plant, moving obstacles included.
    - depth_image: ImageDepth32F along the optical axis [m]; 0 is too near, inf too far. With noise,
      all pixels without a measurement are NaN.
    - camera_pose: RigidTransform X_WC of the camera at the capture time.
    - image_time: (1,) capture time of the image [s].
    - plant_state (out): (n,) state of the plant at the capture time.

    The first image is output without delay, because a camera runs before the robot moves. With a
    delay of 0, each evaluation renders the present state. The Context holds times and states; the
    image is a function of them. Its rendering begins at the capture, and an evaluation of the port
    waits for the end of the rendering.

    During a dropout no image is captured: the outputs keep the previous image. Without a previous
    image, the depths are NaN and the time is -inf.
    """

    def __init__(
        self,
        camera: BackgroundCamera,
        intrinsics: CameraInfo,
        *,
        num_states: int,
        period: float,
        delay: float,
        dropouts: Sequence[CameraDropout] = (),
    ) -> None:
        """Declares ports, state and events.

        Args:
            camera: camera that renders the images.
            intrinsics: intrinsics of the images.
            num_states: size n of the plant's state.
            period: time between two captures [s].
            delay: time from the capture to the output of an image [s]; 0: present images.
            dropouts: intervals without captures.

        Raises:
            ValueError: unless 0 <= delay < period.
        """
        super().__init__(intrinsics, num_states, _Captures())
        period = valid_period(period)
        if not 0.0 <= delay < period:
            raise ValueError(f"delay must be between 0 and the period {period} s, not {delay}")
        self._camera, self._delay, self._dropouts = camera, delay, tuple(dropouts)
        self.DeclareInitializationUnrestrictedUpdateEvent(self._capture)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, period, self._capture)

    def release(self) -> None:
        """Releases the render engine, see `BackgroundCamera.release`."""
        self._camera.release()

    def is_ready(self, context: Context) -> bool:
        """Checks whether the present output image is rendered, so that evaluations do not wait."""
        return self._rendering(context).done()

    def _read(self, context: Context) -> _Captures:
        """Returns the captures in the abstract state."""
        captures: _Captures = context.get_abstract_state(self._state_index).get_value()
        return captures

    def _is_dropped_out(self, context: Context) -> bool:
        """Checks whether a dropout is active."""
        return any(is_active(fault, context) for fault in self._dropouts)

    def _capture(self, context: Context, state: State) -> None:
        """Stores time and state of a new image and starts its rendering, except in a dropout."""
        if self._is_dropped_out(context):
            return
        before = self._read(context)
        x = np.array(self._state_port.Eval(context))
        self._camera.request(x, context.get_time())
        after = _Captures((*before.stamp[-1:], context.get_time()), (*before.state[-1:], x))
        state.get_mutable_abstract_state(self._state_index).set_value(after)

    def capture_state(self, context: Context) -> tuple[float, FloatArray]:
        """Returns capture time [s] and plant state of the present output image; -inf: no image."""
        captures, now = self._read(context), context.get_time()
        is_out = self._is_dropped_out(context)
        if not captures.stamp or (self._delay == 0.0 and not is_out):
            return -np.inf if is_out else now, self._state_port.Eval(context)
        arrived = captures.stamp[-1] + self._delay <= now + 1e-9 or len(captures.stamp) == 1
        row = -1 if arrived else 0
        return captures.stamp[row], captures.state[row]

    def image(self, context: Context) -> NDArray[np.float32] | float:
        """Returns the present output image, once it is rendered [m]; NaN: no image."""
        has_come = self.capture_state(context)[0] >= 0.0
        return self._rendering(context).result().depth if has_come else np.nan

    def pose(self, context: Context) -> RigidTransform:
        """Returns the camera pose X_WC at the capture time."""
        return self._rendering(context).result().X_WC

    def _rendering(self, context: Context) -> Future[Rendered]:
        """Requests the present output image."""
        time, state = self.capture_state(context)
        return self._camera.request(state, max(time, 0.0))
