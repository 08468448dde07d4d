"""Calls carried out in parallel; results on disk, taken when their key is right; counts."""

import operator

import pytest

from drake_oa.studies.results import (
    ResultFolder,
    Tally,
    carry_out,
    drawn_figures,
    drawn_lines,
)


def test_a_result_comes_back_by_its_key_only(tmp_path):
    folder = ResultFolder(tmp_path / "a" / "b")
    folder.save("one", "key", {"x": 1.5})
    assert folder.load("one", "key") == {"x": 1.5}
    assert folder.load("one", "other") is None
    assert folder.load("two", "key") is None
    assert [path.name for path in folder.path.iterdir()] == ["one.json"]


def test_shares_are_of_all_scenes_the_greatest_first():
    one, other = Tally(), Tally()
    assert one.takes("courses", "")
    assert not one.takes("courses", "too high")
    for reason in ("", "too low", "too low"):
        other.takes("courses", reason)
    other.takes("scenes", "")
    drawn = drawn_figures([one.counts, other.counts])
    assert drawn == {
        "courses": {"looked_at": 5, "dropped": {"too low": 0.4, "too high": 0.2}},
        "scenes": {"looked_at": 1, "dropped": {}},
    }
    assert list(drawn["courses"]["dropped"]) == ["too low", "too high"]
    assert drawn_lines(drawn) == [
        "courses looked at: 5; dropped: 40.0% (too low), 20.0% (too high)",
        "scenes looked at: 1; dropped: none",
    ]


_CALLS = [(k, 2) for k in range(5)]
_EXPECTED = {k: k**2 for k in range(5)}


@pytest.fixture(scope="module")
def cluster():
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None
    ) as made:
        yield made.scheduler_address


@pytest.mark.parametrize("jobs", [1, 2])
def test_every_call_comes_back_with_its_place(jobs):
    assert dict(carry_out(operator.pow, _CALLS, jobs=jobs)) == _EXPECTED
    with pytest.raises(ZeroDivisionError):
        list(carry_out(operator.truediv, [(1, 0), (1, 0), (1, 1)], jobs=jobs))


def test_a_cluster_does_the_same(cluster):
    assert dict(carry_out(operator.pow, _CALLS, scheduler=cluster)) == _EXPECTED
    assert list(carry_out(operator.pow, [], scheduler=cluster)) == []
    with pytest.raises(ZeroDivisionError):
        list(carry_out(operator.truediv, [(1, 1), (1, 0), (1, 1)], scheduler=cluster))


@pytest.mark.parametrize("address", ["nothing://localhost:1"])
def test_a_scheduler_that_is_not_there(address, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("drake_oa.studies.results.CONNECT_TIMEOUT", 0.2)
    with pytest.raises(ValueError, match=f"cannot reach a Dask scheduler at {address}: "):
        list(carry_out(operator.pow, _CALLS, scheduler=address))
