"""Calls carried out in parallel; results on disk, taken when their key is right."""

import operator
from functools import partial

import pytest

from drake_oa.evaluation.results import Task, carry_out, resumed

_POWERS = [partial(operator.pow, k, 2) for k in range(5)]
_EXPECTED = {k: k**2 for k in range(5)}
_FAILING = [partial(operator.truediv, 1, k) for k in (1, 0, 1)]


def test_a_result_comes_back_by_its_key_only(tmp_path):
    def found(call):
        return resumed({0: Task("one", call)}, tmp_path)

    assert found(_POWERS[3]) == ({0: 9}, 0)
    assert found(_POWERS[3]) == ({0: 9}, 1)
    assert found(_POWERS[4]) == ({0: 16}, 0)
    assert [path.name for path in tmp_path.iterdir()] == ["one.json"]


@pytest.fixture(scope="module")
def cluster():
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None
    ) as made:
        yield made.scheduler_address


@pytest.mark.parametrize("workers", [1, 2, "cluster"])
def test_every_call_comes_back_with_its_place(workers, request):
    if workers == "cluster":
        workers = request.getfixturevalue(workers)
    assert dict(carry_out(_POWERS, workers)) == _EXPECTED
    with pytest.raises(ZeroDivisionError):
        list(carry_out(_FAILING, workers))


@pytest.mark.parametrize("address", ["nothing://localhost:1"])
def test_a_scheduler_that_is_not_there(address, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("drake_oa.evaluation.results.CONNECT_TIMEOUT", 0.2)
    with pytest.raises(ValueError, match=f"cannot reach a Dask scheduler at {address}: "):
        list(carry_out(_POWERS, address))
