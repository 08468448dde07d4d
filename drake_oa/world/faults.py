"""Faults that a scenario asks for: what goes wrong, when, and what it does to a signal.

    faults: [!CameraDropout {start: 1.0, duration: 0.5}, !TorqueSaturation {start: 2.0}]

A camera's fault is one of delivery (which frame arrives: `delivered_frame`) or of content
(what is in a frame, by the time it was taken: `damaged_frame`). Frames are counted from
time 0, where the first is taken; a fault lasts for start <= t < start + duration.

Other faults bring an obstacle of their own: `goal_ball` and `start_plate`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from drake_oa.common.messages import FloatArray
from drake_oa.geometry.shapes import Box, Sphere
from drake_oa.scenario.faults import (
    CameraDropout,
    Fault,
    FrameBurst,
    GoalBlocked,
    NanFrames,
    Push,
    StartInContact,
    TableMissing,
    TorqueSaturation,
)
from drake_oa.scenario.obstacles import Obstacle

# No postponed annotations here: yaml_load_typed reads the fields' types.


_ROUNDING = 1e-6  # of a frame's period
_NOW = 1e-9  # rounding of a time [s]
TABLE_MARGIN = 0.015
"""Height up to which `TableMissing` takes a point for the table's [m]."""


def delivered_frame(faults: Sequence[Fault], frame: int, period: float) -> int:
    """The number of the frame that arrives when frame number `frame` is due.

    It never goes back from one frame to the next.

    Args:
        faults: those of a scenario.
        frame: number of the frame taken at this time, from 0.
        period: time between frames [s].

    Returns:
        The newest frame that has arrived, at most `frame`; -1: none has yet.
    """
    for fault in faults:
        if not isinstance(fault, CameraDropout | FrameBurst) or frame < 0:
            continue
        first, after = _first_frame(fault.start, period), _frame_after(fault, period)
        lag = after - first
        if first <= frame < after:
            frame = first - 1
        elif isinstance(fault, FrameBurst) and after <= frame < after + lag:
            frame -= lag
    return frame


def damaged_frame(
    faults: Sequence[Fault],
    depth: NDArray[np.float32],
    frame: int,
    period: float,
    K: FloatArray,
    X_WC: FloatArray,
    table_height: float,
) -> NDArray[np.float32]:
    """What a frame shows.

    Args:
        faults: those of a scenario.
        depth: (H, W) the image as it should be [m].
        frame: its number.
        period: time between frames [s].
        K: (4,) fx, fy, cx, cy [pixel], cx and cy where the first pixel's middle is 0.
        X_WC: (4, 4) pose of the camera.
        table_height: of the table in the world [m].

    Returns:
        `depth` itself where nothing is wrong with it, else a new image.
    """
    for fault in faults:
        if isinstance(fault, NanFrames):
            if _first_frame(fault.start, period) <= frame < _frame_after(fault, period):
                depth = np.full_like(depth, np.nan)
        elif isinstance(fault, TableMissing):
            first = _first_frame(fault.start, period)
            if first <= frame < first + fault.frames:
                depth = without_table(depth, K, X_WC, table_height)
    return depth


def without_table(
    depth: NDArray[np.float32], K: FloatArray, X_WC: FloatArray, table_height: float
) -> NDArray[np.float32]:
    """A copy of an image, NaN where it shows the table or what lies below it.

    Args:
        depth: (H, W) [m].
        K: (4,) fx, fy, cx, cy [pixel].
        X_WC: (4, 4) pose of the camera.
        table_height: of the table in the world [m].
    """
    fx, fy, cx, cy = K
    u = (np.arange(depth.shape[1]) - cx) / fx
    v = (np.arange(depth.shape[0]) - cy) / fy
    # Height is depth times a linear map of the pixel.
    slope = X_WC[2, 0] * u + X_WC[2, 1] * v[:, None] + X_WC[2, 2]
    with np.errstate(invalid="ignore"):
        height = depth * slope.astype(np.float32) + np.float32(X_WC[2, 3])
        return np.where(height > table_height + TABLE_MARGIN, depth, np.float32(np.nan))


