"""Depth cameras outside the simulation: images of a device or another process, as they come.

Their stamps are of the wall clock; what stands behind works by the time of its Context.
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

_REMEMBERED = 0.5
"""How far back states are known, at least [s] of the wall clock."""
_MAX_AHEAD = 0.01
"""Maximum time by which the stamp of an image may be ahead of the wall clock [s]."""
_POLL = 0.005
"""Time between two checks for a new image [s]."""
_PAUSE = 0.002
"""Between two looks for the first image [s]."""


@dataclass(frozen=True)
class Outside:
    """What cameras outside the simulation go by.

    Attributes:
        plant_state: port of [q, v] of the plant as it is measured; None: the simulated one's.
        to_simulated: the simulated time at a time of the wall clock just now [s]; None: by where
            the simulation was ahead of it most of late.
        clock: the wall clock [s].
        wait: called again and again while the first image is waited for.
    """

    plant_state: OutputPort | None = None
    to_simulated: Callable[[float], float] | None = None
    clock: Callable[[], float] = time.time
    wait: Callable[[], None] = lambda: time.sleep(_PAUSE)


class _Instant(NamedTuple):
    """The state (n,) at a moment of both clocks [s]."""

    wall: float
    time: float
    plant_state: FloatArray


@dataclass(frozen=True, eq=False)
class _Seen(Frozen):
    """The last image that fits, and what was the case until now.

    Attributes:
        depth: (H, W) [m]; None: there was none.
        stamp: when it was taken, by the wall clock [s].
        time: the same by the Context's [s].
        plant_state: (n,) the state then.
        note: empty, or why the image that came last was passed over.
        past: moments until now.
    """

    depth: NDArray[np.float32] | None = None
    stamp: float = -math.inf
    time: float = -math.inf
    plant_state: FloatArray = zeros(0)
    note: str = ""
    past: tuple[_Instant, ...] = ()


class LiveCamera(TimedCamera):
    """Hands out the images of a depth camera that stands still outside the simulation.

    .. pydrake_system::

      name: LiveCamera
      input_ports:
      - plant_state
      output_ports:
      - depth_image
      - camera_pose
      - image_time
      - plant_state

    - plant_state (in): (n,) vector [q, v] of the plant as it is now, measured or simulated.
    - depth_image: ImageDepth32F along the optical axis [m]; inf is too far, NaN missing; all NaN
      before the first image.
    - camera_pose: RigidTransform X_WC, constant.
    - image_time: (1,) when the image was taken, by the Context's clock [s]; -inf before the
      first. It never goes back, and is never later than when the image came.
    - plant_state (out): (n,) the state then, between the two that were known about that moment.

    At initialization, or where it is read before, the source is opened and the first image waited
    for; every 5 ms the newest
    one is taken into the Context. The wall clock is set against the Context's by where the Context
    was ahead most of late, if nothing better is known: a simulator that keeps real time falls
    behind for moments, in which images go on to be taken. An image that does not fit is passed
    over, and logged when that begins and ends.
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
        outside: Outside | None = None,
    ) -> None:
        """Declares ports, state and events.

        Args:
            source: of the images.
            intrinsics: of the camera; images of another size are passed over.
            X_WC: where it stands.
            num_states: size n of the plant's state.
            wait: how long the first image is waited for [s]; 0: not at all.
            max_age: age at which an image that comes is passed over [s] of the wall clock.
            outside: the clocks; None: `Outside()`. Its `plant_state` is not read here.
        """
        super().__init__(intrinsics, num_states, _Seen())
        outside = outside or Outside()
        self._source, self._X_WC, self._clock = source, RigidTransform(X_WC), outside.clock
        self._wait, self._max_age = wait, max_age
        self._to_simulated, self._pause = outside.to_simulated, outside.wait
        self._first: _Seen | None = None
        self.DeclareInitializationUnrestrictedUpdateEvent(self._begin)
        self.DeclarePeriodicUnrestrictedUpdateEvent(_POLL, _POLL, self._poll)

    def release(self) -> None:
        """Closes the source; the next initialization opens it again."""
        self._source.close()
        self._first = None

    def _read(self, context: Context) -> _Seen:
        """What is seen; before the Context's initialization, what it will begin with.

        Events of an initialization all see the Context of before it.
        """
        seen: _Seen = context.get_abstract_state(self._kept).get_value()
        if not seen.past:
            seen = self._first = self._first or self._begun(context, seen)
        return seen

    def _begin(self, context: Context, state: State) -> None:
        self._source.open()
        state.get_mutable_abstract_state(self._kept).set_value(self._read(context))

    def _begun(self, context: Context, seen: _Seen) -> _Seen:
        """Opens the source and waits for the first image."""
        self._source.open()
        begun = time.monotonic()
        # The Context's clock stands still meanwhile: nothing of before counts.
        seen = self._looked(context, replace(seen, past=()), after=-math.inf)
        while seen.depth is None and time.monotonic() - begun < self._wait:
            self._pause()
            seen = self._looked(context, replace(seen, past=()))
        if seen.depth is None and self._wait > 0.0:
            why = f": {seen.note}" if seen.note else ""
            raise ScenarioError(
                f"{self.get_name()}: no image came within {self._wait:g} s from "
                f"{self._source.name}{why}"
            )
        return seen

    def _poll(self, context: Context, state: State) -> None:
        seen = self._looked(context, self._read(context))
        state.get_mutable_abstract_state(self._kept).set_value(seen)
        self._first = None

    def _looked(self, context: Context, seen: _Seen, after: float | None = None) -> _Seen:
        """What is seen after a look at what has come.

        Nobody looked since `after` by the wall clock [s]; None: since the look before. Of what
        came meanwhile the bus may keep the oldest: that it is old is no fault.
        """
        frame, note = None, seen.note
        try:
            frame = self._source.latest()
        except ValueError as error:
            note = str(error)
        # After the image has come: it is not of the future.
        now, at = self._clock(), context.get_time()
        begin = now - max(self._max_age, _REMEMBERED)
        kept = [instant for instant in seen.past if begin <= instant.wall <= now]
        past = (*kept, _Instant(now, at, np.array(self._state_port.Eval(context))))
        if after is None:
            after = seen.past[-1].wall if seen.past else now
        if frame is not None and after - self._max_age <= frame.stamp < now - self._max_age:
            frame = None
        if frame is not None:
            note = self._misfit(frame, now)
        log_change(self, seen.note, note, at)
        seen = replace(seen, note=note, past=past)
        if frame is None or note or frame.stamp <= seen.stamp:
            return seen
        if self._to_simulated is not None:
            taken = self._to_simulated(frame.stamp)
        else:
            taken = max(one.time - one.wall for one in past) + frame.stamp
        taken = min(taken, at)
        return replace(
            seen,
            depth=frame.depth,
            stamp=frame.stamp,
            time=max(seen.time, taken),
            plant_state=_state_at(past, frame.stamp),
        )

    def _misfit(self, frame: Frame, now: float) -> str:
        """Why an image does not fit; empty: it does."""
        width, height = self._intrinsics.width(), self._intrinsics.height()
        rows, columns = frame.depth.shape
        if (columns, rows) != (width, height):
            return f"image of {columns} x {rows} pixels, the scenario has {width} x {height}"
        if frame.stamp < now - self._max_age:
            return (
                f"images are more than {self._max_age:g} s old by this clock when they come: are "
                "both clocks set alike?"
            )
        if not frame.stamp <= now + _MAX_AHEAD:
            return f"image's stamp is more than {_MAX_AHEAD:g} s ahead of the clock here"
        return ""

    def image(self, context: Context) -> NDArray[np.float32] | float:
        """The newest image; NaN before the first."""
        depth = self._read(context).depth
        return np.nan if depth is None else depth

    def pose(self, context: Context) -> RigidTransform:
        """X_WC, which stays."""
        return self._X_WC

    def moment(self, context: Context) -> tuple[float, FloatArray]:
        """Time of the newest image, and the state then; of before the first, the present state."""
        seen = self._read(context)
        return seen.time, seen.past[-1].plant_state if seen.depth is None else seen.plant_state


