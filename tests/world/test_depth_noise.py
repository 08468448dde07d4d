"""Depth noise against the published formulas, on walls of known depth."""

import numpy as np
import pytest

from drake_oa.world import depth_noise
from drake_oa.world.depth_noise import add_depth_noise

K = np.array([577.0, 579.0, 319.5, 239.5])
SHAPE = (240, 320)


@pytest.fixture
def quiet(monkeypatch):
    """Disables all noise except the displacement of edges, with fine steps of disparity."""
    for name in ("AXIAL_OFFSET", "AXIAL_GROWTH", "AXIAL_ANGLE", "EDGE_DROPOUT", "FLYING"):
        monkeypatch.setattr(depth_noise, f"_{name}", 0.0)
    monkeypatch.setattr(depth_noise, "_UNIT", 1e-5)
    monkeypatch.setattr(depth_noise, "_SUBPIXELS", 1000.0)


def wall(z: float, tilt: float = 0.0, shape: tuple[int, int] = SHAPE) -> np.ndarray:
    """Returns depths of a wall at depth z on the optical axis, tilted about the camera's y axis."""
    x = (np.arange(shape[1]) - K[2]) / K[0]
    return np.tile(z / (1.0 - np.tan(tilt) * x), (shape[0], 1)).astype(np.float32)


def step(front: float, back: float, column: int = 160) -> np.ndarray:
    """Returns depths of a near surface right of a column, in front of a far surface."""
    depth = wall(back)
    depth[:, column:] = front
    return depth


def measured(depth: np.ndarray, count: int = 6, K=K):
    """Returns noisy images (count, H, W) at different times."""
    return np.stack([add_depth_noise(depth, 0.1 * k, K=K, seed=1) for k in range(count)])


def strip(z: float, degrees: float, count: int = 8) -> tuple[np.ndarray, np.ndarray]:
    """Returns true depths of a narrow strip of a wall at the optical axis, and noisy images."""
    true = wall(z, np.deg2rad(degrees), (480, 640))[:, 300:340]
    return true, measured(true, count=count, K=K - [0.0, 0.0, 300.0, 0.0])


@pytest.mark.parametrize(("z", "degrees"), [(0.6, 66.0), (1.0, 50.0), (3.0, 0.0), (3.0, 60.0)])
def test_deviation_on_a_wall_is_the_published_one(z, degrees):
    theta = np.deg2rad(degrees)
    true, images = strip(z, degrees)
    flat = 0.0012 + 0.0019 * (z - 0.4) ** 2
    expected = flat + 0.0001 / np.sqrt(z) * (theta / (0.5 * np.pi - theta)) ** 2
    error = (images - true)[:, 180:300] / expected
    assert np.std(error) == pytest.approx(1.0, abs=0.1)
    # Where all pixels share one depth, rounding shifts them together.
    assert abs(np.mean(error)) < 0.25


def test_depths_come_in_steps_of_disparity(quiet, monkeypatch):
    monkeypatch.setattr(depth_noise, "_SUBPIXELS", 8.0)
    ramp = np.linspace(2.0, 2.2, SHAPE[1], dtype=np.float32)
    levels = np.unique(measured(np.tile(ramp, (SHAPE[0], 1)), count=1)[0, :, 2:-2])
    levels = levels[np.isfinite(levels)]
    z = 0.5 * (levels[1:] + levels[:-1])
    np.testing.assert_allclose(np.diff(levels), z**2 / (8.0 * K[0] * 0.075), atol=2.5e-5)


def test_noise_is_smooth_over_a_few_pixels_and_independent_between_frames():
    errors = measured(wall(1.0)) - 1.0
    errors /= errors.std()

    def correlation(frames: int, rows: int, columns: int) -> float:
        """Returns the correlation of errors at an offset in frames, rows and columns."""
        a = errors[frames:, rows:, columns:]
        b = errors[: len(errors) - frames, : SHAPE[0] - rows, : SHAPE[1] - columns]
        return float((a * b).mean())

    assert 0.6 < correlation(0, 0, 1) < 0.9
    assert 0.4 < correlation(0, 1, 0) < 0.8
    for apart in ((0, 0, 10), (0, 6, 0), (1, 0, 0)):
        assert abs(correlation(*apart)) < 0.05
    np.testing.assert_array_equal(measured(wall(1.0)), measured(wall(1.0)))


def test_holes_flying_pixels_and_unlit_are_at_edges_only():
    front, back, edge = 1.0, 1.4, 160
    frames = measured(step(front, back, edge))
    unlit = int(K[0] * 0.075 * (1.0 / front - 1.0 / back))
    near = np.zeros(SHAPE[1], dtype=bool)
    near[edge - unlit - 5 : edge + 5] = True
    assert not np.isnan(frames[:, :, ~near]).any()
    # Almost all pixels without light of the projector on the right are missing.
    assert np.isnan(frames[:, :, edge - unlit + 3 : edge - 3]).mean() > 0.99
    # Away from the edge each pixel has the depth of its surface.
    assert np.abs(frames[:, :, : edge - unlit - 5] - back).max() < 0.03
    assert np.abs(frames[:, :, edge + 5 :] - front).max() < 0.02
    # Near the edge some pixels have a depth between both surfaces.
    seen = frames[:, :, near]
    seen = seen[np.isfinite(seen)]
    assert np.mean((seen > front + 0.03) & (seen < back - 0.03)) > 0.003


def test_edges_move_by_the_lateral_deviation(quiet):
    # At the left side of the far surface, the projector lights all pixels.
    place = (measured(step(2.0, 1.0), count=20) < 1.5).sum(axis=2)
    assert place.std() == pytest.approx(0.8, abs=0.2)
    assert abs(place.mean() - 160.0) < 0.1


def test_out_of_range_and_grazing_pixels_are_missing():
    depth = wall(1.0)
    depth[:40], depth[40:80], depth[80:120], depth[120:160] = 6.0, np.inf, 0.0, np.nan
    (image,) = measured(depth, count=1)
    assert np.isnan(image[:157]).all()
    assert np.isfinite(image[165:]).all()
    assert np.isnan(strip(1.0, 82.0, 1)[1]).all()
    assert 0.2 < np.isnan(strip(1.0, 75.0, 1)[1]).mean() < 0.8
