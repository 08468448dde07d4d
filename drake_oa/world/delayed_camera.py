"""Simulated depth camera with delayed images, which are rendered in a background thread during the
delay.

Rendering and noise are computed in one thread for all cameras, parallel to the simulation. Drake's
render engines work only in the thread that created them. Therefore this thread creates, uses and
destroys all engines.
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
"""Type of a result that is computed in the render thread."""

Noise = Callable[[NDArray[np.float32], float], NDArray[np.float32]]
"""Type of a function that returns the measured depth image (H, W) for a true depth image (H, W) [m]
and its capture time [s]."""
_CACHE_SIZE = 4
"""Number of recently rendered images that each simulated camera stores in its cache."""


class Rendered(NamedTuple):
    """Rendered depth image, and the pose of the camera that rendered it.

    Attributes:
        depth: (H, W) depths along the optical axis [m]; 0 is too near, inf is too far, NaN is
            missing.
        X_WC: pose of the camera in the world.
    """

    depth: NDArray[np.float32]
    X_WC: RigidTransform


class _CameraWorld:
    """Diagram with a copy of a scenario's world and one camera, which renders the depth image at a
    given state of the plant.
    """

    def __init__(self, scenario: Scenario, config: CameraConfig) -> None:
        """Builds the diagram, which contains the models of the scenario and one camera, and a
        Simulator that evaluates its image.

        Args:
            scenario: scenario whose models are rendered.
            config: configuration of the camera.

        Raises:
            ScenarioError: if Drake rejects the camera.
        """
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
        """Renders the depth image of the camera at a state (n,) [q, v] of the scenario's plant."""
        context = self._simulator.get_mutable_context()
        self._diagram.get_input_port().FixValue(context, state)
        if self._number == 0:
            self._simulator.Initialize()
        self._number += 1
        self._simulator.AdvanceTo(self._number + 0.5)
        image = self._diagram.get_output_port().Eval(context)
        pose = self._sensor.body_pose_in_world_output_port()
        X_WC = pose.Eval(self._sensor.GetMyContextFromRoot(context))
        # The next rendering changes the pose to which the port refers.
        return Rendered(np.array(image.data[:, :, 0]), RigidTransform(X_WC))


