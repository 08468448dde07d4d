import json

import numpy as np
import pytest

from drake_oa.perception.depth_image_files import DepthCoding, checked_intrinsics, read_depth_png

K = [130.0, 131.0, 79.5, 59.5]
MATRIX = [130.0, 0.0, 79.5, 0.0, 131.0, 59.5, 0.0, 0.0, 1.0]


@pytest.fixture
def image(tmp_path):
    path = tmp_path / "scene.png"
    write(path, np.array([[0, 1000], [2000, 3]], dtype=np.uint16))
    return path


def write(path, values):
    import open3d

    open3d.io.write_image(str(path), open3d.geometry.Image(values))


def test_zero_is_missing_and_the_scale_is_applied(image):
    depth, found = read_depth_png(image, DepthCoding(np.array(K), 0.0005))
    np.testing.assert_allclose(depth, [[np.nan, 0.5], [1.0, 0.0015]], rtol=1e-6)
    np.testing.assert_array_equal(found, K)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("scene.json", json.dumps(dict(zip(("fx", "fy", "cx", "cy"), K, strict=True)))),
        ("intrinsics.json", json.dumps({"K": K})),
        ("intrinsics.json", json.dumps({"intrinsic_matrix": np.reshape(MATRIX, (3, 3)).tolist()})),
        ("camera_info.yaml", f"camera_matrix: {{rows: 3, cols: 3, data: {MATRIX}}}"),
        ("scene.yaml", f"k: {MATRIX}"),
    ],
)
def test_intrinsics_beside_the_image_are_found(image, name, content):
    image.with_name(name).write_text(content)
    depth, found = read_depth_png(image)
    np.testing.assert_array_equal(found, K)
    assert depth[0, 1] == pytest.approx(1.0)


def test_the_file_beside_may_name_the_scale(image):
    image.with_name("scene.json").write_text(json.dumps({"K": K, "depth_scale": 0.0001}))
    assert read_depth_png(image)[0][0, 1] == pytest.approx(0.1)
    assert read_depth_png(image, DepthCoding(None, 0.01))[0][0, 1] == pytest.approx(10.0)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[1, 2]", "by name"),
        ("{", "cannot be read"),
        ("[" * 10**5, "cannot be read"),
        ('{"width": 3}', "it holds width"),
        ('{"K": [1, 2, 3]}', "3 x 3 camera matrix"),
        ('{"K": [0, 1, 1, 1]}', "positive focal lengths"),
        ('{"K": [1, 1, 1, 1], "depth_scale": -1}', "depth_scale must be positive"),
    ],
)
def test_a_file_of_intrinsics_that_makes_no_sense_is_named(image, content, message):
    image.with_name("scene.json").write_text(content)
    with pytest.raises(ValueError, match=message) as error:
        read_depth_png(image)
    assert "scene.json" in str(error.value)


def test_an_image_without_intrinsics_says_what_it_needs(image):
    with pytest.raises(ValueError, match=r"scene\.png' needs intrinsics.*intrinsics\.json"):
        read_depth_png(image)


def test_intrinsics_that_aliases_blow_up_are_named(image):
    rows = ["k0: &k0 [1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    rows += [f"k{n}: &k{n} [{', '.join([f'*k{n - 1}'] * 9)}]" for n in range(1, 9)]
    image.with_name("scene.yaml").write_text("\n".join([*rows, "K: *k8"]))
    with pytest.raises(ValueError, match=r"scene\.yaml' cannot be read: holds more than"):
        read_depth_png(image)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.zeros((3, 4), dtype=np.uint8), "1 of 8 bit"),
        (np.zeros((3, 4, 3), dtype=np.uint8), "3 of 8 bit"),
    ],
)
def test_an_image_of_another_kind_is_refused(tmp_path, values, message):
    write(tmp_path / "color.png", values)
    with pytest.raises(ValueError, match=rf"color\.png' must be a 16-bit.*{message}"):
        read_depth_png(tmp_path / "color.png", DepthCoding(np.array(K)))


def test_a_broken_image_is_named(tmp_path):
    (tmp_path / "broken.png").write_bytes(b"no image")
    with pytest.raises(ValueError, match=r"broken\.png' cannot be read"):
        read_depth_png(tmp_path / "broken.png", DepthCoding(np.array(K)))


@pytest.mark.parametrize("bad", [[1.0, 2.0], "four", [np.nan, 1.0, 1.0, 1.0], None])
def test_intrinsics_of_another_form_are_refused(bad):
    with pytest.raises(ValueError, match="here: intrinsics must be"):
        checked_intrinsics(bad, "here")