def _state_at(past: tuple[_Instant, ...], stamp: float) -> FloatArray:
    """(n,) the state at a moment of the wall clock [s]; outside the past, the nearest known."""
    walls = [instant.wall for instant in past]
    states = np.transpose([instant.plant_state for instant in past])
    return np.array([np.interp(stamp, walls, values) for values in states])


def standing_pose(plant: MultibodyPlant, config: CameraConfig) -> RigidTransform:
    """X_WC of the depth image of a camera that stands still.

    Args:
        plant: the world, finalized.
        config: of the camera.

    Raises:
        ScenarioError: if it stands on something that moves, or at random.
    """
    where, base = f"cameras: camera '{config.name}': X_PB", config.X_PB.base_frame
    with field_errors(f"{where}.base_frame", RuntimeError):
        frame = GetScopedFrameByName(plant, base) if base else plant.world_frame()
    if not plant.IsAnchored(frame.body()):
        raise ScenarioError(
            f"{where}.base_frame: '{base}' moves; a camera outside the simulation must stand "
            "still: give a frame that is welded to the world"
        )
    if not config.X_PB.IsDeterministic():
        raise ScenarioError(f"{where}: is random; it must be the one pose the camera has")
    X_WP = frame.CalcPoseInWorld(plant.CreateDefaultContext())
    _, depth = config.MakeCameras()
    X_PB: RigidTransform = config.X_PB.GetDeterministicValue()
    X_WC: RigidTransform = X_WP @ X_PB @ depth.core().sensor_pose_in_camera_body()
    return X_WC
