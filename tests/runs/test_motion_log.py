"""The log of a motion, and its file."""

import math
import re
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from drake_oa.common.messages import EllipsoidSet
from drake_oa.runs import motion_log
from drake_oa.runs.motion_log import (
    MotionLog,
    load_logs,
    pack_ellipsoids,
    save_logs,
)


def ellipsoids(count: int, stamp: float = 0.0) -> EllipsoidSet:
    rng = np.random.default_rng(count)
    return EllipsoidSet(
        stamp=stamp,
        p_WO=rng.normal(size=(count, 3)),
        R_WO=np.tile(np.eye(3), (count, 1, 1)),
        semi_axes=rng.uniform(0.1, 0.2, (count, 3)),
        v_WO=rng.normal(size=(count, 3)),
        ids=10 + np.arange(count),
    )


def log(instants: int = 4, frames: int = 2) -> MotionLog:
    rng = np.random.default_rng(0)
    return MotionLog(
        t=np.arange(instants) * 0.1,
        q=rng.normal(size=(instants, 9)),
        v=rng.normal(size=(instants, 9)),
        torque=rng.normal(size=(instants, 9)),
        saturated=np.zeros(instants),
        p_WE=rng.normal(size=(instants, 3)),
        desired_position=rng.normal(size=(instants, 3)),
        desired_velocity=rng.normal(size=(instants, 3)),
        desired_acceleration=rng.normal(size=(instants, 3)),
        phase=np.linspace(1.0, 0.1, instants),
        speed_scale=np.ones(instants),
        tracking_error=np.full(instants, np.nan),
        q_world=rng.normal(size=(instants, 16)),
        observation_time=0.05 + 0.1 * np.arange(frames),
        **pack_ellipsoids([ellipsoids(i, 0.1 * i) for i in range(frames)]),
        out_of_range=np.arange(frames),
        regulation="Verified",
        shortfall=rng.uniform(size=instants),
        event_time=np.array([0.1, 0.2]),
        event=("obstacles not seen since t = 0.00 s", ""),
        event_hold=("obstacles", "none"),
        supervision_time=np.array([0.1, 0.3]),
        supervision_action=("hold", "run"),
        supervision_reason=("camera stopped", ""),
        position_name=("joint1",),
        position_lower=np.array([-1.0]),
        position_upper=np.array([1.0]),
        velocity_limit=np.array([2.0]),
        actuator_name=("joint1",),
        effort_limit=np.array([np.inf]),
        stop_reason="goal",
        ended="goal",
        wall_time=1.5,
        modulated=True,
        scenario="task:\n  clearance: 0.15\n",
        seed=3,
        versions=("drake 1.51.1", "source_digest abc"),
        motion_end=0.2,
    )


@pytest.mark.parametrize(
    "one",
    [
        log(),
        log(0, 0),
        replace(log(), event=(), event_hold=(), event_time=np.zeros(0), position_name=()),
    ],
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
            assert isinstance(after, tuple)
            assert after == before
        else:
            assert after == before
            assert type(after) is type(before)


def test_the_motion_may_end_before_the_run() -> None:
    one = log()
    assert (one.duration, one.simulated_time) == (0.2, pytest.approx(0.3))
    assert one.t[one.moving].tolist() == pytest.approx([0.0, 0.1, 0.2])
    assert replace(one, motion_end=math.nan).duration == one.simulated_time
    assert log(0).simulated_time == 0.0


def test_numpy_alone_can_read_it(tmp_path: Path) -> None:
    save_logs(tmp_path / "run.npz", {"modulated": log()})
    with np.load(tmp_path / "run.npz", allow_pickle=False) as archive:
        assert archive["modulated/q"].shape == (4, 9)
        assert archive["modulated/stop_reason"].item() == "goal"
        assert archive["modulated/event"].tolist()[1] == ""
        assert archive["schema_version"].item() == motion_log.SCHEMA_VERSION


def test_the_table_lists_every_key_and_no_other() -> None:
    table = (motion_log.__doc__ or "").split("\n=")[2]
    listed = [row.split()[0] for row in table.splitlines()[1:] if row[:1].isalpha()]
    assert listed == [item.name for item in fields(MotionLog)]
    page = (Path(__file__).parents[2] / "docs" / "log.md").read_text()
    assert re.findall(r"^\| `(\w+)` \|", page, re.MULTILINE) == listed


def with_nan(array: np.ndarray) -> np.ndarray:
    return np.where(np.arange(array.size).reshape(array.shape) == array.size - 1, np.nan, array)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"q": with_nan(log().q)}, "modulated/q must be finite"),
        ({"torque": log().torque[:2]}, r"modulated/torque must have a row .* 4 of t.*\(2, 9\)"),
        ({"p_WO": log().p_WO[:1]}, "modulated/p_WO must have a row .* 2 of observation_time"),
        ({"event": ("one",)}, "modulated/event must have a row .* 2 of event_time"),
        ({"goal": np.zeros((4, 2))}, "modulated/goal must hold x, y, z"),
        ({"t": -log().t}, "modulated/t must not fall"),
    ],
)
def test_what_cannot_be_shown_is_named(changes: dict, said: str, tmp_path: Path) -> None:
    save_logs(tmp_path / "run.npz", {"modulated": replace(log(), **changes)})
    with pytest.raises(ValueError, match=rf"run\.npz is not a motion log.*{said}"):
        load_logs(tmp_path / "run.npz")


