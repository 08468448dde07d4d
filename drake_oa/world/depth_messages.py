"""LCM messages of depth images: functions that pack and unpack images, and a receiver of a camera's
images.

Drake's `LcmImageArrayToImages` copies only a part of an uncompressed image (Drake 1.51: half of a
16-bit, a quarter of a 32-bit image). This module unpacks images completely.
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
"""Format string of the name of the LCM channel on which a camera's images are sent; the argument is
the camera name."""

_MILLIMETER = 1e-3
"""Unit of 16-bit depths in LCM image messages [m]."""
_MICROSECOND = 1e-6
"""Unit of time stamps in LCM image messages [s]."""
_FAR = 65535
"""Largest 16-bit depth value in LCM image messages, which marks pixels that are too far for the
camera [mm]."""
_TYPES: dict[int, np.dtype[Any]] = {
    lcmt_image.CHANNEL_TYPE_UINT16: np.dtype(np.uint16),
    lcmt_image.CHANNEL_TYPE_FLOAT32: np.dtype(np.float32),
}
"""NumPy types of the depth values in LCM image messages, by the field `channel_type` of the image
(`lcmt_image`)."""


def pack_depth(depth: NDArray[np.float32], *, camera: str, utime: int) -> lcmt_image_array:
    """Packs a depth image into an LCM message with 16-bit depths in millimeters, compressed by
    zlib.

    Args:
        depth: (H, W) depths along the optical axis [m]; 0 is too near, inf is too far, NaN is
            missing. In the message, pixels that are too near or missing are 0, and pixels that are
            too far are 65535.
        camera: name of the camera's frame in the message header.
        utime: capture time of the image by the wall clock [us].
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
    """Depth image that was received from a camera outside the simulation.

    Attributes:
        depth: (H, W) depths along the optical axis [m]; inf is too far, NaN is missing or too near.
        stamp: capture time of the image by the wall clock [s].
    """

    depth: NDArray[np.float32]
    stamp: float


def unpack_depth(message: lcmt_image_array) -> Frame:
    """Unpacks the depth image of an LCM message.

    The image may be uncompressed or compressed by zlib. Depths in the message are 16-bit integers
    [mm] or 32-bit floats [m]; 0 is too near or missing, 65535 mm is too far.

    Raises:
        ValueError: if the message does not hold exactly one depth image, or the data of the image
            have another size, type or compression.
    """
    depths = [i for i in message.images if i.pixel_format == lcmt_image.PIXEL_FORMAT_DEPTH]
    if len(depths) != 1:
        raise ValueError(f"message with {len(depths)} depth images; it must hold exactly one")
    (image,) = depths
    data = bytes(image.data)
    try:
        if image.compression_method == lcmt_image.COMPRESSION_METHOD_ZLIB:
            data = zlib.decompressobj().decompress(data, image.height * image.row_stride + 1)
        values = np.frombuffer(data, _TYPES[image.channel_type])
        values = values.reshape(image.height, image.width)
    except (KeyError, ValueError, zlib.error) as error:
        raise ValueError(
            f"depth image cannot be unpacked; it must have {image.width} x {image.height} pixels "
            f"of 16U or 32F, zlib or uncompressed: {error}"
        ) from None
    return Frame(metric_depth(values), image.header.utime * _MICROSECOND)


def metric_depth(values: NDArray[Any]) -> NDArray[np.float32]:
    """Converts the depths of a message, 16-bit integers [mm] or 32-bit floats [m], to meters.

    The depth 0 becomes NaN (missing). The largest 16-bit depth, 65535 mm, becomes inf (too far).

    Args:
        values: (H, W) depths of the message.

    Returns:
        (H, W) depths [m].
    """
    depth = values.astype(np.float32)
    if values.dtype.kind == "u":
        depth *= _MILLIMETER
        depth[values == _FAR] = np.inf
    depth[values == 0] = np.nan
    return depth


_buses: weakref.WeakValueDictionary[str, DrakeLcm] = weakref.WeakValueDictionary()
"""Open LCM buses of this process, by URL; a bus is closed when no receiver uses it."""


def lcm_bus(url: str) -> DrakeLcm:
    """Returns the LCM bus of a URL, which all cameras of this process share.

    Raises:
        RuntimeError: from Drake, for a URL that cannot be opened.
    """
    bus = _buses.get(url)
    if bus is None:
        bus = _buses[url] = DrakeLcm(url)
    return bus


class LcmFrames:
    """Receiver of the depth images that a camera outside the simulation sends on an LCM channel.

    Attributes:
        name: text with the name of the channel and the URL of its LCM bus, for error messages.
    """

    def __init__(self, url: str, camera: str) -> None:
        """Subscribes to the LCM channel of a camera.

        Args:
            url: URL of the LCM bus.
            camera: name of the camera, which is the last part of the channel's name.

        Raises:
            ScenarioError: for a URL that cannot be opened as an LCM bus.
        """
        self._url, self._channel = url, CHANNEL.format(camera)
        self.name = f"LCM channel {self._channel} at {url}"
        self._bus: DrakeLcm | None = None
        # LCM handlers must not raise: `latest` decodes the images.
        self._received: deque[bytes] = deque(maxlen=1)
        self.open()

    def open(self) -> None:
        """Subscribes to the camera's channel, unless the receiver is already open.

        Images that were received before are discarded.

        Raises:
            ScenarioError: for a URL that cannot be opened as an LCM bus.
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
        """Returns the newest image that was received since the last call of this method; None if
        there is no new image.

        Raises:
            ValueError: for a message that is no `lcmt_image_array` with exactly one depth image, or
                whose image has data of another size, type or compression.
        """
        self._receive()
        if not self._received:
            return None
        try:
            message = lcmt_image_array.decode(self._received.pop())
        except Exception as error:  # Invalid data raise exceptions of several types.
            raise ValueError(f"message is no lcmt_image_array: {error}") from None
        return unpack_depth(message)

    def close(self) -> None:
        """Releases the LCM bus and discards the last received image; `open` subscribes to the
        camera again.
        """
        self._bus = None
        self._received.clear()

    def _receive(self) -> None:
        """Handles all pending messages of the LCM bus, so that the camera's newest message is
        stored.
        """
        while self._bus is not None and self._bus.HandleSubscriptions(0):
            pass
