"""Tests of segmentation on recorded scans; with `-s` they print the table of real_scans.md.

python -m pytest tests/perception/test_real_scans.py -s
"""

import shutil
import time
from pathlib import Path

import numpy as np
from pydrake.systems.analysis import Simulator

from drake_oa.common.messages import ObstacleClouds
from drake_oa.perception.config import SegmentationConfig
from drake_oa.perception.recorded_perception import RecordedPerception
from drake_oa.perception.segmentation import Segmentation, segment_depth

GROUPS = {
    "mosd_learn34": 3,
    "mosd_test0": 2,
    "mosd_test35": 2,
    "pcl_milk_cartoon_all_small_clorox": 3,
}
"""Number of groups of objects on the plane, by scan; objects in contact are one group."""
CONFIG = SegmentationConfig(far=1.5)
"""Parameters of the segmentation; all objects, but not the background, are within this depth."""
REPEATS = 25
"""Number of segmentations in a measurement of the duration."""


def perceive(scan: Path, folder: Path) -> ObstacleClouds:
    """Returns the obstacles that RecordedPerception outputs for a folder with one scan."""
    folder.mkdir()
    shutil.copy(scan, folder)
    system = RecordedPerception(folder, config=CONFIG)
    simulator = Simulator(system)
    simulator.Initialize()
    return system.GetOutputPort("obstacles_W").Eval(simulator.get_context())


def coverage(segmentation: Segmentation, label: np.ndarray, valid: np.ndarray) -> list[float]:
    """Computes for each object the largest share of its valid pixels in one cluster."""
    cluster = np.zeros(label.size, dtype=int)
    for number, pixels in enumerate(segmentation.pixels, start=1):
        cluster[pixels] = number
    shares = []
    for name in np.unique(label[label >= 20] // 10):
        pixels = (label // 10 == name) & valid
        counts = np.bincount(cluster[pixels], minlength=2)
        shares.append(float(counts[1:].max() / counts.sum()))
    return shares


def measure_ms(depth: np.ndarray, K: np.ndarray) -> float:
    """Measures the median process time of a segmentation [ms]."""
    times = []
    for _ in range(REPEATS):
        start = time.process_time()
        segment_depth(depth, K, None, CONFIG)
        times.append(time.process_time() - start)
    return 1e3 * float(np.median(times))


def test_table_of_the_real_scans(scan_files, tmp_path):
    print("\n\n| scan | clusters found / expected | plane rms [mm] | labels covered [%] | ms |")
    print("|---|---|---|---|---|")
    for path in scan_files:
        obstacles = perceive(path, tmp_path / path.stem)
        with np.load(path) as scan:
            depth, K = scan["depth"], scan["K"]
            label = scan["label"].ravel() if "label" in scan else None
        result = segment_depth(depth, K, None, CONFIG)
        shares = [] if label is None else coverage(result, label, np.isfinite(depth).ravel())
        covered = ", ".join(f"{100.0 * share:.1f}" for share in shares) or "no labels"
        print(
            f"| {path.stem} | {len(obstacles)} / {GROUPS[path.stem]} | "
            f"{1e3 * result.plane_rms:.2f} | {covered} | {measure_ms(depth, K):.1f} |"
        )
        assert len(obstacles) == len(result.clouds_W) == GROUPS[path.stem]
        assert result.plane_rms < 3e-3
        np.testing.assert_allclose(obstacles.table.normal_W, [0.0, 0.0, 1.0], atol=1e-9)
        # Pixels outside the clusters are within a centimeter of the table.
        assert all(share > 0.88 for share in shares)
        if label is not None:
            of_table = (label >= 1) & (label < 10)
            pixels = np.concatenate(result.pixels)
            assert of_table[pixels].sum() <= 1e-3 * len(pixels)
