"""Rotations: vectors, matrices and quaternions, and what is turned by them."""

from __future__ import annotations

import math

import numpy as np

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray


@compiled
def rotation_vector(R: FloatArray) -> FloatArray:
    """Log map of a rotation: unit axis times angle, the angle in [0, pi].

    Args:
        R: (3, 3) rotation matrix.

    Returns:
        (3,) rotation vector [rad].
    """
    twice = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine = 0.5 * math.sqrt(twice[0] ** 2 + twice[1] ** 2 + twice[2] ** 2)
    cosine = 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0)
    angle = math.atan2(sine, cosine)
    if cosine > 0.0:
        scale = 0.5 * angle / sine if sine > 1e-8 else 0.5
        return scale * twice
    # Towards half a turn the antisymmetric part fades; the symmetric part is
    # cos I + (1 - cos) a a^T, from whose largest column the axis a follows.
    k = 0
    for i in range(1, 3):
        if R[i, i] > R[k, k]:
            k = i
    axis = np.empty(3)
    for i in range(3):
        axis[i] = 0.5 * (R[i, k] + R[k, i])
    axis[k] -= cosine
    norm = math.sqrt(axis[0] ** 2 + axis[1] ** 2 + axis[2] ** 2)
    sense = axis[0] * twice[0] + axis[1] * twice[1] + axis[2] * twice[2]
    return (angle / norm if sense >= 0.0 else -angle / norm) * axis


def rotation_of(quaternion: FloatArray) -> FloatArray:
    """Rotation matrix (3, 3) of a quaternion (4,), w first, of any length but zero.

    All NaN where the quaternion is zero or not finite.
    """
    with np.errstate(invalid="ignore"):
        scaled = quaternion / np.abs(quaternion).max()
        w, x, y, z = scaled / math.sqrt(scaled @ scaled)
        K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        return np.asarray(np.eye(3) + 2.0 * (w * K + K @ K))
