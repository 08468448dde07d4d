"""Tests of recorded files: each is read completely, or rejected with a message that names it."""

import json
import re
from pathlib import Path

import numpy as np
import open3d
import pytest

from drake_oa.perception.recordings import read_frame, read_recording
from tests.builders import write_cloud

K = np.array([100.0, 101.0, 4.5, 3.5])
MATRIX = [100.0, 0.0, 4.5, 0.0, 101.0, 3.5, 0.0, 0.0, 1.0]
POINTS = np.random.default_rng(0).uniform(0.1, 1.0, (100, 3))
DEPTH = np.random.default_rng(1).uniform(0.5, 1.5, (8, 10)).astype(np.float32)

CLOUDS = {
    "ascii.ply": {"write_ascii": True},
    "binary.ply": {},
    "ascii.pcd": {"write_ascii": True},
    "binary.pcd": {},
    "compressed.pcd": {"compressed": True},
}
"""Options of Open3D for writing a cloud, by file name."""


def write_image(path: Path, values: np.ndarray) -> None:
    """Writes integers (H, W) to a .png file."""
    open3d.io.write_image(str(path), open3d.geometry.Image(values))


@pytest.fixture
def image(tmp_path: Path) -> Path:
    """Returns the path of a 16-bit depth image without an intrinsics file."""
    path = tmp_path / "scene.png"
    write_image(path, np.array([[0, 1000], [2000, 3]], dtype=np.uint16))
    return path


def test_all_formats_of_a_folder_are_read_in_order_of_stamp(tmp_path):
    write_cloud(tmp_path / "cloud_000.066.pcd", POINTS)
    write_cloud(tmp_path / "cloud_000.033.ply", POINTS)
    np.savez(tmp_path / "depth.npz", depth=DEPTH, K=K, X_WC=np.eye(4), stamp=0.1)
    np.savez(tmp_path / "points_0.05.npz", points=POINTS, robot_state=np.arange(3))
    write_image(tmp_path / "image_0.2.png", np.full((4, 5), 1000, dtype=np.uint16))
    (tmp_path / "intrinsics.json").write_text(json.dumps({"K": K.tolist()}))
    (tmp_path / ".hidden").write_text("")
    (tmp_path / "folder").mkdir()
    frames = read_recording(tmp_path)
    assert [frame.stamp for frame in frames] == [0.033, 0.05, 0.066, 0.1, 0.2]
    for frame in frames[:3]:
        np.testing.assert_allclose(frame.points, POINTS, atol=1e-6)
        assert frame.X_WC is None
    np.testing.assert_array_equal(frames[1].robot_state, [0.0, 1.0, 2.0])
    np.testing.assert_array_equal(frames[3].depth, DEPTH)
    np.testing.assert_array_equal(frames[3].X_WC, np.eye(4))
    np.testing.assert_allclose(frames[4].depth, 1.0)
    for frame in frames[3:]:
        np.testing.assert_array_equal(frame.K, K)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("scene.json", dict(zip(("fx", "fy", "cx", "cy"), K.tolist(), strict=True))),
        ("intrinsics.yml", {"intrinsic_matrix": np.reshape(MATRIX, (3, 3)).tolist()}),
        ("camera_info.yaml", {"camera_matrix": {"rows": 3, "cols": 3, "data": MATRIX}}),
        ("scene.yaml", {"k": MATRIX}),
        # Open3D writes the matrix by columns.
        ("intrinsics.json", {"intrinsic_matrix": np.reshape(MATRIX, (3, 3)).T.ravel().tolist()}),
    ],
)
def test_intrinsics_and_scale_are_read_from_the_same_folder(image, name, content):
    image.with_name(name).write_text(json.dumps(content | {"depth_scale": 0.0005}))
    frame = read_frame(image)
    np.testing.assert_array_equal(frame.K, K)
    np.testing.assert_allclose(frame.depth, [[np.nan, 0.5], [1.0, 0.0015]], rtol=1e-6)
    assert read_frame(image, depth_scale=0.01).depth[0, 1] == pytest.approx(10.0)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[1, 2]", "cannot be read"),
        ("[" * 10**5, "cannot be read"),
        ('{"width": 3}', "intrinsics must be"),
        ('{"K": [0, 1, 1, 1]}', "positive focal lengths"),
        ('{"K": [1, 1, 1, 1], "depth_scale": "big"}', "cannot be read"),
    ],
)
def test_the_message_names_a_wrong_intrinsics_file(image, content, message):
    image.with_name("scene.json").write_text(content)
    with pytest.raises(ValueError, match=rf"scene\.json.*{message}"):
        read_frame(image)


