"""Faults that a scenario asks for, as functions of time.

    faults: [!CameraDropout {start: 1.0, duration: 0.5}, !TorqueSaturation {start: 2.0}]

A fault lasts for start <= t < start + duration. Frames are counted from time 0, where the first
is taken.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from drake_oa.common.messages import FloatArray
from drake_oa.scenario.faults import CameraDropout, Fault, Push, TorqueSaturation

_ROUNDING = 1e-6  # of a frame's period
_NOW = 1e-9  # rounding of a time [s]


def is_lost(faults: Sequence[Fault], frame: int, period: float) -> bool:
    """Returns whether the frame of a number, from 0, falls into a dropout; period in [s]."""
    return any(
        isinstance(fault, CameraDropout)
        and _first_frame(fault.start, period)
        <= frame
        < _first_frame(fault.start + fault.duration, period)
        for fault in faults
    )


def torque_scale(faults: Sequence[Fault], time: float) -> float:
    """What the actuators give at a time [s], as a share of their effort limits."""
    scales = [
        fault.scale
        for fault in faults
        if isinstance(fault, TorqueSaturation)
        and fault.start <= time < fault.start + fault.duration
    ]
    return min(scales, default=1.0)


def push_wrench(push: Push, time: float) -> FloatArray:
    """(6,) torque [N m] and force [N] of a push in the world at a time [s]."""
    if not push.start <= time + _NOW < push.start + push.duration:
        return np.zeros(6)
    return np.array([*push.torque, *push.force], dtype=float)


def _first_frame(start: float, period: float) -> int:
    """The first frame taken at or after a time."""
    return math.ceil(start / period - _ROUNDING)
