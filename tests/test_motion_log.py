"""The log of a motion, and its file."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from drake_oa.motion_log import MotionLog, load_logs, pack_ellipsoids, save_logs
from drake_oa.values import EllipsoidSet


def ellipsoids(count: int, stamp: float = 0.0) -> EllipsoidSet:
    rng = np.random.default_rng(count)
    return EllipsoidSet(
        stamp=stamp,
        p_WO=rng.normal(size=(count, 3)),
        R_WO=np.tile(np.eye(3), (count, 1, 1)),
        semi_axes=rng.uniform(0.1, 0.2, (count, 3)),
        v_WO=np.zeros((count, 3)),
        ids=np.arange(count),
    )


def log(instants: int = 4, frames: int = 2) -> MotionLog:
    rng = np.random.default_rng(0)
    stamp, p_WO, R_WO, semi_axes = pack_ellipsoids([ellipsoids(i, 0.1 * i) for i in range(frames)])
    return MotionLog(
        t=np.arange(instants) * 0.1,
        q=rng.normal(size=(instants, 9)),
        v=rng.normal(size=(instants, 9)),
        torque=rng.normal(size=(instants, 9)),
        saturated=np.zeros(instants),
        desired_position=rng.normal(size=(instants, 3)),
        desired_velocity=rng.normal(size=(instants, 3)),
        desired_acceleration=rng.normal(size=(instants, 3)),
        phase=np.linspace(1.0, 0.1, instants),
        observation_stamp=stamp,
        p_WO=p_WO,
        R_WO=R_WO,
        semi_axes=semi_axes,
        out_of_range=np.arange(frames),
        regulation="Verified",
        shortfall=rng.uniform(size=instants),
        short_of=np.full(instants, -1),
        event_time=np.array([0.1, 0.2]),
        event=("obstacles not seen since t = 0.00 s", ""),
        stop_reason="goal",
        wall_time=1.5,
        modulated=True,
        scenario="task:\n  clearance: 0.15\n",
        seed=3,
        versions=("drake 1.51.1", "commit abc"),
    )


@pytest.mark.parametrize(
    "one", [log(), log(0, 0), replace(log(), event=(), event_time=np.zeros(0))]
)
def test_what_is_written_is_read_back(one: MotionLog, tmp_path: Path) -> None:
    file = tmp_path / "run.npz"
    save_logs(file, {"preplanned": log(2, 0), "modulated": one})
    back = load_logs(file)
    assert list(back) == ["preplanned", "modulated"]
    for item in fields(MotionLog):
        before, after = getattr(one, item.name), getattr(back["modulated"], item.name)
        if isinstance(before, np.ndarray):
            np.testing.assert_array_equal(after, before)
            assert after.shape == before.shape
        elif isinstance(before, tuple):
            assert tuple(after) == before
        else:
            assert after == before
            assert type(after) is type(before)


def test_numpy_alone_can_read_it(tmp_path: Path) -> None:
    save_logs(tmp_path / "run.npz", {"modulated": log()})
    with np.load(tmp_path / "run.npz", allow_pickle=False) as archive:
        assert archive["modulated/q"].shape == (4, 9)
        assert archive["modulated/stop_reason"].item() == "goal"
        assert archive["modulated/event"].tolist()[1] == ""


def test_the_file_has_the_name_that_was_asked_for(tmp_path: Path) -> None:
    save_logs(tmp_path / "run.log", {"modulated": log()})
    assert [p.name for p in tmp_path.iterdir()] == ["run.log"]


def test_another_archive_is_refused_and_told_what_it_lacks(tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", **{"modulated/t": np.zeros(3)})
    with pytest.raises(ValueError, match=r"other.npz is not a motion log: 'modulated' lacks .*'q'"):
        load_logs(tmp_path / "other.npz")


def test_ellipsoids_are_packed_with_nan_rows_where_there_are_fewer() -> None:
    frames = [ellipsoids(2, 0.0), ellipsoids(0, 0.1), ellipsoids(3, 0.2)]
    stamp, p_WO, R_WO, semi_axes = pack_ellipsoids(frames)
    np.testing.assert_array_equal(stamp, [frame.stamp for frame in frames])
    for row, frame in enumerate(frames):
        packed = {"p_WO": p_WO[row], "R_WO": R_WO[row], "semi_axes": semi_axes[row]}
        for name, values in packed.items():
            np.testing.assert_array_equal(values[: len(frame)], getattr(frame, name))
            assert np.isnan(values[len(frame) :]).all()


def test_duration_is_the_last_instant() -> None:
    assert log().duration == pytest.approx(0.3)
    assert log(0).duration == 0.0
