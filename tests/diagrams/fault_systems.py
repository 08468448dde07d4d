"""Faults of cameras and observations, inserted into a diagram by its argument `customize`."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import Context, LeafSystem, State
from pydrake.systems.sensors import ImageDepth32F

from drake_oa.common.messages import ObstacleClouds
from drake_oa.common.signal_builder import SignalBuilder
from drake_oa.geometry.collision_scene import ENVIRONMENT, CollisionScene
from tests.builders import depth_image

Customize = Callable[[SignalBuilder], None]
"""Function that changes a diagram before it is built."""


class ChangedMessages(LeafSystem):
    """System that applies a function of time [s] and message to the messages of a signal."""

    def __init__(self, signal: str, model: object, change: Callable[[float, Any], object]) -> None:
        super().__init__()
        port = self.DeclareAbstractInputPort(signal, Value(model))
        self.DeclareAbstractOutputPort(
            signal,
            lambda: Value(model),
            lambda c, output: output.set_value(change(c.get_time(), port.Eval(c))),
        )


class DelayedMessages(LeafSystem):
    """System that outputs each message of a signal at a delay [s] after its stamp."""

    PERIOD = 1.0 / 60.0

    def __init__(self, signal: str, model: object, delay: float) -> None:
        super().__init__()
        self._delay, self._model = delay, model
        self._port = self.DeclareAbstractInputPort(signal, Value(model))
        self._messages = self.DeclareAbstractState(Value(()))
        self.DeclareAbstractOutputPort(signal, lambda: Value(model), self._calc)
        self.DeclarePeriodicUnrestrictedUpdateEvent(self.PERIOD, 0.0, self._store)

    def _store(self, context: Context, state: State) -> None:
        new = self._port.Eval(context)
        messages = context.get_abstract_state(self._messages).get_value()
        if not messages or new.stamp > messages[-1].stamp:
            state.get_mutable_abstract_state(self._messages).set_value((*messages, new))

    def _calc(self, context: Context, output: AbstractValue) -> None:
        messages = context.get_abstract_state(self._messages).get_value()
        arrived = [one for one in messages if one.stamp <= context.get_time() - self._delay]
        output.set_value(arrived[-1] if arrived else self._model)


def delayed_observations(delay: float) -> Customize:
    """Delays obstacles and collision scene by a time [s]."""

    def customize(signals: SignalBuilder) -> None:
        for signal, model in (
            ("obstacles_W", ObstacleClouds()),
            ("collision_scene_W", CollisionScene()),
        ):
            signals.interpose(signal, f"delayed_{signal}", DelayedMessages(signal, model, delay))

    return customize


def changed(signal: str, model: object, change: Callable[[Any], object], *when: float) -> Customize:
    """Changes the messages of a signal from the first to the second time in `when` [s]."""
    first, last = when
    system = ChangedMessages(signal, model, lambda t, m: change(m) if first <= t < last else m)
    return lambda signals: signals.interpose(signal, f"changed_{signal}", system)


def nan_frames(*when: float) -> Customize:
    """Replaces all depths of images by NaN within a time span [s]."""
    return changed(
        "depth_image",
        ImageDepth32F(),
        lambda image: depth_image(np.full_like(image.data[:, :, 0], np.nan)),
        *when,
    )


def raised_table(start: float, height: float) -> Customize:
    """Raises table and environment by a height [m] from a start time [s] on."""

    def change(scene: CollisionScene) -> CollisionScene:
        if not len(scene):
            return scene
        rows = scene.geometries.layout[:, 5] == ENVIRONMENT
        ball, X_WO = scene.geometries.ball.copy(), scene.geometries.X_WO.copy()
        ball[rows, 2] += height
        X_WO[rows, 2, 3] += height
        return replace(scene, geometries=scene.geometries._replace(ball=ball, X_WO=X_WO))

    return changed("collision_scene_W", CollisionScene(), change, start, np.inf)


def nan_clouds(*when: float) -> Customize:
    """Replaces every third point and all velocities of obstacles by NaN in a time span [s]."""

    def change(seen: ObstacleClouds) -> ObstacleClouds:
        clouds = tuple(
            np.where(np.arange(len(cloud))[:, None] % 3 == 0, np.nan, cloud)
            for cloud in seen.clouds_W
        )
        return replace(seen, clouds_W=clouds, v_WO=np.full_like(seen.v_WO, np.nan))

    return changed("obstacles_W", ObstacleClouds(), change, *when)


def nan_geometries(*when: float) -> Customize:
    """Replaces the poses of all collision geometries by NaN within a time span [s]."""

    def change(scene: CollisionScene) -> CollisionScene:
        if not len(scene):
            return scene
        places = {name: getattr(scene.geometries, name) for name in ("ball", "X_WO")}
        arrays = {name: np.full_like(array, np.nan) for name, array in places.items()}
        return replace(scene, geometries=scene.geometries._replace(**arrays))

    return changed("collision_scene_W", CollisionScene(), change, *when)
