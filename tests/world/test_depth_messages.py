"""Packing and unpacking of depth images as LCM messages."""

import zlib

import numpy as np
import pytest
from drake import lcmt_image, lcmt_image_array

from drake_oa.world.depth_messages import pack_depth, unpack_depth

DEPTH = np.linspace(0.5, 3.0, 48 * 64).reshape(48, 64).astype(np.float32)


def packed() -> lcmt_image_array:
    """Returns a depth message as received: decoded from its bytes."""
    message = pack_depth(DEPTH, camera="camera", utime=123)
    return lcmt_image_array.decode(message.encode())


def uncompressed(message: lcmt_image_array) -> lcmt_image_array:
    """Decompresses the image of a message in place."""
    (image,) = message.images
    image.data = zlib.decompress(image.data)
    image.size = len(image.data)
    image.compression_method = lcmt_image.COMPRESSION_METHOD_NOT_COMPRESSED
    return message


@pytest.mark.parametrize("message", [packed(), uncompressed(packed())])
def test_unpacked_depth_is_accurate_to_half_a_millimeter(message: lcmt_image_array) -> None:
    depth, stamp = unpack_depth(message)
    np.testing.assert_allclose(depth, DEPTH, atol=0.51e-3)
    assert stamp == pytest.approx(123e-6)


def test_missing_pixels_remain_missing() -> None:
    depth = np.array([[0.0, np.nan], [np.inf, 1.0]], np.float32)
    back, _ = unpack_depth(pack_depth(depth, camera="camera", utime=0))
    np.testing.assert_allclose(back, [[np.nan, np.nan], [np.inf, 1.0]])


def test_unpacks_depths_in_meters() -> None:
    message = uncompressed(packed())
    (image,) = message.images
    image.channel_type = lcmt_image.CHANNEL_TYPE_FLOAT32
    image.data = DEPTH.tobytes()
    np.testing.assert_array_equal(unpack_depth(message)[0], DEPTH)


@pytest.mark.parametrize(
    ("field", "value", "why"),
    [
        ("pixel_format", lcmt_image.PIXEL_FORMAT_RGB, "0 depth images"),
        ("channel_type", lcmt_image.CHANNEL_TYPE_INT8, "cannot be unpacked"),
        ("data", b"nonsense", "cannot be unpacked"),
        ("width", 65, "must have 65 x 48 pixels"),
    ],
)
def test_error_of_an_invalid_message_names_the_problem(field: str, value: object, why: str) -> None:
    message = packed()
    setattr(message.images[0], field, value)
    with pytest.raises(ValueError, match=why):
        unpack_depth(message)
