"""Log of one motion as ROS 2 messages in a bag.

==================  ==============================  ==============================================
topic               type                            content
==================  ==============================  ==============================================
/obstacles          visualization_msgs/Marker       observed obstacles, dilated by the tool
/tool_clearance     std_msgs/Float64                true distance of the tool to obstacles [m]
/robot_clearance    std_msgs/Float64                true distance of the robot to obstacles [m]
/rosout             rcl_interfaces/Log              layer of each decision: "verification" (selects
                                                    the motion) or "guard" (selects maneuvers);
                                                    notes that explain why the motion is held;
                                                    reasons for which the motion guard slows or
                                                    stops the arm
/log/<key>          std_msgs/Float64                keys of the log with one number per instant
/log/<key>          std_msgs/Float64MultiArray      keys of the log with several numbers per instant
/log/constants      std_msgs/String                 all other keys as JSON, with null for NaN and
                                                    infinity
==================  ==============================  ==============================================

The docstring of `drake_oa.runs.motion_log` lists the keys of the log. Points and markers are in the
frame "world". Times are simulated times.
"""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from typing import Any

from pydrake.math import RotationMatrix

from drake_oa.common.bags import BagWriter, quaternion, vector
from drake_oa.common.messages import EllipsoidSet
from drake_oa.runs.motion_log import MotionLog
from drake_oa.runs.report import motion_metrics
from drake_oa.scenario.scenario import Scenario

_STEP = 8
"""Interval between two messages of a clearance in the bag, in logged instants: the computation of
clearances is too slow for every instant."""
_INFO = 20
"""Severity of the messages on the topic /rosout: INFO of rcl_interfaces/Log."""
_SPHERE, _DELETE_ALL = 2, 3
"""Constants of visualization_msgs/Marker: type of an ellipsoid, and action that removes all
markers."""
_COLOR = {"r": 0.8, "a": 0.4}
"""Red component and opacity of the color of the obstacles' markers, in [0, 1] [-]."""


def write_log(bag: BagWriter, scenario: Scenario, log: MotionLog) -> None:
    """Writes the log of a motion as ROS 2 messages to a bag.

    The table in the docstring of the module `drake_oa.runs.bag_log` lists the topics.

    Args:
        bag: writer of the bag.
        scenario: scenario of the log.
        log: log of the motion.
    """
    arrays = log.arrays()
    series: dict[str, Any] = {
        key: values
        for key, values in arrays.items()
        if values.dtype.kind == "f" and values.ndim in (1, 2) and len(values) == len(log.t)
    }
    sparse = replace(log, **{key: values[::_STEP] for key, values in series.items()})
    metrics = motion_metrics(scenario, sparse)
    rows = [(f"/log/{key}", log.t, values) for key, values in series.items()]
    rows.append(("/tool_clearance", sparse.t, metrics.tool_clearance))
    rows.append(("/robot_clearance", sparse.t, metrics.robot_clearance))
    for topic, instants, values in rows:
        kind = f"std_msgs/msg/Float64{'MultiArray' * (values.ndim - 1)}"
        for time, value in zip(instants, values.tolist(), strict=True):
            bag.write(topic, kind, time, data=value)
    for row, time in enumerate(log.observation_time):
        _write_obstacles(bag, time, log.observation(row))
    notes = {
        "decision": log.decision_layer,
        "event": log.event,
        "supervision": log.supervision_reason,
    }
    for name, texts in notes.items():
        for time, text in zip(arrays[f"{name}_time"], texts, strict=True):
            bag.write("/rosout", "rcl_interfaces/msg/Log", time, level=_INFO, name=name, msg=text)
    constants = {key: values.tolist() for key, values in arrays.items() if key not in series}
    # JSON has no NaN and no infinity.
    constants = json.loads(json.dumps(constants), parse_constant=lambda _: None)
    bag.write("/log/constants", "std_msgs/msg/String", 0.0, data=json.dumps(constants))


def _write_obstacles(bag: BagWriter, time: float, obstacles: EllipsoidSet) -> None:
    """Writes the markers of observed ellipsoids, which replace all earlier markers.

    Args:
        bag: writer of the bag.
        time: simulated time at which the observation became available [s].
        obstacles: ellipsoids around the obstacles, dilated by the tool, in the world frame.
    """
    write = partial(bag.write, "/obstacles", "visualization_msgs/msg/Marker", time)
    write(action=_DELETE_ALL)
    shapes = (obstacles.ids, obstacles.p_WO, obstacles.R_WO, obstacles.semi_axes)
    for track, p_WO, R_WO, semi_axes in zip(*shapes, strict=True):
        pose = {"position": vector(p_WO), "orientation": quaternion(RotationMatrix(R_WO))}
        scale = vector(2.0 * semi_axes)
        write(id=track, type=_SPHERE, pose=pose, scale=scale, color=_COLOR)
