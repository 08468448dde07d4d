"""An arm and its surroundings as arrays: what `drake_oa.posture.posture_plan` plans with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drake_oa.common.kernel_arrays import kernel_arrays
from drake_oa.common.messages import FloatArray, Frozen, IntArray
from drake_oa.robot import arm_kernels as kernels


@dataclass(frozen=True, eq=False)
class ArmModel(Frozen):
    """An arm of n revolute joints in a row, as `drake_oa.robot.arm_model.make_arm_model` reads it.

    A body's frame is that of the joint that moves it; bodies are counted by their joint.

    Attributes:
        index: (n,) where its joints are in the plant's positions.
        X_PJ: (n + 1, 4, 4) frame of each joint in the body before it (the first in the world),
            its z axis being the joint's, and of the tool point E in the last body.
        R_WE: (3, 3) orientation of the tool.
        posture: (n,) that the null space is drawn to where nothing is in the way [rad].
        mass: (n, n) mass matrix there, as a metric [kg m^2].
        lower, upper: (n,) joint limits [rad].
        speed: (n,) their velocity limits [rad/s].
        shapes: what may touch obstacles, as `arm_kernels.nearest_point` takes it: body_sphere,
            shape_body, X_BG, size, bound.
        parts: what may touch each other, as `arm_kernels.self_distance` takes it: part_body,
            part_first, part_sphere, rod, rod_radius, pairs.
    """

    index: IntArray
    X_PJ: FloatArray
    R_WE: FloatArray
    posture: FloatArray
    mass: FloatArray
    lower: FloatArray
    upper: FloatArray
    speed: FloatArray
    shapes: tuple[FloatArray | IntArray, ...]
    parts: tuple[FloatArray | IntArray, ...]

    def poses(self, q: FloatArray) -> FloatArray:
        """(n + 1, 4, 4) poses of the bodies, and of E, in the world."""
        X_WB = np.empty((len(self.posture) + 1, 4, 4))
        kernels.poses(*kernel_arrays(q, self.X_PJ), X_WB)
        return X_WB
