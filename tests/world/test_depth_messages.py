"""Depth images as LCM messages."""

import zlib

import numpy as np
import pytest
from drake import lcmt_image, lcmt_image_array
from pydrake.lcm import DrakeLcm
from pydrake.systems.lcm import LcmSubscriberSystem
from pydrake.systems.sensors import LcmImageArrayToImages

from drake_oa.world.depth_messages import pack_depth, unpack_depth

DEPTH = np.linspace(0.5, 3.0, 48 * 64).reshape(48, 64).astype(np.float32)


def packed() -> lcmt_image_array:
    """As it comes: decoded from its bytes."""
    message = pack_depth(DEPTH, camera="camera", utime=123)
    return lcmt_image_array.decode(message.encode())


def uncompressed(message: lcmt_image_array) -> lcmt_image_array:
    (image,) = message.images
    image.data = zlib.decompress(image.data)
    image.size = len(image.data)
    image.compression_method = lcmt_image.COMPRESSION_METHOD_NOT_COMPRESSED
    return message


def test_depth_comes_back_to_half_a_millimetre() -> None:
    for message in (packed(), uncompressed(packed())):
        depth, utime = unpack_depth(message)
        np.testing.assert_allclose(depth, DEPTH, atol=0.51e-3)
        assert utime == 123


def test_what_was_not_measured_stays_so() -> None:
    depth = np.array([[0.0, np.nan], [np.inf, 1.0]], np.float32)
    back, _ = unpack_depth(pack_depth(depth, camera="camera", utime=0))
    np.testing.assert_allclose(back, [[np.nan, np.nan], [np.inf, 1.0]])


def test_reads_metres_of_either_byte_order_and_padded_rows() -> None:
    message = uncompressed(packed())
    (image,) = message.images
    image.channel_type = lcmt_image.CHANNEL_TYPE_FLOAT32
    image.bigendian = True
    rows = np.zeros((48, 66), ">f4")
    rows[:, :64] = DEPTH
    image.data, image.row_stride = rows.tobytes(), 66 * 4
    np.testing.assert_array_equal(unpack_depth(message)[0], DEPTH)


def test_drake_reads_it_too() -> None:
    lcm = DrakeLcm("memq://")
    subscriber = LcmSubscriberSystem.Make("images", lcmt_image_array, lcm, use_cpp_serializer=True)
    lcm.Publish("images", packed().encode())
    lcm.HandleSubscriptions(0)
    context = subscriber.CreateDefaultContext()
    subscriber.ExecuteForcedEvents(context)
    system = LcmImageArrayToImages()
    reader = system.CreateDefaultContext()
    value = subscriber.get_output_port().EvalAbstract(context)
    system.image_array_t_input_port().FixValue(reader, value)
    image = system.depth_image_output_port().Eval(reader)
    np.testing.assert_allclose(image.data[:, :, 0], DEPTH, atol=0.51e-3)


@pytest.mark.parametrize(
    ("field", "value", "why"),
    [
        ("pixel_format", lcmt_image.PIXEL_FORMAT_RGB, "0 depth images"),
        ("compression_method", lcmt_image.COMPRESSION_METHOD_PNG, "compression method 3"),
        ("data", b"nonsense", "cannot be unpacked"),
        ("width", 65, "65 x 48 need"),
    ],
)
def test_says_what_cannot_be_read(field: str, value: object, why: str) -> None:
    message = packed()
    setattr(message.images[0], field, value)
    with pytest.raises(ValueError, match=why):
        unpack_depth(message)
