"""Depth images as LCM messages.

Drake's `LcmImageArrayToImages` copies only a part of an uncompressed image (Drake 1.51: half of
16 bit, a quarter of 32 bit), so that they are unpacked here.
"""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np
from drake import lcmt_header, lcmt_image, lcmt_image_array
from numpy.typing import NDArray

CHANNEL = "DRAKE_RGBD_CAMERA_IMAGES_{}"
"""Of a camera's images."""

_MILLIMETRE = 1e-3
_FAR = 65535
_TYPES: dict[int, np.dtype[Any]] = {
    lcmt_image.CHANNEL_TYPE_UINT16: np.dtype(np.uint16),
    lcmt_image.CHANNEL_TYPE_FLOAT32: np.dtype(np.float32),
}


def pack_depth(depth: NDArray[np.float32], *, camera: str, utime: int) -> lcmt_image_array:
    """A depth image in millimetres, compressed by zlib.

    Args:
        depth: (H, W) along the optical axis [m]; 0 is too near, inf too far, NaN missing. The
            message has 0 for both the first and the last.
        camera: name of the frame.
        utime: when it was taken, by the wall clock [us].
    """
    near = np.nan_to_num(depth, nan=0.0, posinf=_FAR * _MILLIMETRE)
    values = np.clip(np.rint(near / _MILLIMETRE), 0, _FAR).astype("<u2")
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


def unpack_depth(message: lcmt_image_array) -> tuple[NDArray[np.float32], int]:
    """The depth image of a message, zlib or uncompressed, and when it was taken.

    Returns:
        (H, W) along the optical axis [m], inf is too far, NaN missing or too near; and the
        stamp [us].

    Raises:
        ValueError: if it holds no depth image, or one that cannot be unpacked.
    """
    depths = [i for i in message.images if i.pixel_format == lcmt_image.PIXEL_FORMAT_DEPTH]
    if len(depths) != 1:
        raise ValueError(f"message of {len(depths)} depth images; it must hold one")
    (image,) = depths
    kind = _TYPES.get(image.channel_type)
    if kind is None:
        raise ValueError(f"depth of channel type {image.channel_type}; 16U or 32F is read")
    kind = kind.newbyteorder(">" if image.bigendian else "<")
    data = bytes(image.data)
    count = image.height * image.row_stride
    if image.compression_method == lcmt_image.COMPRESSION_METHOD_ZLIB:
        try:
            data = zlib.decompressobj().decompress(data, count + 1)
        except zlib.error as error:
            raise ValueError(f"depth image cannot be unpacked: {error}") from None
    elif image.compression_method != lcmt_image.COMPRESSION_METHOD_NOT_COMPRESSED:
        raise ValueError(
            f"depth image of compression method {image.compression_method}; zlib or none is read"
        )
    if len(data) != count or image.row_stride < image.width * kind.itemsize:
        raise ValueError(
            f"depth image of {len(data)} bytes, where {image.width} x {image.height} need {count}"
        )
    rows = np.frombuffer(data, np.uint8).reshape(image.height, image.row_stride)
    values = np.ascontiguousarray(rows[:, : image.width * kind.itemsize]).view(kind)
    depth = values.astype(np.float32)
    if kind.itemsize == 2:
        depth *= _MILLIMETRE
        depth[values == _FAR] = np.inf
    depth[values == 0] = np.nan
    return depth, int(image.header.utime)
