"""Camera faults that tests put between the camera and perception by `customize=`."""

from collections.abc import Callable

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, LeafSystem
from pydrake.systems.sensors import CameraConfig, ImageDepth32F

from drake_oa.common.wires import Wires
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