class BackgroundCamera:
    """Camera of a scenario whose images are rendered in a background thread, parallel to the
    simulation.

    An image is a function of the requested plant state and capture time. Early, repeated or missing
    requests therefore change only the wall time of a run, not the images.
    """

    def __init__(
        self, scenario: Scenario, config: CameraConfig, noise: Noise | None = None
    ) -> None:
        """Builds a copy of the scenario's world, in which the camera renders, in the background
        thread.

        Args:
            scenario: scenario with a robot.
            config: configuration of the camera.
            noise: function that returns the measured image for a true image [m] and its capture
                time [s]; None: ideal images.

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
        """Returns the copy of the scenario's world in which the camera renders, and builds the copy
        first if it does not exist.

        The method must be called in the render thread, because the copy is stored there.
        """
        worlds: dict[str, _CameraWorld] = vars(_worlds)
        if self._name not in worlds:
            worlds[self._name] = _CameraWorld(self._scenario, self._config)
        return worlds[self._name]

    def release(self) -> None:
        """Destroys the camera's render engine and cached images; the next request of an image
        builds the engine again.

        Python never collects a diagram that contains systems written in Python. Without a call of
        this method, the engine of such a diagram would never be released.
        """
        _end_world(self._name)
        self._images.clear()

    def request(self, state: FloatArray, time: float) -> Future[Rendered]:
        """Requests the image at a plant state and time, and starts its rendering in the background
        thread unless it is in the cache.

        Args:
            state: (n,) state [q, v] of the scenario's plant.
            time: capture time of the image, on which its noise depends [s].

        Returns:
            Future of the rendered image.
        """
        key = (np.ascontiguousarray(state).tobytes(), float(time))
        if key not in self._images:
            noise, requested = self._noise, np.array(state)

            def measure() -> Rendered:
                """Renders the requested image and adds noise to it."""
                image = self._world().render(requested)
                return image._replace(depth=noise(image.depth, time)) if noise else image

            self._images[key] = _submit(measure)
            if len(self._images) > _CACHE_SIZE:
                self._images.popitem(last=False)
        return self._images[key]


_numbers = itertools.count()
"""Counter for the numbers of the background cameras in this process. The number of a camera, as
text, is the key in `_worlds` of the diagram in which the camera renders."""
_render_thread = ThreadPoolExecutor(1, "render")
"""Executor with one thread, which creates, uses and destroys the render engines of all cameras."""
_worlds = threading.local()
"""Rendered worlds (diagrams `_CameraWorld`, each with the models of a scenario and one camera), by
the number of the camera. The storage is local to the render thread, so that worlds are destroyed
in this thread."""


def _submit(call: Callable[[], _T]) -> Future[_T]:
    """Calls a function in the render thread, and returns the future of its result."""

    def run() -> _T:
        """Calls the function submitted to the render thread, with garbage collection disabled
        during the call.
        """
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
    """Destroys the diagram in which a camera renders, with its render engine, in the render thread;
    no effect if this diagram does not exist.

    Args:
        name: number of the camera, as text.
    """
    # At the end of the interpreter the thread no longer exists.
    with suppress(RuntimeError):
        _submit(lambda: vars(_worlds).pop(name, None))


@dataclass(frozen=True, eq=False)
class _Captures(Frozen):
    """Times and plant states of the last two images that a camera captured, older image first.

    Attributes:
        stamp: capture times [s], two at most.
        state: plant states (n,) [q, v] at the capture times.
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
    - depth_image: ImageDepth32F along the optical axis [m]; 0 is too near, inf is too far. With
      noise, all pixels without a measurement are NaN.
    - camera_pose: RigidTransform X_WC of the camera at the capture time.
    - image_time: (1,) capture time of the image [s].
    - plant_state (out): (n,) state [q, v] of the plant at the capture time.

    The first image is output without delay, as if the camera had been running before the start.
    With a delay of 0, each evaluation of `depth_image` renders the present state. The Context
    stores only capture times and states, of which the images are functions. The rendering of an
    image begins at its capture, and an evaluation of `depth_image` waits for the end of the
    rendering.

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
        """Declares the ports, state and events of the camera.

        Args:
            camera: background camera that renders the images.
            intrinsics: intrinsics of the depth images.
            num_states: size n of the plant's state.
            period: time between two captures [s].
            delay: time from the capture to the output of an image [s]; 0: each output image shows
                the present state.
            dropouts: faults during which the camera captures no images.

        Raises:
            ValueError: unless 0 <= delay < period.
        """
        super().__init__(intrinsics, num_states, _Captures())
        period = valid_period(period)
        if not 0.0 <= delay < period:
            raise ValueError(f"delay must be between 0 and the period {period} s, not {delay}")
        self._camera, self._delay, self._dropouts = camera, delay, tuple(dropouts)
        self._period = period
        self.DeclareInitializationUnrestrictedUpdateEvent(self._initialize)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, period, self._capture)

    def release(self) -> None:
        """Destroys the camera's render engine and cached images; the next requested image creates
        the engine again.
        """
        self._camera.release()

    def is_ready(self, context: Context) -> bool:
        """Checks whether the image that the camera outputs at the time of a Context has been
        rendered, so that an evaluation of `depth_image` does not wait.
        """
        return self._rendering(context).done()

    def _read(self, context: Context) -> _Captures:
        """Returns the times and plant states of the last two captures, which the abstract state of
        a Context stores.
        """
        captures: _Captures = context.get_abstract_state(self._state_index).get_value()
        return captures

    def _is_dropped_out(self, context: Context) -> bool:
        """Checks whether a dropout of the camera is active at the time of a Context."""
        return any(is_active(fault, context) for fault in self._dropouts)

    def _initialize(self, context: Context, state: State) -> None:
        """Captures the first image of a simulation, and forgets earlier captures.

        Nothing changes if the last capture precedes the time of the Context by less than one
        period: the Context then continues a simulation.
        """
        last = max(self._read(context).stamp, default=-np.inf)
        if not 0.0 < context.get_time() - last < self._period:
            state.get_mutable_abstract_state(self._state_index).set_value(_Captures())
            self._capture(context, state)

    def _capture(self, context: Context, state: State) -> None:
        """Captures an image: stores the present time and plant state, and starts the rendering.
        During a dropout of the camera, nothing is captured.
        """
        if self._is_dropped_out(context):
            return
        before: _Captures = state.get_abstract_state(self._state_index).get_value()
        x = np.array(self._state_port.Eval(context))
        self._camera.request(x, context.get_time())
        after = _Captures((*before.stamp[-1:], context.get_time()), (*before.state[-1:], x))
        state.get_mutable_abstract_state(self._state_index).set_value(after)

    def capture_state(self, context: Context) -> tuple[float, FloatArray]:
        """Returns the capture time [s] of the image that the camera outputs at the time of a
        Context, and the plant state (n,) at the capture time.

        During a dropout before the first capture, the capture time is -inf, and the state is the
        present state.
        """
        captures, now = self._read(context), context.get_time()
        is_out = self._is_dropped_out(context)
        if not captures.stamp or (self._delay == 0.0 and not is_out):
            return -np.inf if is_out else now, self._state_port.Eval(context)
        arrived = captures.stamp[-1] + self._delay <= now + 1e-9 or len(captures.stamp) == 1
        row = -1 if arrived else 0
        return captures.stamp[row], captures.state[row]

    def image(self, context: Context) -> NDArray[np.float32] | float:
        """Returns the depth image (H, W) that the camera outputs at the time of a Context [m],
        after waiting for its rendering; NaN during a dropout before the first capture.
        """
        has_come = self.capture_state(context)[0] >= 0.0
        return self._rendering(context).result().depth if has_come else np.nan

    def pose(self, context: Context) -> RigidTransform:
        """Returns the camera pose X_WC at the capture time of the image that the camera outputs at
        the time of a Context.
        """
        return self._rendering(context).result().X_WC

    def _rendering(self, context: Context) -> Future[Rendered]:
        """Requests the rendering of the image that the camera outputs at the time of a Context, and
        returns the future of the rendered image.
        """
        time, state = self.capture_state(context)
        return self._camera.request(state, max(time, 0.0))
