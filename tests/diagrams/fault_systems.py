"""Faults of observations, inserted into a diagram by its argument `customize`."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import LeafSystem
from pydrake.systems.primitives import DiscreteTimeDelay

from drake_oa.common.messages import ObstacleClouds
from drake_oa.common.signal_builder import SignalBuilder
from drake_oa.geometry.collision_scene import ENVIRONMENT, CollisionScene

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


def delayed_observations(delay: float) -> Customize:
    """Delays obstacles and collision scene by a time [s]."""

    def customize(signals: SignalBuilder) -> None:
        for signal, model in (
            ("obstacles_W", ObstacleClouds()),
            ("collision_scene_W", CollisionScene()),
        ):
            system = DiscreteTimeDelay(1.0 / 60.0, round(60.0 * delay), Value(model))
            signals.interpose(signal, f"delayed_{signal}", system)

    return customize


def changed(signal: str, model: object, change: Callable[[Any], object], *when: float) -> Customize:
    """Changes the messages of a signal from the first to the second time in `when` [s]."""
    first, last = when
    system = ChangedMessages(signal, model, lambda t, m: change(m) if first <= t < last else m)
    return lambda signals: signals.interpose(signal, f"changed_{signal}", system)


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
