"""Log of a motion, and its file."""

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from drake_oa.common.messages import EllipsoidSet
from drake_oa.runs import motion_log
from drake_oa.runs.motion_log import MotionLog, load_logs, pack_ellipsoids, save_logs
from tests.builders import balls

LogOf = Callable[..., MotionLog]


def ellipsoids(count: int, stamp: float = 0.0) -> EllipsoidSet:
    """Returns random ellipsoids with a stamp [s]."""
    p_WO, radius, v_WO = np.random.default_rng(count).uniform(0.1, 0.2, (3, count, 3))
    return balls(*p_WO, radius=radius, v_WO=v_WO, stamp=stamp, ids=10 + np.arange(count))


@pytest.fixture
def log(straight_log: LogOf) -> MotionLog:
    """Log of a robot with two observations and a hold."""
    return straight_log(
        4,
        q=np.ones((4, 9)),
        observation_time=np.array([0.05, 0.15]),
        **pack_ellipsoids([ellipsoids(0), ellipsoids(1, 0.1)]),
        out_of_range=np.arange(2),
        event_time=np.array([0.1, 0.2]),
        event=("obstacles not seen since t = 0.00 s", ""),
        event_hold=("obstacles", "none"),
        motion_end=0.2,
    )


def test_logs_are_equal_after_writing_and_reading(
    log: MotionLog, straight_log: LogOf, tmp_path: Path
) -> None:
    file = tmp_path / "run.npz"
    for one in (log, straight_log(0)):
        save_logs(file, {"nominal": straight_log(2), "avoiding": one})
        back = load_logs(file)
        assert list(back) == ["nominal", "avoiding"]
        for name, before in vars(one).items():
            after = getattr(back["avoiding"], name)
            assert type(after) is type(before)
            np.testing.assert_array_equal(after, before)


def test_the_table_lists_every_key_and_no_other() -> None:
    table = (motion_log.__doc__ or "").split("\n=")[2]
    listed = [row.split()[0] for row in table.splitlines()[1:] if row[:1].isalpha()]
    assert listed == [item.name for item in fields(MotionLog)]


@pytest.mark.parametrize(
    ("version", "message"),
    [(None, "schema 1, this"), (3, r"missing .*'q'"), (2, "read it with drake_oa 0.0.9")],
)
def test_another_schema_and_missing_keys_are_named(
    version: int | None, message: str, tmp_path: Path
) -> None:
    keys = {} if version is None else {"schema_version": version}
    motion = {"avoiding/stop_reason": "goal", "avoiding/versions": ["drake_oa 0.0.9"]}
    np.savez(tmp_path / "run.npz", **motion, **keys)
    with pytest.raises(ValueError, match=message):
        load_logs(tmp_path / "run.npz")


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_damaged_logs_are_refused_by_name(share: float, log: MotionLog, tmp_path: Path) -> None:
    file = tmp_path / "run.npz"
    save_logs(file, {"avoiding": log})
    content = file.read_bytes()
    file.write_bytes(content[: int(share * len(content))])
    with pytest.raises(ValueError, match=r"run.npz is not a motion log"):
        load_logs(file)


def test_optional_keys_may_be_missing_and_unknown_keys_are_ignored(
    log: MotionLog, tmp_path: Path
) -> None:
    file = tmp_path / "run.npz"
    save_logs(file, {"avoiding": log})
    with np.load(file) as archive:
        arrays = dict(archive) | {"avoiding/confidence": np.full((2, 1), 0.3)}
    del arrays["avoiding/guard_claim"]
    np.savez(file, **arrays)
    assert load_logs(file)["avoiding"].guard_claim.shape == (0,)


def test_ellipsoids_are_packed_with_nan_rows_where_there_are_fewer(log: MotionLog) -> None:
    frames = [ellipsoids(2, 0.0), ellipsoids(0, 0.1), ellipsoids(3, 0.2)]
    packed = pack_ellipsoids(frames)
    np.testing.assert_array_equal(packed["observation_stamp"], [frame.stamp for frame in frames])
    assert packed["obstacle_id"].tolist() == [[10, 11, -1], [-1, -1, -1], [10, 11, 12]]
    assert np.isnan(packed["p_WO"][0, 2:]).all()
    whole = replace(log, **packed)
    for row, frame in enumerate(frames):
        observed = whole.observation(row)
        for name in ("p_WO", "R_WO", "semi_axes", "v_WO", "ids"):
            np.testing.assert_array_equal(getattr(observed, name), getattr(frame, name))
