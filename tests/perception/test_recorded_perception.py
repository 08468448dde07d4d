import numpy as np
import open3d
import pytest
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator

from drake_oa.perception.recorded_perception import RecordedPerception

PERIOD = 0.1


def scene(*centers: tuple[float, float], size: float = 0.1) -> np.ndarray:
    """Points in the world: a table, and on it the top and two sides of cubes."""
    grid = np.arange(-0.4, 0.4, 0.008)
    x, y = (axis.ravel() for axis in np.meshgrid(grid, grid))
    free = np.ones(len(x), dtype=bool)
    parts = []
    side = np.arange(0.0, size, 0.004)
    a, b = (axis.ravel() for axis in np.meshgrid(side, side))
    for cx, cy in centers:
        low = np.array([cx, cy, 0.0]) - [size / 2, size / 2, 0.0]
        free &= (np.abs(x - cx) > size / 2) | (np.abs(y - cy) > size / 2)
        end = np.full(len(a), size)
        parts += [low + np.stack(face, axis=1) for face in ((a, b, end), (end, a, b), (a, end, b))]
    table = np.stack([x[free], y[free], np.zeros(free.sum())], axis=1)
    return np.concatenate([table, *parts])


def write_cloud(path, points: np.ndarray) -> None:
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    open3d.io.write_point_cloud(str(path), cloud)


@pytest.fixture
def folder(tmp_path):
    """No cube at 0 s (.npz), one at 0.1 s (.pcd), two at 0.3 s (.ply)."""
    np.savez(tmp_path / "start.npz", points=scene(), X_WC=np.eye(4), stamp=0.0)
    write_cloud(tmp_path / "cloud_000.100.pcd", scene((0.1, 0.0)))
    write_cloud(tmp_path / "cloud_000.300.ply", scene((0.12, 0.0), (-0.2, 0.1)))
    return tmp_path


def play(folder, times, **options):
    system = RecordedPerception(folder, period=PERIOD, X_WC=RigidTransform(), **options)
    simulator = Simulator(system)
    seen = []
    for time in times:
        simulator.AdvanceTo(time)
        seen.append(system.GetOutputPort("obstacles_W").Eval(simulator.get_context()))
    return seen


def test_frames_come_when_they_are_due_and_the_last_one_stays_current(folder):
    seen = play(folder, [0.05, 0.15, 0.25, 0.35, 0.95])
    assert [len(obstacles) for obstacles in seen] == [0, 1, 1, 2, 2]
    np.testing.assert_allclose([s.stamp for s in seen], [0.0, 0.1, 0.1, 0.3, 0.9])
    assert abs(seen[-1].table.offset) < 1e-3


def test_a_degraded_frame_keeps_the_last_obstacles_and_names_the_file(folder):
    np.savez(folder / "bad.npz", points=np.full((9, 3), np.nan), stamp=0.2)
    before, during, after = play(folder, [0.15, 0.25, 0.35])
    assert during.note == "bad.npz: hardly any depth is measured"
    assert during.stamp == before.stamp
    np.testing.assert_array_equal(during.clouds_W[0], before.clouds_W[0])
    assert (len(after), after.note) == (2, "")


def test_files_without_a_pose_are_known(folder):
    system = RecordedPerception(folder, period=PERIOD)
    names = [path.name for path in system.files_without_pose]
    assert names == ["cloud_000.100.pcd", "cloud_000.300.ply"]