def test_an_image_without_intrinsics_or_scale_is_rejected(image):
    with pytest.raises(ValueError, match=r"scene\.png' requires intrinsics.*intrinsics\.json"):
        read_frame(image)
    with pytest.raises(ValueError, match=r"scene\.png': depth scale must be positive"):
        read_frame(image, K=K, depth_scale=-1.0)


@pytest.mark.parametrize("name", CLOUDS)
def test_a_truncated_cloud_or_a_wrong_header_is_rejected(name, tmp_path, capfd):
    path = tmp_path / name
    write_cloud(path, POINTS, **CLOUDS[name])
    np.testing.assert_allclose(read_frame(path).points, POINTS, atol=1e-5)
    data = path.read_bytes()
    changed = [data[: int(share * len(data))] for share in (0.1, 0.35, 0.6, 0.97)]
    for count in (b"4000000000", b"99999999999999999999", b"many"):
        changed.append(re.sub(rb"(element vertex|POINTS|WIDTH) 100", rb"\1 " + count, data))
    for content in changed:
        path.write_bytes(content)
        with pytest.raises(ValueError, match=rf"{name}' is truncated or contains no cloud"):
            read_frame(path)
    assert capfd.readouterr().out == ""


@pytest.mark.parametrize("suffix", ["npz", "pcd", "ply", "png", "txt"])
@pytest.mark.parametrize("content", [b"", b"no such data", b"\x93NUMPY"])
def test_the_message_names_an_unreadable_file(tmp_path, suffix, content):
    (tmp_path / f"broken.{suffix}").write_bytes(content)
    with pytest.raises(ValueError, match=f"broken.{suffix}"):
        read_recording(tmp_path)


def test_the_message_names_a_missing_or_empty_folder(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no folder .*nowhere"):
        read_recording(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match="is empty"):
        read_recording(tmp_path)


def test_the_message_names_two_files_with_the_same_stamp(tmp_path):
    write_cloud(tmp_path / "a_1.50.ply", POINTS)
    write_cloud(tmp_path / "b_1.5.ply", POINTS)
    with pytest.raises(ValueError, match=r"a_1\.50\.ply.*b_1\.5\.ply.*same stamp 1\.5 s"):
        read_recording(tmp_path)


def test_the_message_names_a_damaged_image_or_archive(image):
    write_image(image, np.zeros((3, 4), dtype=np.uint8))
    with pytest.raises(ValueError, match=r"scene\.png' must be a complete 16-bit"):
        read_frame(image, K=K)
    write_image(image, (1000 * DEPTH).astype(np.uint16))
    archive = image.with_name("frame.npz")
    np.savez_compressed(archive, points=POINTS)
    for path in (image, archive):
        data = path.read_bytes()
        path.write_bytes(data[: len(data) // 2])
        with pytest.raises(ValueError, match=path.name):
            read_frame(path, K=K)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"other": POINTS}, "either 'depth' and 'K' or 'points'"),
        ({"depth": DEPTH, "points": POINTS, "K": K}, "either 'depth' and 'K' or 'points'"),
        ({"depth": DEPTH}, "either 'depth' and 'K' or 'points'"),
        ({"depth": DEPTH, "K": -K}, "positive focal lengths"),
        ({"depth": DEPTH.astype(np.uint16), "K": K}, "'depth' in"),
        ({"points": POINTS.T}, "'points' in"),
        ({"points": POINTS, "X_WC": np.diag([1.0, 1.0, -1.0, 1.0])}, "'X_WC' in .* rotation"),
        ({"points": POINTS, "stamp": np.nan}, "'stamp' in"),
        ({"points": np.array([{}], dtype=object)}, "cannot be read as .npz"),
    ],
)
def test_the_message_names_malformed_arrays(tmp_path, arrays, message):
    np.savez(tmp_path / "frame.npz", **arrays)
    with pytest.raises(ValueError, match=message) as error:
        read_recording(tmp_path)
    assert "frame.npz" in str(error.value)
