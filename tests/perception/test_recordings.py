"""Clouds in files: read whole, or refused."""

import json
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest

from drake_oa.perception.recordings import (
    DepthCoding,
    checked_intrinsics,
    read_cloud_file,
    read_depth_png,
    read_recording,
)

IMAGE_K = [130.0, 131.0, 79.5, 59.5]
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
    depth, found = read_depth_png(image, DepthCoding(np.array(IMAGE_K), 0.0005))
    np.testing.assert_allclose(depth, [[np.nan, 0.5], [1.0, 0.0015]], rtol=1e-6)
    np.testing.assert_array_equal(found, IMAGE_K)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("scene.json", json.dumps(dict(zip(("fx", "fy", "cx", "cy"), IMAGE_K, strict=True)))),
        ("intrinsics.json", json.dumps({"K": IMAGE_K})),
        ("intrinsics.json", json.dumps({"intrinsic_matrix": np.reshape(MATRIX, (3, 3)).tolist()})),
        ("camera_info.yaml", f"camera_matrix: {{rows: 3, cols: 3, data: {MATRIX}}}"),
        ("scene.yaml", f"k: {MATRIX}"),
    ],
)
def test_intrinsics_beside_the_image_are_found(image, name, content):
    image.with_name(name).write_text(content)
    depth, found = read_depth_png(image)
    np.testing.assert_array_equal(found, IMAGE_K)
    assert depth[0, 1] == pytest.approx(1.0)


def test_the_file_beside_may_name_the_scale(image):
    image.with_name("scene.json").write_text(json.dumps({"K": IMAGE_K, "depth_scale": 0.0001}))
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
        read_depth_png(tmp_path / "color.png", DepthCoding(np.array(IMAGE_K)))


def test_a_broken_image_is_named(tmp_path):
    (tmp_path / "broken.png").write_bytes(b"no image")
    with pytest.raises(ValueError, match=r"broken\.png' cannot be read"):
        read_depth_png(tmp_path / "broken.png", DepthCoding(np.array(IMAGE_K)))


@pytest.mark.parametrize("bad", [[1.0, 2.0], "four", [np.nan, 1.0, 1.0, 1.0], None])
def test_intrinsics_of_another_form_are_refused(bad):
    with pytest.raises(ValueError, match="here: intrinsics must be"):
        checked_intrinsics(bad, "here")


K = np.array([100.0, 100.0, 4.5, 3.5])
POINTS = np.arange(12.0).reshape(4, 3)
HEADER = """ply
format ascii 1.0
element vertex {count}
property float x
property float y
property float z
end_header
"""


def write_ply(path, points=POINTS):
    rows = "".join(f"{x} {y} {z}\n" for x, y, z in points)
    path.write_text(HEADER.format(count=len(points)) + rows)


def test_every_kind_of_file_is_read_in_order_of_stamp(tmp_path):
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(POINTS))
    open3d.io.write_point_cloud(str(tmp_path / "cloud_000.066.pcd"), cloud)
    write_ply(tmp_path / "cloud_000.033.ply")
    depth = np.ones((8, 10), dtype=np.float32)
    np.savez(tmp_path / "depth.npz", depth=depth, K=K, X_WC=np.eye(4), stamp=0.1)
    np.savez(tmp_path / "points_0.05.npz", points=POINTS)
    (tmp_path / ".hidden").write_text("")
    (tmp_path / "folder").mkdir()
    frames = read_recording(tmp_path)
    assert [frame.stamp for frame in frames] == [0.033, 0.05, 0.066, 0.1]
    for frame in frames[:3]:
        np.testing.assert_allclose(frame.points, POINTS)
        assert frame.X_WC is None
    assert frames[3].depth.dtype == np.float32
    np.testing.assert_array_equal(frames[3].K, K)
    np.testing.assert_array_equal(frames[3].X_WC, np.eye(4))


def test_without_stamps_the_order_of_names_and_the_period_count(tmp_path):
    for name in ("b_2", "a_10", "c"):
        write_ply(tmp_path / f"{name}.ply")
    frames = read_recording(tmp_path, period=0.5)
    assert [(frame.path.stem, frame.stamp) for frame in frames] == [
        ("a_10", 0.0),
        ("b_2", 0.5),
        ("c", 1.0),
    ]


def test_a_folder_that_is_missing_or_empty_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no folder .*nowhere"):
        read_recording(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match="holds no file"):
        read_recording(tmp_path)


def test_an_unknown_suffix_is_named(tmp_path):
    (tmp_path / "notes.txt").write_text("")
    with pytest.raises(ValueError, match=r"notes.txt.*unknown suffix '.txt'.*\.npz"):
        read_recording(tmp_path)


