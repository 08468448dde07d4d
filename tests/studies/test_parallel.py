"""Calls carried out here, in processes and on a cluster."""

import operator

import pytest

from drake_oa.studies.results import carry_out

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


def test_here_they_come_one_by_one():
    done = []
    results = carry_out(done.append, [(1,), (2,)], jobs=1)
    next(results)
    assert done == [1]
    assert list(carry_out(operator.pow, [], jobs=3)) == []


@pytest.mark.parametrize("address", ["tcp://localhost:1", "localhost", "nothing://localhost:1"])
def test_a_scheduler_that_is_not_there(address, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("drake_oa.studies.results.CONNECT_TIMEOUT", 0.2)
    with pytest.raises(ValueError, match=f"cannot reach a Dask scheduler at {address}: "):
        list(carry_out(operator.pow, _CALLS, scheduler=address))
