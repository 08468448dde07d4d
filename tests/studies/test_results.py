"""Calls carried out in parallel; results on disk, taken when their key is right."""

import operator

import pytest

from drake_oa.studies.results import ResultFolder, carry_out


def test_a_result_comes_back_by_its_key_only(tmp_path):
    folder = ResultFolder(tmp_path / "a" / "b")
    folder.save("one", "key", {"x": 1.5})
    assert folder.load("one", "key") == {"x": 1.5}
    assert folder.load("one", "other") is None
    assert folder.load("two", "key") is None
    assert [path.name for path in folder.path.iterdir()] == ["one.json"]


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