@pytest.mark.parametrize("suffix", ["npz", "pcd", "ply"])
@pytest.mark.parametrize("content", [b"", b"no such data", b"\x93NUMPY"])
def test_an_unreadable_file_is_named(tmp_path, suffix, content):
    (tmp_path / f"broken.{suffix}").write_bytes(content)
    with pytest.raises(ValueError, match=f"broken.{suffix}"):
        read_recording(tmp_path)


def test_more_than_memory_is_refused_before_it_is_read(tmp_path):
    with zipfile.ZipFile(tmp_path / "huge.npz", "w") as archive:
        header = {"descr": "<f8", "fortran_order": False, "shape": (10**13, 3)}
        with archive.open("points.npy", "w") as file:
            np.lib.format.write_array_header_1_0(file, header)
    with pytest.raises(ValueError, match=r"huge\.npz.* GB of memory; .* are available"):
        read_recording(tmp_path)


def test_a_truncated_archive_is_named(tmp_path):
    path = tmp_path / "short.npz"
    np.savez(path, points=POINTS)
    path.write_bytes(path.read_bytes()[:150])
    with pytest.raises(ValueError, match=r"short\.npz"):
        read_recording(tmp_path)


@pytest.mark.parametrize("damaged", [slice(60, 120), slice(200, 260), slice(-120, -90)])
def test_a_damaged_archive_is_named(tmp_path, damaged):
    path = tmp_path / "damaged.npz"
    np.savez_compressed(path, points=np.random.default_rng(0).random((200, 3)))
    data = bytearray(path.read_bytes())
    data[damaged] = bytes(255 for _ in data[damaged])
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"damaged\.npz"):
        read_recording(tmp_path)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"other": POINTS}, "either 'depth'"),
        ({"depth": np.ones((2, 2)), "points": POINTS, "K": K}, "either 'depth'"),
        ({"depth": np.ones((2, 2))}, "needs 'K'"),
        ({"depth": np.ones((2, 2)), "K": -K}, "needs 'K'"),
        ({"depth": np.ones((2, 2)), "K": K[:3]}, "'K' in"),
        ({"depth": np.ones(4), "K": K}, "'depth' in"),
        ({"depth": np.ones((2, 2), dtype=np.uint16), "K": K}, "'depth' in"),
        ({"depth": np.ones((0, 2)), "K": K}, "'depth' in"),
        ({"points": POINTS.T}, "'points' in"),
        ({"points": POINTS, "X_WC": np.zeros((4, 4))}, "'X_WC' in .* rotation"),
        ({"points": POINTS, "X_WC": np.diag([1.0, 1.0, -1.0, 1.0])}, "'X_WC' in .* rotation"),
        ({"points": POINTS, "X_WC": np.eye(3)}, "'X_WC' in"),
        ({"points": POINTS, "stamp": np.nan}, "'stamp' in"),
        ({"points": POINTS, "stamp": "now"}, "'stamp' in"),
    ],
)
def test_malformed_arrays_are_named(tmp_path, arrays, message):
    np.savez(tmp_path / "frame.npz", **arrays)
    with pytest.raises(ValueError, match=message) as error:
        read_recording(tmp_path)
    assert "frame.npz" in str(error.value)


def test_a_single_array_is_no_archive(tmp_path):
    with (tmp_path / "array.npz").open("wb") as file:
        np.save(file, POINTS)
    with pytest.raises(ValueError, match=r"array\.npz.* no archive"):
        read_recording(tmp_path)


def test_pickled_objects_are_not_loaded(tmp_path):
    np.savez(tmp_path / "objects.npz", points=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match=r"objects\.npz"):
        read_recording(tmp_path)


def test_two_files_of_one_stamp_are_named(tmp_path):
    write_ply(tmp_path / "a_1.50.ply")
    write_ply(tmp_path / "b_1.5.ply")
    with pytest.raises(ValueError, match=r"a_1\.50\.ply.*b_1\.5\.ply.*same stamp 1\.5 s"):
        read_recording(tmp_path)


def write_pcd(path, points, width, height):
    rows = "\n".join(" ".join(map(str, p)) for p in points.reshape(-1, 3))
    path.write_text(
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {width}\nHEIGHT {height}\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {width * height}\nDATA ascii\n{rows}\n"
    )


def test_an_organised_cloud_of_a_camera_is_its_depth_image(tmp_path):
    z = np.random.default_rng(0).uniform(0.5, 1.5, (8, 10))
    z[2, 3] = np.nan
    v, u = np.mgrid[:8, :10]
    points = np.stack([(u - K[2]) / K[0] * z, (v - K[3]) / K[1] * z, z], axis=-1)
    write_pcd(tmp_path / "a.pcd", points, 10, 8)
    write_pcd(tmp_path / "b.pcd", points @ np.diag([1.0, 1.0, -1.0]), 10, 8)
    image, cloud = read_recording(tmp_path)
    np.testing.assert_allclose(image.depth, z, rtol=1e-5)
    np.testing.assert_allclose(image.K, K, rtol=1e-4)
    # Behind the camera: in some other frame, so it stays a cloud.
    assert cloud.depth is None
    assert cloud.points.shape == (80, 3)
    assert np.isfinite(cloud.points).all(axis=1).sum() == 79


