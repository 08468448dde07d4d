"""Depth images as LCM messages, and what receives them.

Drake's `LcmImageArrayToImages` copies only a part of an uncompressed image (Drake 1.51: half of
16 bit, a quarter of 32 bit), so that they are unpacked here.
"""

from __future__ import annotations

import weakref
import zlib
from collections import deque
from typing import Any, NamedTuple

import numpy as np
from drake import lcmt_header, lcmt_image, lcmt_image_array
from numpy.typing import NDArray
from pydrake.lcm import DrakeLcm

from drake_oa.common.config import field_errors

CHANNEL = "DRAKE_RGBD_CAMERA_IMAGES_{}"
"""Of a camera's images."""

_MILLIMETER = 1e-3
_MICROSECOND = 1e-6
_FAR = 65535
_TYPES: dict[int, np.dtype[Any]] = {
    lcmt_image.CHANNEL_TYPE_UINT16: np.dtype(np.uint16),
    lcmt_image.CHANNEL_TYPE_FLOAT32: np.dtype(np.float32),
}


def pack_depth(depth: NDArray[np.float32], *, camera: str, utime: int) -> lcmt_image_array:
    """A depth image in millimeters, compressed by zlib.

    Args:
        depth: (H, W) along the optical axis [m]; 0 is too near, inf too far, NaN missing. The
            message has 0 for both the first and the last.
        camera: name of the frame.
        utime: when it was taken, by the wall clock [us].
    """
    near = np.nan_to_num(depth, nan=0.0, posinf=_FAR * _MILLIMETER)
    values = np.clip(np.rint(near / _MILLIMETER), 0, _FAR).astype("<u2")
    data = zlib.compress(values.tobytes(), 1)
    header = lcmt_header()
    header.utime, header.frame_name = utime, camera
    image = lcmt_image()
    image.header = header
    image.height, image.width = depth.shape
    image.row_stride = image.width * values.itemsize
    image.size, image.data = len(data), data
    image.pixel_format = lcmt_image.PIXEL_FORMAT_DEPTH
    image.channel_type = lcmt_image.CHANNEL_TYPE_UINT16
    image.compression_method = lcmt_image.COMPRESSION_METHOD_ZLIB
    message = lcmt_image_array()
    message.header, message.num_images, message.images = header, 1, [image]
    return message


class Frame(NamedTuple):
    """Depth image of a camera.

    Attributes:
        depth: (H, W) along the optical axis [m]; inf is too far, NaN missing.
        stamp: time at which it was taken, by the wall clock [s].
    """

    depth: NDArray[np.float32]
    stamp: float


def unpack_depth(message: lcmt_image_array) -> Frame:
    """Reads the depth image of a message, zlib or uncompressed, 16U [mm] or 32F [m].

    Raises:
        ValueError: if it holds no depth image, or one that cannot be unpacked.
    """
    depths = [i for i in message.images if i.pixel_format == lcmt_image.PIXEL_FORMAT_DEPTH]
    if len(depths) != 1:
        raise ValueError(f"message of {len(depths)} depth images; it must hold one")
    (image,) = depths
    data = bytes(image.data)
    try:
        if image.compression_method == lcmt_image.COMPRESSION_METHOD_ZLIB:
            data = zlib.decompressobj().decompress(data, image.height * image.row_stride + 1)
        values = np.frombuffer(data, _TYPES[image.channel_type])
        values = values.reshape(image.height, image.width)
    except (KeyError, ValueError, zlib.error) as error:
        raise ValueError(
            f"depth image cannot be unpacked, must be {image.width} x {image.height} of 16U or "
            f"32F, zlib or uncompressed: {error}"
        ) from None
    depth = values.astype(np.float32)
    if values.dtype == np.uint16:
        depth *= _MILLIMETER
        depth[values == _FAR] = np.inf
    depth[values == 0] = np.nan
    return Frame(depth, image.header.utime * _MICROSECOND)


_buses: weakref.WeakValueDictionary[str, DrakeLcm] = weakref.WeakValueDictionary()


def lcm_bus(url: str) -> DrakeLcm:
    """Returns the bus of a URL; while it is in use, all cameras of this process share it.

    Raises:
        RuntimeError: from Drake, for a URL that it cannot open.
    """
    bus = _buses.get(url)
    if bus is None:
        bus = _buses[url] = DrakeLcm(url)
    return bus


class LcmFrames:
    """A camera's images as they come by LCM.

    Attributes:
        name: channel and URL.
    """

    def __init__(self, url: str, camera: str) -> None:
        """Subscribes.

        Args:
            url: of the LCM bus.
            camera: name of the camera, which the channel ends with.

        Raises:
            ScenarioError: for a URL that cannot be opened.
        """
        self._url, self._channel = url, CHANNEL.format(camera)
        self.name = f"LCM channel {self._channel} at {url}"
        self._bus: DrakeLcm | None = None
        # Drake forbids a handler to raise: images are decoded when they are read.
        self._received: deque[bytes] = deque(maxlen=1)
        self.open()

    def open(self) -> None:
        """Subscribes again, where it was closed.

        Raises:
            ScenarioError: for a URL that cannot be opened.
        """
        if self._bus is not None:
            return
        with field_errors(f"perception.lcm_url: '{self._url}'", RuntimeError):
            self._bus = lcm_bus(self._url)
        self._received = deque(maxlen=1)
        self._bus.Subscribe(self._channel, self._received.append)
        self._receive()
        self._received.clear()

    def latest(self) -> Frame | None:
        """Returns the newest image since the last call; None: none has come.

        Raises:
            ValueError: for a message that cannot be read.
        """
        self._receive()
        if not self._received:
            return None
        try:
            message = lcmt_image_array.decode(self._received.pop())
        except Exception as error:  # The kind of exception depends on the damage.
            raise ValueError(f"message is no lcmt_image_array: {error}") from None
        return unpack_depth(message)

    def close(self) -> None:
        """Releases the bus, without its last image."""
        self._bus = None
        self._received.clear()

    def _receive(self) -> None:
        while self._bus is not None and self._bus.HandleSubscriptions(0):
            pass
