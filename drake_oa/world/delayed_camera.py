"""A depth camera whose images come late, as a real one's, and are rendered meanwhile.

Rendering, and the noise, run in a thread beside the simulation. Drake's render engines work in
the thread that made them, and only there: so one thread makes all of them, uses them and ends
them.
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
from drake_oa.world.faults import lasts

_T = TypeVar("_T")

Noise = Callable[[NDArray[np.float32], float], NDArray[np.float32]]
"""Makes a measured image of a true one and its time [s]."""
_KEPT = 4
"""Images that are kept for being asked for again."""


class Rendered(NamedTuple):
    """Depth image and the pose of its camera.

    Attributes:
        depth: (H, W) along the optical axis [m]; 0 is too near, inf too far, NaN missing.
        X_WC: pose of the camera.
    """

    depth: NDArray[np.float32]
    X_WC: RigidTransform


class _CameraWorld:
    """Renders the world at one state after another."""

    def __init__(self, scenario: Scenario, config: CameraConfig) -> None:
        builder = DiagramBuilder()
        self._sensor = add_camera(builder, scenario, config)
        # Advancing a diagram does not hold Python's lock, evaluating a port would.
        image = ImageDepth32F(config.width, config.height)
        puller = builder.AddNamedSystem("puller", ZeroOrderHold(1.0, Value(image)))
        builder.Connect(self._sensor.depth_image_32F_output_port(), puller.get_input_port())
        builder.ExportOutput(puller.get_output_port(), "image")
        self._diagram = builder.Build()
        self._simulator = Simulator(self._diagram)
        self._number = 0

    def render(self, state: FloatArray) -> Rendered:
        """The image at a state [q, v]."""
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
    """One camera of a scenario, rendered in the background.

    An image is a function of the state and the time that it is asked for, so that asking
    early, twice or not at all changes nothing but the time it takes.
    """

    def __init__(
        self, scenario: Scenario, config: CameraConfig, noise: Noise | None = None
    ) -> None:
        """Builds the world.

        Args:
            scenario: with a robot.
            config: of the camera.
            noise: of its images; None: they are ideal.

        Raises:
            ScenarioError: if the camera does not fit the world.
        """
        self._scenario, self._config, self._noise = scenario, config, noise
        self._images: OrderedDict[tuple[bytes, float], Future[Rendered]] = OrderedDict()
        self._name = str(next(_numbers))
        _submit(self._world).result()
        # The engine must end in its own thread as well.
        weakref.finalize(self, _end, self._name).atexit = False

    def _world(self) -> _CameraWorld:
        """Returns the world in the thread that renders; after a release it is made again."""
        worlds: dict[str, _CameraWorld] = vars(_worlds)
        if self._name not in worlds:
            worlds[self._name] = _CameraWorld(self._scenario, self._config)
        return worlds[self._name]

    def release(self) -> None:
        """Ends the engine and forgets the images; asked again, the camera begins again.

        A diagram of Python systems is never collected, and would keep them for ever.
        """
        _end(self._name)
        self._images.clear()

    def ask(self, state: FloatArray, time: float) -> Future[Rendered]:
        """The image at a state [q, v] of the scenario's plant, when it is ready.

        Args:
            state: (n,) what it shows.
            time: when it was taken [s]: of that its noise is a function too.
        """
        key = (np.ascontiguousarray(state).tobytes(), float(time))
        if key not in self._images:
            noise, requested = self._noise, np.array(state)

            def measure() -> Rendered:
                image = self._world().render(requested)
                return image._replace(depth=noise(image.depth, time)) if noise else image

            self._images[key] = _submit(measure)
            if len(self._images) > _KEPT:
                self._images.popitem(last=False)
        return self._images[key]


_numbers = itertools.count()
_thread = ThreadPoolExecutor(1, "render")
"""The thread in which all worlds of cameras are made, used and ended."""
_worlds = threading.local()
"""Worlds of cameras by name, of that thread alone: they end with it, in it."""


def _submit(call: Callable[[], _T]) -> Future[_T]:
    """Calls a function in the thread that renders."""

    def run() -> _T:
        # The garbage collector would destroy other threads' render engines in this one.
        collects = gc.isenabled()
        gc.disable()
        try:
            return call()
        finally:
            if collects:
                gc.enable()

    return _thread.submit(run)


def _end(name: str) -> None:
    """Ends a world; again, it does nothing."""
    # After the interpreter has ended the thread, there is none.
    with suppress(RuntimeError):
        _submit(lambda: vars(_worlds).pop(name, None))


@dataclass(frozen=True, eq=False)
class _Taken(Frozen):
    """When images were taken, and of which state: the one before the last, and the last."""

    stamp: tuple[float, ...] = ()
    state: tuple[FloatArray, ...] = ()


class DelayedCamera(TimedCamera):
    """Takes a depth image every period, and outputs it some time after, or images of the present.

    .. pydrake_system::

      name: DelayedCamera
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
    During a dropout no image is taken: the last one before it stays, all NaN with the time -inf
    while there was none.
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
            camera: what renders.
            intrinsics: of its image.
            num_states: size n of the plant's state.
            period: time between images [s].
            delay: time from taking an image to its coming [s]; 0: each image is of the present.
            dropouts: when no image is taken.

        Raises:
            ValueError: unless 0 <= delay < period.
        """
        super().__init__(intrinsics, num_states, _Taken())
        period = valid_period(period)
        if not 0.0 <= delay < period:
            raise ValueError(f"delay must be between 0 and the period {period} s, not {delay}")
        self._camera, self._delay, self._dropouts = camera, delay, tuple(dropouts)
        self.DeclareInitializationUnrestrictedUpdateEvent(self._take)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, period, self._take)

    def release(self) -> None:
        """See `BackgroundCamera.release`."""
        self._camera.release()

    def ready(self, context: Context) -> bool:
        """Whether the image that it hands out now is rendered, so that nobody waits for it."""
        return self._asked(context).done()

    def _read(self, context: Context) -> _Taken:
        taken: _Taken = context.get_abstract_state(self._kept).get_value()
        return taken

    def _is_out(self, context: Context) -> bool:
        return any(lasts(fault, context) for fault in self._dropouts)

    def _take(self, context: Context, state: State) -> None:
        if self._is_out(context):
            return
        before = self._read(context)
        x = np.array(self._state_port.Eval(context))
        self._camera.ask(x, context.get_time())
        after = _Taken((*before.stamp[-1:], context.get_time()), (*before.state[-1:], x))
        state.get_mutable_abstract_state(self._kept).set_value(after)

    def moment(self, context: Context) -> tuple[float, FloatArray]:
        """Time and state of the image that has come last; -inf: none has come."""
        taken, now, is_out = self._read(context), context.get_time(), self._is_out(context)
        if not taken.stamp or (self._delay == 0.0 and not is_out):
            return -np.inf if is_out else now, self._state_port.Eval(context)
        arrived = taken.stamp[-1] + self._delay <= now + 1e-9 or len(taken.stamp) == 1
        row = -1 if arrived else 0
        return taken.stamp[row], taken.state[row]

    def image(self, context: Context) -> NDArray[np.float32] | float:
        """The image that has come last, when it is rendered; NaN: none has come."""
        has_come = self.moment(context)[0] >= 0.0
        return self._asked(context).result().depth if has_come else np.nan

    def pose(self, context: Context) -> RigidTransform:
        """X_WC when it was taken."""
        return self._asked(context).result().X_WC

    def _asked(self, context: Context) -> Future[Rendered]:
        time, state = self.moment(context)
        return self._camera.ask(state, max(time, 0.0))
