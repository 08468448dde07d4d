"""Bags of ROS 2 messages (rosbag2) without ROS: message types, and the writer of an MCAP file.

The optional package mcap-ros2-support writes the files. The optional package rosbags reads them,
and has the definitions of the message types. Times in messages are whole nanoseconds.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drake_oa.common.files import import_extra, output_errors

# Commands without bags start faster without this import.
if TYPE_CHECKING:
    from pydrake.math import RotationMatrix

WORLD = "world"
"""Name of the world frame in messages."""
SECOND = 1_000_000_000
"""Number of nanoseconds in a second."""


@cache
def typestore() -> Any:
    """Returns the message types of ROS 2 Jazzy (a `Typestore` of rosbags), which decodes messages.

    Raises:
        ValueError: if rosbags is not installed; names the pip extra that installs it.
    """
    typesys = import_extra("rosbags.typesys", "bags")
    return typesys.get_typestore(typesys.Stores.ROS2_JAZZY)


def header(time: float, frame: str = WORLD) -> dict[str, Any]:
    """Returns the fields of a message of type std_msgs/msg/Header.

    Args:
        time: stamp of the message [s].
        frame: name of the frame of the message's data.
    """
    second, nanosecond = divmod(round(time * SECOND), SECOND)
    return {"stamp": {"sec": second, "nanosec": nanosecond}, "frame_id": frame}


def vector(values: Iterable[float]) -> dict[str, float]:
    """Returns the fields x, y, z (and w) of the message of a vector, point or quaternion.

    Args:
        values: (3,) vector or point, or (4,) quaternion in the order x, y, z, w.
    """
    return dict(zip("xyzw", values, strict=False))


def quaternion(R: RotationMatrix) -> dict[str, float]:
    """Returns the fields x, y, z, w of the quaternion message of a rotation matrix."""
    w, x, y, z = R.ToQuaternion().wxyz()
    return vector((x, y, z, w))


class BagWriter:
    """Writer of ROS 2 messages to a bag (an MCAP file), which `new_bag` creates.

    The first message creates the file. Until then, an existing file of this name is unchanged.
    """

    def __init__(self, path: Path) -> None:
        """Initializes the writer without topics.

        Args:
            path: MCAP file of the bag, which is replaced; its folder exists.

        Raises:
            ValueError: if an optional package is missing; names the pip extra that installs it.
        """
        self._mcap = import_extra("mcap_ros2.writer", "bags")
        self._path, self._closing = path, contextlib.ExitStack()
        self._schemas: dict[str, Any] = {}
        self._writer: Any = None

    def write(self, topic: str, kind: str, time: float, frame: str = WORLD, **values: Any) -> None:
        """Writes a message.

        Args:
            topic: topic of the message, on which all messages have the same type.
            kind: type of the message, for example "std_msgs/msg/JointState".
            time: time of the message [s]. It is also the stamp in the field `header`, or in the
                field `stamp` of a message without header.
            frame: name of the frame in the field `header`, or in the field `frame_id` of a message
                without header.
            values: other fields by name: numbers, texts, bytes, lists, and dictionaries for
                fields that are messages. Fields without a value are zero or empty.

        Raises:
            OutputError: if the file cannot be written.
        """
        if self._writer is None:
            self._open()
        if kind not in self._schemas:
            definition, _ = typestore().generate_msgdef(kind, ros_version=2)
            self._schemas[kind] = self._writer.register_msgdef(kind, definition)
        head = header(time, frame)
        message = {"header": head, **head, **values}
        with output_errors(self._path):
            self._writer.write_message(topic, self._schemas[kind], message, round(time * SECOND))

    def _open(self) -> None:
        """Creates the MCAP file of the bag, and the writer of this file."""
        with output_errors(self._path):
            file = self._closing.enter_context(self._path.open("wb"))
            # Compressed images and checksums would multiply the time to write and to read them.
            none = self._mcap.CompressionType.NONE
            self._writer = self._mcap.Writer(file, compression=none, enable_crcs=False)
        self._closing.callback(self._writer.finish)

    def close(self) -> None:
        """Completes the MCAP file of the bag, if a message has been written.

        Raises:
            OutputError: if the file cannot be written.
        """
        with output_errors(self._path):
            self._closing.close()


def new_bag(path: Path) -> contextlib.closing[BagWriter]:
    """Provides the writer of a bag, which is completed at the end of the `with` block, also after
    an exception.

    Args:
        path: MCAP file of the bag, which is replaced; its folder exists.

    Raises:
        ValueError: if an optional package is not installed; names the pip extra that installs it.
    """
    return contextlib.closing(BagWriter(path))