def frames_to_keep(faults: Sequence[Fault], frame: int, period: float) -> set[int]:
    """The frames, of those up to `frame`, that arrive after the next is due.

    Args:
        faults: those of a scenario.
        frame: number of the frame taken at this time.
        period: time between frames [s].
    """
    due: set[int] = set()
    for fault in faults:
        if isinstance(fault, CameraDropout):
            # All frames of its time are the same one.
            due |= {_first_frame(fault.start, period), _frame_after(fault, period) - 1}
        elif isinstance(fault, FrameBurst):
            first, after = _first_frame(fault.start, period), _frame_after(fault, period)
            due |= set(range(first - 1, 2 * after - first + 1))
    arriving = {delivered_frame(faults, later, period) for later in due if later > frame}
    return {kept for kept in arriving if 0 <= kept <= frame}


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


def _frame_after(fault: CameraDropout | NanFrames | FrameBurst, period: float) -> int:
    """The first frame taken after a fault's end."""
    return _first_frame(fault.start + fault.duration, period)


PARKED_BEYOND = 1.2
"""How far beyond the goal the ball of `GoalBlocked` waits [m].

From a goal in reach that is farther from the robot than the start, it is out of reach.
"""
_TRAVEL = 0.4
"""Time of the ball's way to the goal, and of that back [s]."""
_PLATE = (0.006, 0.05, 0.03)  # thickness, width, height [m]
_NEAR = 0.005
"""Corners of the tool this near to its farthest one face the plate [m]."""
_FOAM = 1000.0
"""Stiffness of the plate, below that of the held tool [N/m]."""
_COLOR = [0.75, 0.2, 0.2, 1.0]


def goal_ball(fault: GoalBlocked, start: FloatArray, goal: FloatArray, name: str) -> Obstacle:
    """The ball of a `GoalBlocked`, which takes 0.4 s for each of its ways, there and back.

    It comes from beyond the goal, level, along the line from the start, and is over the goal
    from `start` to `start + duration`; one that starts sooner than 0.4 s comes faster, or is
    there at time 0.

    Args:
        fault: when, and how large.
        start: (3,) of the task, in the world [m].
        goal: (3,) of the task, in the world [m].
        name: of the obstacle.
    """
    begin, end = fault.start, fault.start + fault.duration
    beyond = (-PARKED_BEYOND * _backward(start, goal)).tolist()
    coming = [[max(0.0, begin - _TRAVEL), *beyond]] if begin > 0.0 else []
    there = [[begin, 0.0, 0.0, 0.0], [end, 0.0, 0.0, 0.0]]
    return Obstacle(
        name=name,
        shapes=[Sphere(radius=fault.radius)],
        translation=[float(x) for x in goal],
        color=_COLOR,
        waypoints=[*coming, *there, [end + _TRAVEL, *beyond]],
    )


def _backward(start: FloatArray, goal: FloatArray) -> FloatArray:
    """(3,) the level direction from goal to start; towards the robot where there is none."""
    away = np.array([start[0] - goal[0], start[1] - goal[1], 0.0])
    length = np.linalg.norm(away)
    return np.array([-1.0, 0.0, 0.0]) if length < 1e-6 else away / length


def start_plate(
    fault: StartInContact, corners: FloatArray, start: FloatArray, goal: FloatArray, name: str
) -> Obstacle:
    """The plate of a `StartInContact`: upright, behind the tool, and soft.

    A hard one would throw the tool off at once, and the motion would not start in contact.

    Args:
        fault: how far it overlaps.
        corners: (K, 3) of the tool about its point E at the start, in the world's
            orientation [m].
        start: (3,) where E starts [m].
        goal: (3,) where it should go [m].
        name: of the obstacle.
    """
    away = _backward(start, goal)
    reach = corners @ away
    touched = corners[reach >= reach.max() - _NEAR]
    middle = 0.5 * (touched.min(axis=0) + touched.max(axis=0))
    p_EO = middle + (reach.max() - middle @ away - fault.depth + 0.5 * _PLATE[0]) * away
    return Obstacle(
        name=name,
        shapes=[Box(size=list(_PLATE))],
        translation=[float(x) for x in np.asarray(start) + p_EO],
        rpy=[0.0, 0.0, float(np.arctan2(away[1], away[0]))],
        stiffness=_FOAM,
        color=_COLOR,
    )
