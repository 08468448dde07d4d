import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from drake_oa.app.perceive_frame import as_json, box_corners, outline, perceive, run_lengths
from drake_oa.perception.depth_image import back_projected, row_hulls
from drake_oa.perception.recordings import RecordedFrame, read_frame
from tests.perception.test_real_scans import GROUPS
from tests.reference.depth_images import SIZE, K, camera_pose, ray_cast

TOOL = box_corners(np.array([0.2, 0.06, 0.12]))


def table_and_boxes(boxes, far_edge=9.0, pitch=0.8, height=0.8):
    """Depth of the plane z = 0 up to x = far_edge and of boxes (low, high), and X_WC."""
    X_WC = camera_pose(height, pitch)
    depth = ray_cast(X_WC, boxes, (far_edge - 99.0, 0.0, 99.0, 99.0))
    return np.where(np.isfinite(depth), depth, np.nan), X_WC


def frame_of(tmp_path, boxes, **options):
    depth, X_WC = table_and_boxes(boxes, **options)
    return RecordedFrame(tmp_path / "frame.npz", 0.0, depth, K), X_WC


BOXES = (
    (np.array([0.75, -0.2, 0.0]), np.array([0.85, -0.1, 0.15])),
    (np.array([0.85, 0.15, 0.0]), np.array([0.95, 0.27, 0.06])),
)


@given(st.lists(st.integers(0, 300), unique=True))
def test_run_lengths_hold_the_indices(indices):
    indices = np.array(sorted(indices), dtype=np.int64)
    runs = run_lengths(indices)
    assert_array_equal(np.concatenate([np.arange(a, a + n) for a, n in runs] or [indices]), indices)
    assert (runs[1:, 0] > runs[:-1].sum(axis=1)).all()


@settings(max_examples=30)
@given(st.integers(0, 9999))
def test_the_hulls_of_the_rows_have_the_support_of_all(seed):
    rng = np.random.default_rng(seed)
    z = rng.uniform(0.5, 1.5, (12, 17)).astype(np.float32)
    index = np.flatnonzero(rng.random(z.size) < 0.6)
    intrinsics = np.array([9.0, 8.0, 8.2, 5.9])
    kept = row_hulls(z, index)
    assert np.isin(kept, index).all()
    assert (np.diff(kept) > 0).all()
    directions = rng.normal(size=(200, 3))
    every, some = (directions @ back_projected(z, i, intrinsics).T for i in (index, kept))
    assert_allclose(some.max(axis=1), every.max(axis=1), atol=1e-12)


@pytest.mark.parametrize("known", [False, True])
def test_clusters_are_enclosed_with_the_tool_and_named_by_their_pixels(tmp_path, known):
    frame, X_WC = frame_of(tmp_path, BOXES)
    found = perceive(frame, TOOL, X_WC=X_WC if known else None, repeats=1)
    answer = as_json(found)
    assert len(answer["clusters"]) == 2
    assert answer["note"] == ""
    assert answer["valid"] == np.isfinite(frame.depth).sum()
    assert_allclose(answer["plane"]["normal"], X_WC[2, :3], atol=2e-3)
    assert answer["plane"]["offset"] == pytest.approx(-0.8, abs=2e-3)
    if known:
        assert_allclose(answer["X_WC"], X_WC)
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    rays = np.stack([(u - K[2]) / K[0], (v - K[3]) / K[1], np.ones(SIZE)], axis=-1)
    p_CQ = (rays * frame.depth[..., None].astype(float)).reshape(-1, 3)
    tool_C = TOOL @ np.array(answer["X_WC"])[:3, :3]
    for cluster in answer["clusters"]:
        pixels = np.concatenate([np.arange(a, a + n) for a, n in cluster["mask"]])
        assert len(pixels) == cluster["points"]
        assert (p_CQ[pixels] @ X_WC[2, :3] + 0.8 > 5e-3).all()
        e = cluster["ellipsoid"]
        R = np.array(e["R"])
        assert_allclose(R.T @ R, np.eye(3), atol=1e-9)
        assert np.linalg.det(R) > 0.0
        dilated = p_CQ[pixels][:, None] - tool_C
        gauge = np.linalg.norm((dilated - e["center"]) @ R / e["semi_axes"], axis=-1)
        assert gauge.max() <= 1.0 + 1e-9
        assert cluster["enclosed"]


