"""`drake-oa perceive`: clusters and ellipsoids of frames, files and errors."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

from drake_oa.app.main import main
from drake_oa.app.perceive import perceive_frame
from drake_oa.perception.config import SegmentationConfig
from drake_oa.perception.recordings import RecordedFrame
from tests.reference.depth_images import SIZE, K, box, camera_pose, ray_cast, rays_of

TOOL = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.03, 0.03) for z in (-0.06, 0.06)])
X_WC = camera_pose(0.8, 0.8)
BOXES = (box(0.8, -0.15), box(0.9, 0.21, (0.1, 0.12, 0.06)))


@pytest.fixture(scope="module")
def depth() -> np.ndarray:
    """Depth image (H, W) of two boxes on the plane z = 0 [m]."""
    image = ray_cast(X_WC, BOXES, (-90.0, 0.0, 99.0, 99.0))
    return np.where(np.isfinite(image), image, np.nan).astype(np.float32)


@pytest.fixture
def points(depth: np.ndarray) -> np.ndarray:
    """Cloud (N, 3) of the depth image in the camera frame C [m]."""
    return (rays_of(np.eye(4), K, SIZE) * depth[..., None]).reshape(-1, 3)


@pytest.mark.parametrize("pose", [X_WC, None])
@pytest.mark.parametrize("kind", ["image", "cloud"])
def test_ellipsoids_contain_clusters_and_masks_list_pixels(depth, points, pose, kind, tmp_path):
    frame = RecordedFrame(tmp_path, 0.0, depth, K)
    if kind == "cloud":
        frame = RecordedFrame(tmp_path, 0.0, points=points)
    found = perceive_frame(frame, TOOL, SegmentationConfig(), X_WC=pose)
    assert found["valid"] == np.isfinite(depth).sum()
    assert_allclose(found["plane"]["normal"], X_WC[2, :3], atol=2e-3)
    assert found["plane"]["offset"] == pytest.approx(-0.8, abs=2e-3)
    if pose is not None:
        assert_allclose(found["X_WC"], X_WC)
    tool_C = TOOL @ np.array(found["X_WC"])[:3, :3]
    assert len(found["clusters"]) == 2
    for cluster in found["clusters"]:
        pixels = np.concatenate([np.arange(a, a + n) for a, n in cluster["mask"]])
        assert (points[pixels] @ X_WC[2, :3] + 0.8 > 5e-3).all()
        e = cluster["ellipsoid"]
        assert_allclose(np.transpose(e["R"]) @ e["R"], np.eye(3), atol=1e-9)
        dilated = points[pixels][:, None] - tool_C
        gauge = np.linalg.norm((dilated - e["center"]) @ e["R"] / e["semi_axes"], axis=-1)
        assert gauge.max() <= 1.0 + 1e-6
        assert cluster["enclosed"]


def test_results_of_a_folder(depth, tmp_path, capsys):
    import open3d

    folder, results = tmp_path / "in", tmp_path / "out" / "a.json"
    folder.mkdir()
    np.savez(folder / "scan.npz", depth=depth, K=K)
    values = np.nan_to_num(depth / 0.0002).astype(np.uint16)
    open3d.io.write_image(str(folder / "image.png"), open3d.geometry.Image(values))
    options = ["--intrinsics", *map(str, K), "--depth-scale", "0.0002", "--json", str(results)]
    pose = ["--pose", "1", "2", "0.8", str(-0.5 * np.pi - 0.8), "0", str(-np.pi / 2)]
    assert main(["perceive", str(folder), *options, *pose]) == 0
    image, npz = json.loads(results.read_text())["files"]
    for frame in (image, npz):
        assert len(frame["clusters"]) == 2
        assert frame["X_WC"][0][3] == 1.0
        assert frame["plane"]["offset"] == pytest.approx(-0.8, abs=3e-3)
    assert "scan.npz" in capsys.readouterr().out
    axes = npz["clusters"][0]["ellipsoid"]["semi_axes"]
    assert main(["perceive", str(folder / "scan.npz"), "--tool", "none", *options[-2:]]) == 0
    (frame,) = json.loads(results.read_text())["files"]
    assert frame["clusters"][0]["ellipsoid"]["semi_axes"][0] < axes[0]


def test_clouds_of_the_world_frame_without_a_pose_are_named(points, tmp_path, capsys):
    file = str(tmp_path / "world.npz")
    np.savez(file, points=points[np.isfinite(points).all(axis=1)] @ X_WC[:3, :3].T + X_WC[:3, 3])
    assert main(["perceive", file]) == 0
    assert "world.npz: read in the frame of a camera" in capsys.readouterr().out
    assert main(["perceive", file, "--pose", *"000000"]) == 0
    assert "read in" not in capsys.readouterr().out


def test_invalid_file_is_reported_and_others_are_processed(depth, tmp_path, capsys):
    np.savez(tmp_path / "scan.npz", depth=depth, K=K)
    np.savez(tmp_path / "empty.npz", depth=np.full(SIZE, np.nan), K=K)
    (tmp_path / "broken.npz").write_bytes(b"no such data")
    results = tmp_path / "a.json"
    files = [str(tmp_path / f"{name}.npz") for name in ("broken", "none", "empty", "scan")]
    assert main(["perceive", *files, "--json", str(results), "--tool", "none"]) == 2
    errors = capsys.readouterr().err
    assert all(text in errors for text in ("broken.npz", "none.npz", "hardly any depth"))
    *unusable, empty, scan = json.loads(results.read_text())["files"]
    assert all("error" in frame for frame in unusable)
    assert (empty["plane"], empty["clusters"], empty["note"]) == (
        None,
        [],
        "hardly any depth is measured",
    )
    assert len(scan["clusters"]) == 2
