"""Tests of RecordedPerception on recorded point clouds."""

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator

from drake_oa.perception.recorded_perception import RecordedPerception
from tests.builders import cubes_on_table, write_cloud

PERIOD = 0.1
"""Period of the updates [s]."""


@pytest.fixture
def folder(tmp_path):
    """Returns a recording: no cube at 0 s (.npz), one at 0.1 s (.pcd), two at 0.3 s (.ply)."""
    np.savez(tmp_path / "start.npz", points=cubes_on_table(), X_WC=np.eye(4), stamp=0.0)
    write_cloud(tmp_path / "cloud_000.100.pcd", cubes_on_table((0.1, 0.0)))
    write_cloud(tmp_path / "cloud_000.300.ply", cubes_on_table((0.12, 0.0), (-0.2, 0.1)))
    return tmp_path


def replay(folder, times, **options):
    """Returns the obstacles at some times of the replay [s]."""
    system = RecordedPerception(folder, period=PERIOD, X_WC=RigidTransform(), **options)
    simulator = Simulator(system)
    outputs = []
    for time in times:
        simulator.AdvanceTo(time)
        outputs.append(system.GetOutputPort("obstacles_W").Eval(simulator.get_context()))
    return outputs


def test_frames_are_processed_when_due_and_the_last_one_remains_current(folder):
    outputs = replay(folder, [0.05, 0.15, 0.25, 0.35, 0.95])
    assert [len(obstacles) for obstacles in outputs] == [0, 1, 1, 2, 2]
    np.testing.assert_allclose([s.stamp for s in outputs], [0.0, 0.1, 0.1, 0.3, 0.9])
    assert abs(outputs[-1].table.offset) < 1e-3


def test_an_unusable_frame_changes_only_the_note_which_names_the_file(folder):
    np.savez(folder / "bad.npz", points=np.full((9, 3), np.nan), stamp=0.2)
    before, during, after = replay(folder, [0.15, 0.25, 0.35])
    assert during.note == "bad.npz: hardly any depth is measured"
    assert during.stamp == before.stamp
    np.testing.assert_array_equal(during.clouds_W[0], before.clouds_W[0])
    assert (len(after), after.note) == (2, "")


def test_files_without_a_pose_are_listed(folder):
    system = RecordedPerception(folder, period=PERIOD)
    names = [path.name for path in system.files_without_pose]
    assert names == ["cloud_000.100.pcd", "cloud_000.300.ply"]