def test_a_cloud_gives_clusters_by_the_places_of_its_points(tmp_path):
    frame, X_WC = frame_of(tmp_path, BOXES)
    z = frame.depth.astype(float)
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    points = np.stack([(u - K[2]) / K[0] * z, (v - K[3]) / K[1] * z, z], axis=-1).reshape(-1, 3)
    found = perceive(RecordedFrame(frame.path, 0.0, points=points), TOOL, X_WC=X_WC, repeats=1)
    assert len(found.clusters) == 2
    assert all(cluster.enclosed for cluster in found.clusters)
    assert as_json(found)["size"] is None
    assert_array_equal(found.clusters[0].p_CQ, points[found.clusters[0].pixels])


def test_what_is_far_and_cut_by_the_border_is_background(tmp_path):
    wide = (np.array([1.75, -0.05, 0.0]), np.array([1.85, 0.1, 2.0]))
    frame, X_WC = frame_of(tmp_path, (*BOXES, wide), far_edge=99.0, pitch=0.5)
    found = perceive(frame, TOOL, X_WC=X_WC, repeats=1)
    assert (len(found.clusters), found.background) == (2, 1)
    kept = perceive(frame, TOOL, X_WC=X_WC, background=True, repeats=1)
    assert (len(kept.clusters), kept.background) == (3, 0)


def test_what_juts_out_over_the_far_edge_is_no_background(tmp_path):
    tall = (np.array([1.65, -0.05, 0.0]), np.array([1.75, 0.1, 0.2]))
    frame, X_WC = frame_of(tmp_path, (*BOXES, tall), far_edge=1.8, pitch=0.5)
    assert len(perceive(frame, TOOL, X_WC=X_WC, repeats=1).clusters) == 3


@settings(max_examples=30)
@given(st.integers(0, 9999))
def test_the_outline_touches_the_shadow_of_the_ellipsoid(seed):
    rng = np.random.default_rng(seed)
    R, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    semi_axes = rng.uniform(0.05, 0.25, 3)
    center = np.array([*rng.uniform(-0.4, 0.4, 2), rng.uniform(0.5, 1.5)])
    edge = outline(center, R, semi_axes, K)
    direction = rng.normal(size=(4000, 3))
    surface = center + (direction / np.linalg.norm(direction, axis=1)[:, None] * semi_axes) @ R.T
    pixel = surface[:, :2] / surface[:, 2:] * K[:2] + K[2:]
    for side in ([1.0, 0.0], [0.0, 1.0], [0.6, -0.8]):
        size = np.ptp(edge @ side)
        assert (pixel @ side).max() <= (edge @ side).max() + 1e-3 * size
        assert (pixel @ side).max() >= (edge @ side).max() - 0.05 * size


def test_an_ellipsoid_round_the_camera_has_no_outline():
    assert outline(np.array([0.0, 0.0, 0.1]), np.eye(3), np.full(3, 0.2), K) is None
    assert outline(np.array([0.0, 0.0, -1.0]), np.eye(3), np.full(3, 0.2), K) is None


def test_in_real_scans_no_object_is_lost_and_no_table_taken(scan_files):
    for path in scan_files:
        found = perceive(read_frame(path), TOOL, repeats=1)
        assert len(found.clusters) == GROUPS[path.stem], path.stem
        assert all(cluster.enclosed for cluster in found.clusters)
        assert found.segmentation.plane_rms < 3e-3
        with np.load(path) as scan:
            if "label" not in scan:
                continue
            label, valid = scan["label"].ravel(), np.isfinite(scan["depth"]).ravel()
        taken = np.zeros(label.size, dtype=bool)
        for cluster in found.clusters:
            taken[cluster.pixels] = True
        assert not taken[(label >= 1) & (label < 20)].any()
        for name in np.unique(label[label >= 20] // 10):
            assert taken[(label // 10 == name) & valid].mean() > 0.9, (path.stem, name)
