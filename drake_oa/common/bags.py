"""Bags of ROS 2 messages (rosbag2) without ROS: message types, and the writer of an MCAP file.

The optional package rosbags reads and writes the files. Times in messages are whole nanoseconds.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from drake_oa.common.files import OutputError, import_extra

WORLD = "world"
"""Name of the world frame in messages."""
SECOND = 1_000_000_000
"""Number of nanoseconds in a second."""

_SCALAR, _MESSAGE = 1, 2
"""Kinds of fields and items in the type definitions of rosbags; the others are sequences."""


@cache
def typestore() -> Any:
    """Returns the message types of ROS 2 Jazzy, with functions that encode and decode messages.

    Raises:
        ValueError: if rosbags is not installed; names the extra that installs it.
    """
    typesys = import_extra("rosbags.typesys", "bags")
    return typesys.get_typestore(typesys.Stores.ROS2_JAZZY)


def make_message(kind: str, values: Mapping[str, Any]) -> Any:
    """Creates a message.

    Args:
        kind: type of the message, for example "std_msgs/msg/Header".
        values: values of its fields by name, and others, which are ignored. That of a field that
            is a message is again such a mapping. Fields without a value are zero or empty; a
            sequence of texts must have one.
    """
    store = typestore()
    definitions = store.fielddefs[kind][1]
    fields = (_field(form, of, values.get(name)) for name, (form, of) in definitions)
    return store.types[kind](*fields)


def _field(form: int, of: Any, value: Any) -> Any:
    """Returns the value of a field from that of `make_message`; None: zero or empty.

    Args:
        form: kind of the field in the type definitions of rosbags.
        of: type of the field, for a sequence its items and its length.
        value: value for `make_message`.
    """
    if form == _MESSAGE:
        return make_message(of, value or {})
    if form == _SCALAR:
        return value if value is not None else "" if of[0] == "string" else 0
    (item, item_of), count = of
    if item == _MESSAGE:
        return [make_message(item_of, each) for each in value or ()]
    return np.zeros(count, item_of[0]) if value is None else value


def nanoseconds(time: float) -> int:
    """Converts a time [s] to whole nanoseconds."""
    return round(time * SECOND)


def header(time: float, frame: str = WORLD) -> dict[str, Any]:
    """Returns the fields of a message header with a stamp [s] and the name of a frame."""
    second, rest = divmod(nanoseconds(time), SECOND)
    return {"stamp": {"sec": second, "nanosec": rest}, "frame_id": frame}


def vector(values: Iterable[float]) -> dict[str, float]:
    """Returns the fields of a point or vector (3,), or of a quaternion (4,) x, y, z, w."""
    return dict(zip("xyzw", values, strict=False))


class BagWriter:
    """Writer of messages to a bag; `new_bag` creates it."""

    def __init__(self, writer: Any, path: Path) -> None:
        """Initializes the writer without topics.

        Args:
            writer: open rosbag2 writer of rosbags.
            path: file of the bag, for messages to the user.
        """
        self._writer, self._path = writer, path
        self._connections: dict[str, Any] = {}

    def write(self, topic: str, kind: str, time: float, frame: str = WORLD, **values: Any) -> None:
        """Writes a message.

        Args:
            topic: topic of the message, on which all messages have the same type.
            kind: type of the message, for example "std_msgs/msg/Header".
            time: time of the message, also in its fields `header` and `stamp` [s].
            frame: name of the frame in its header.
            values: its other fields, as for `make_message`.

        Raises:
            OutputError: if the file cannot be written.
        """
        store, head = typestore(), header(time, frame)
        message = make_message(kind, {"header": head, **head, **values})
        data = store.serialize_cdr(message, kind)
        try:
            if topic not in self._connections:
                connection = self._writer.add_connection(topic, kind, typestore=store)
                self._connections[topic] = connection
            self._writer.write(self._connections[topic], nanoseconds(time), data)
        except OSError as error:
            raise OutputError(f"cannot write {self._path}: {error.strerror or error}") from error


@contextlib.contextmanager
def new_bag(path: Path) -> Iterator[BagWriter]:
    """Provides the writer of a bag; the file is replaced when the `with` block ends without error.

    Args:
        path: MCAP file of the bag; its folder exists.

    Raises:
        OutputError: if the file cannot be written.
        ValueError: if rosbags is not installed; names the extra that installs it.
    """
    rosbag2 = import_extra("rosbags.rosbag2", "bags")
    with TemporaryDirectory(suffix=".part", prefix=f"{path.name}.", dir=path.parent) as folder:
        # The package writes a folder; one file is opened more easily by viewers.
        bag = Path(folder, "bag")
        with rosbag2.Writer(bag, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP) as writer:
            yield BagWriter(writer, path)
        os.replace(bag / "bag.mcap", path)
