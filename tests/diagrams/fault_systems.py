"""Faults of cameras and observations that tests put into a diagram by `customize=`."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, LeafSystem, State
from pydrake.systems.sensors import CameraConfig, ImageDepth32F

from drake_oa.common.messages import ObstacleClouds
from drake_oa.common.wires import Wires
from drake_oa.geometry.solids import SURROUNDINGS, SolidScene
from tests.builders import depth_image

Change = Callable[[float, np.ndarray, RigidTransform], np.ndarray]
"""Returns the damaged (H, W) depths [m] of a time [s], depths and the camera's pose X_WC."""
Customize = Callable[[Wires], None]


class DamagedFrames(LeafSystem):
    """Depth images as a function changes them."""

    def __init__(self, change: Change) -> None:
        super().__init__()
        self._change = change
        self._image = self.DeclareAbstractInputPort("depth_image", Value(ImageDepth32F()))
        self._pose = self.DeclareAbstractInputPort("camera_pose", Value(RigidTransform()))
        self.DeclareAbstractOutputPort("depth_image", lambda: Value(ImageDepth32F()), self._calc)

    def _calc(self, context: Context, output: AbstractValue) -> None:
        depth = self._image.Eval(context).data[:, :, 0]
        changed = self._change(context.get_time(), depth, self._pose.Eval(context))
        output.set_value(depth_image(changed))


def nan_frames(start: float, duration: float) -> Customize:
    """Makes all depths NaN for a time [s]."""

    def change(t: float, depth: np.ndarray, _: RigidTransform) -> np.ndarray:
        return np.full_like(depth, np.nan) if start <= t < start + duration else depth

    return lambda wires: wires.interpose("depth_image", "damaged_frames", DamagedFrames(change))


def missing_table(config: CameraConfig, start: float, duration: float) -> Customize:
    """Makes depths NaN that show no point above the table, which lies at z = 0."""
    center = config.principal_point()
    u = (np.arange(config.width) + 0.5 - center[0]) / config.focal_x()
    v = (np.arange(config.height) + 0.5 - center[1]) / config.focal_y()

    def change(t: float, depth: np.ndarray, X_WC: RigidTransform) -> np.ndarray:
        if not start <= t < start + duration:
            return depth
        x, y, z = X_WC.rotation().matrix()[2]
        height = X_WC.translation()[2] + depth * (x * u + y * v[:, None] + z)
        return np.where(height > 0.015, depth, np.float32(np.nan))

    return lambda wires: wires.interpose("depth_image", "damaged_frames", DamagedFrames(change))


class ChangedMessages(LeafSystem):
    """Messages of one signal as a function of time [s] and message changes them."""

    def __init__(self, signal: str, model: object, change: Callable[[float, Any], object]) -> None:
        super().__init__()
        port = self.DeclareAbstractInputPort(signal, Value(model))
        self.DeclareAbstractOutputPort(
            signal,
            lambda: Value(model),
            lambda c, output: output.set_value(change(c.get_time(), port.Eval(c))),
        )


class DelayedMessages(LeafSystem):
    """Messages of one signal, each a time [s] after its stamp."""

    PERIOD = 1.0 / 60.0

    def __init__(self, signal: str, model: object, delay: float) -> None:
        super().__init__()
        self._delay, self._model = delay, model
        self._port = self.DeclareAbstractInputPort(signal, Value(model))
        self._kept = self.DeclareAbstractState(Value(()))
        self.DeclareAbstractOutputPort(signal, lambda: Value(model), self._calc)
        self.DeclarePeriodicUnrestrictedUpdateEvent(self.PERIOD, 0.0, self._keep)

    def _keep(self, context: Context, state: State) -> None:
        new = self._port.Eval(context)
        kept = context.get_abstract_state(self._kept).get_value()
        if not kept or new.stamp > kept[-1].stamp:
            kept = (*kept, new)
            state.get_mutable_abstract_state(self._kept).set_value(kept)

    def _calc(self, context: Context, output: AbstractValue) -> None:
        kept = context.get_abstract_state(self._kept).get_value()
        arrived = [one for one in kept if one.stamp <= context.get_time() - self._delay]
        output.set_value(arrived[-1] if arrived else self._model)


def late_observations(delay: float) -> Customize:
    """Delays obstacles and solids by a time [s]."""

    def customize(wires: Wires) -> None:
        for signal, model in (("obstacles_W", ObstacleClouds()), ("solids_W", SolidScene())):
            wires.interpose(signal, f"late_{signal}", DelayedMessages(signal, model, delay))

    return customize


def raised_table(start: float, height: float) -> Customize:
    """Raises the table, and all solids that are no obstacle, from a time [s] on by a height [m]."""

    def change(t: float, scene: SolidScene) -> SolidScene:
        if t < start or not len(scene):
            return scene
        rows = scene.solids.layout[:, 5] == SURROUNDINGS
        ball, X_WO = scene.solids.ball.copy(), scene.solids.X_WO.copy()
        ball[rows, 2] += height
        X_WO[rows, 2, 3] += height
        return replace(scene, solids=scene.solids._replace(ball=ball, X_WO=X_WO))

    return _changed_solids(change)


def nan_clouds(start: float, duration: float) -> Customize:
    """Makes every third point and all velocities of obstacles NaN for a time [s]."""

    def change(t: float, seen: ObstacleClouds) -> ObstacleClouds:
        if not start <= t < start + duration:
            return seen
        clouds = tuple(
            np.where(np.arange(len(cloud))[:, None] % 3 == 0, np.nan, cloud)
            for cloud in seen.clouds_W
        )
        return replace(seen, clouds_W=clouds, v_WO=np.full_like(seen.v_WO, np.nan))

    return lambda wires: wires.interpose(
        "obstacles_W", "changed_clouds", ChangedMessages("obstacles_W", ObstacleClouds(), change)
    )


def nan_solids(start: float, duration: float) -> Customize:
    """Makes poses and velocities of all solids NaN for a time [s]."""

    def change(t: float, scene: SolidScene) -> SolidScene:
        if not start <= t < start + duration or not len(scene):
            return scene
        ball = np.full_like(scene.solids.ball, np.nan)
        X_WO = np.full_like(scene.solids.X_WO, np.nan)
        return replace(scene, solids=scene.solids._replace(ball=ball, X_WO=X_WO))

    return _changed_solids(change)


def _changed_solids(change: Callable[[float, SolidScene], SolidScene]) -> Customize:
    return lambda wires: wires.interpose(
        "solids_W", "changed_solids", ChangedMessages("solids_W", SolidScene(), change)
    )
