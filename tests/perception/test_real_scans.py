"""The table of docs/results/real_scans.md, printed by

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

# Scan -> groups of objects that stand on the plane; objects that touch are one.
GROUPS = {
    "mosd_learn34": 3,
    "mosd_test0": 2,
    "mosd_test35": 2,
    "pcl_milk_cartoon_all_small_clorox": 3,
}
# The last scene goes on behind the objects; all of them lie within this depth.
CONFIG = SegmentationConfig(far=1.5)
REPEATS = 25


def play(scan: Path, folder: Path) -> ObstacleClouds:
    """What RecordedPerception sees in a folder with that scan alone."""
    folder.mkdir()
    shutil.copy(scan, folder)
    system = RecordedPerception(folder, config=CONFIG)
    simulator = Simulator(system)
    simulator.Initialize()
    return system.GetOutputPort("obstacles_W").Eval(simulator.get_context())


def coverage(found: Segmentation, label: np.ndarray, valid: np.ndarray) -> list[float]:
    """Share of each object's valid pixels in the one cluster that has most of them."""
    cluster = np.zeros(label.size, dtype=int)
    for number, pixels in enumerate(found.pixels, start=1):
        cluster[pixels] = number
    shares = []
    for name in np.unique(label[label >= 20] // 10):
        pixels = (label // 10 == name) & valid
        counts = np.bincount(cluster[pixels], minlength=2)
        shares.append(float(counts[1:].max() / counts.sum()))
    return shares


def measured_ms(depth: np.ndarray, K: np.ndarray) -> float:
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
        obstacles = play(path, tmp_path / path.stem)
        with np.load(path) as scan:
            depth, K = scan["depth"], scan["K"]
            label = scan["label"].ravel() if "label" in scan else None
        found = segment_depth(depth, K, None, CONFIG)
        shares = [] if label is None else coverage(found, label, np.isfinite(depth).ravel())
        covered = ", ".join(f"{100.0 * share:.1f}" for share in shares) or "no labels"
        print(
            f"| {path.stem} | {len(obstacles)} / {GROUPS[path.stem]} | "
            f"{1e3 * found.plane_rms:.2f} | {covered} | {measured_ms(depth, K):.1f} |"
        )
        assert len(obstacles) == len(found.clouds_W) == GROUPS[path.stem]
        assert found.plane_rms < 3e-3
        np.testing.assert_allclose(obstacles.table.normal_W, [0.0, 0.0, 1.0], atol=1e-9)
        # What is not covered lies within a centimeter of the table.
        assert all(share > 0.88 for share in shares)
        if label is not None:
            of_table = (label >= 1) & (label < 10)
            taken = np.concatenate(found.pixels)
            assert of_table[taken].sum() <= 1e-3 * len(taken)
