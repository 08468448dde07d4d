"""Clouds in files: read whole, or refused."""

import struct
from pathlib import Path

import numpy as np
import pytest

from drake_oa.perception.cloud_files import read_cloud_file

POINTS = np.random.default_rng(0).uniform(0.1, 1.0, (100, 3))
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
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(POINTS))
    open3d.io.write_point_cloud(str(path), cloud, **FORMS[request.param])
    return path


def test_a_whole_file_is_read(cloud_file: Path) -> None:
    points, size = read_cloud_file(cloud_file)
    np.testing.assert_allclose(points, POINTS, atol=1e-5)
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
    points = POINTS[:3].astype(np.float32)
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