def test_a_log_that_lacks_something_is_refused_and_told_what(tmp_path: Path) -> None:
    keys = {"modulated/t": np.zeros(3), "modulated/stop_reason": "goal", "schema_version": 2}
    np.savez(tmp_path / "other.npz", **keys)
    with pytest.raises(ValueError, match=r"other.npz is not a motion log.*'q'"):
        load_logs(tmp_path / "other.npz")


@pytest.mark.parametrize(("version", "said"), [(None, "schema 1, older"), (3, "schema 3, newer")])
def test_another_schema_is_refused_by_its_number(
    version: int | None, said: str, tmp_path: Path
) -> None:
    keys = {} if version is None else {"schema_version": version}
    np.savez(tmp_path / "run.npz", **{"modulated/stop_reason": "goal"}, **keys)
    with pytest.raises(ValueError, match=said):
        load_logs(tmp_path / "run.npz")


def damaged(kind: str, folder: Path) -> Path:
    file = folder / "run.npz"
    if kind == "text":
        file.write_text("no archive")
    elif kind == "empty":
        file.touch()
    elif kind == "array":
        with file.open("wb") as stream:
            np.save(stream, np.zeros(3))
    elif kind == "archive":
        np.savez(file, points=np.zeros(3))
    else:
        save_logs(file, {"modulated": log(400)})
        content = bytearray(file.read_bytes())
        if kind == "cut off":
            del content[len(content) // 2 :]
        else:
            content[len(content) // 8 : len(content) // 4] = bytes(len(content) // 8)
        file.write_bytes(content)
    return file


@pytest.mark.parametrize("kind", ["text", "empty", "array", "archive", "cut off", "overwritten"])
def test_what_is_no_log_is_refused_by_name(kind: str, tmp_path: Path) -> None:
    file = damaged(kind, tmp_path)
    with pytest.raises(ValueError, match=r"run.npz is not a motion log"):
        load_logs(file)


def test_ellipsoids_are_packed_with_nan_rows_where_there_are_fewer() -> None:
    frames = [ellipsoids(2, 0.0), ellipsoids(0, 0.1), ellipsoids(3, 0.2)]
    packed = pack_ellipsoids(frames)
    np.testing.assert_array_equal(packed["observation_stamp"], [frame.stamp for frame in frames])
    assert packed["obstacle_id"].tolist() == [[10, 11, -1], [-1, -1, -1], [10, 11, 12]]
    for row, frame in enumerate(frames):
        for name in ("p_WO", "R_WO", "semi_axes", "v_WO"):
            values = packed[name][row]
            np.testing.assert_array_equal(values[: len(frame)], getattr(frame, name))
            assert np.isnan(values[len(frame) :]).all()


def test_an_observation_is_what_was_packed() -> None:
    whole = replace(log(), **pack_ellipsoids([ellipsoids(2, 0.5), ellipsoids(3)]))
    seen = whole.observation(0)
    assert seen.stamp == 0.5
    assert seen.ids.tolist() == [10, 11]
    np.testing.assert_array_equal(seen.v_WO, ellipsoids(2).v_WO)
    assert whole.observation(1).R_WO.shape == (3, 3, 3)


def test_optional_keys_may_be_missing_and_unknown_keys_are_ignored(tmp_path: Path) -> None:
    file = tmp_path / "run.npz"
    save_logs(file, {"modulated": log()})
    with np.load(file) as archive:
        arrays = dict(archive) | {"modulated/confidence": np.full((2, 1), 0.3)}
    del arrays["modulated/goal"]
    np.savez(file, **arrays)
    assert load_logs(file)["modulated"].goal.shape == (0, 3)