def test_intrinsics_files_in_a_folder_are_no_frames(tmp_path):
    import open3d

    values = np.full((4, 5), 1000, dtype=np.uint16)
    open3d.io.write_image(str(tmp_path / "a_0.5.png"), open3d.geometry.Image(values))
    (tmp_path / "intrinsics.json").write_text('{"fx": 9, "fy": 9, "cx": 2, "cy": 2}')
    (frame,) = read_recording(tmp_path)
    assert (frame.stamp, frame.depth[0, 0]) == (0.5, pytest.approx(1.0))


MANY = np.random.default_rng(0).uniform(0.1, 1.0, (100, 3))
FORMS = {
    "ascii.ply": {"write_ascii": True},
    "binary.ply": {},
    "ascii.pcd": {"write_ascii": True},
    "binary.pcd": {},
    "compressed.pcd": {"compressed": True},
}


@pytest.fixture(params=FORMS)
def cloud_file(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    import open3d

    path = tmp_path / request.param
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(MANY))
    open3d.io.write_point_cloud(str(path), cloud, **FORMS[request.param])
    return path


def test_a_whole_file_is_read(cloud_file: Path) -> None:
    points, size = read_cloud_file(cloud_file)
    np.testing.assert_allclose(points, MANY, atol=1e-5)
    assert size == ((100, 1) if cloud_file.suffix == ".pcd" else (0, 0))


@pytest.mark.parametrize("share", [0.35, 0.6, 0.97])
def test_a_file_that_is_cut_short_is_refused(
    cloud_file: Path, share: float, capfd: pytest.CaptureFixture[str]
) -> None:
    data = cloud_file.read_bytes()
    cloud_file.write_bytes(data[: int(share * len(data))])
    with pytest.raises(ValueError, match=rf"{cloud_file.name}' is cut short: .* promises 100 poi"):
        read_cloud_file(cloud_file)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("count", ["4000000000", "99999999999999999999", "many"])
def test_a_count_that_cannot_be_is_refused(cloud_file: Path, count: str) -> None:
    data = cloud_file.read_bytes()
    for before in (b"element vertex ", b"POINTS ", b"WIDTH "):
        data = data.replace(before + b"100", before + count.encode())
    cloud_file.write_bytes(data)
    with pytest.raises(ValueError, match=cloud_file.name):
        read_cloud_file(cloud_file)


def ply(kind: str, elements: str, body: bytes) -> bytes:
    return f"ply\nformat {kind} 1.0\ncomment x\n{elements}end_header\n".encode() + body


FACE_FIRST = (
    "element face 2\nproperty uchar mark\nproperty list uchar int vertex_indices\n"
    "element vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
)


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_lists_before_the_vertices_are_passed_over(kind: str, tmp_path: Path) -> None:
    points = MANY[:3].astype(np.float32)
    if kind == "ascii":
        body = b"7 3 0 1 2\n7 2 0 1\n" + b"".join(b"%f %f %f\n" % tuple(p) for p in points)
    else:
        order = ">" if kind == "binary_big_endian" else "<"
        body = struct.pack(f"{order}BB3iBB2i", 7, 3, 0, 1, 2, 7, 2, 0, 1)
        body += points.astype(f"{order}f4").tobytes()
    path = tmp_path / "mesh.ply"
    path.write_bytes(ply(kind, FACE_FIRST, body))
    np.testing.assert_allclose(read_cloud_file(path)[0], points, atol=1e-6)
    path.write_bytes(ply(kind, FACE_FIRST, body[:-9]))
    with pytest.raises(ValueError, match="promises 3 points, it holds 2"):
        read_cloud_file(path)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("word.ply", ply("ascii", "element vertex 1\nproperty float x\n", b"abc\n")),
        ("type.ply", ply("ascii", "element vertex 1\nproperty text x\n", b"1\n")),
        ("list.ply", ply("ascii", "element vertex 1\nproperty list int\n", b"1\n")),
        ("faces.ply", ply("ascii", "element face 1\nproperty int x\n", b"1\n")),
        ("endless.ply", b"ply\nformat ascii 1.0\n" + b"comment\n" * 2000),
        ("columns.pcd", b"SIZE 4 4\nCOUNT 1\nPOINTS 1\nDATA ascii\n1 1\n"),
        ("flat.pcd", b"FIELDS x y\nSIZE 4 4\nTYPE F F\nPOINTS 2\nDATA ascii\n1 1\n1 2\n"),
    ],
)
def test_what_is_no_cloud_is_named(name: str, content: bytes, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=name):
        read_cloud_file(tmp_path / name)
