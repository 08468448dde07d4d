"""Tests of parallel calls and of stored results, which are reused if their key is equal."""

import operator
from functools import partial

import pytest

from drake_oa.evaluation.results import Task, carry_out, resumed

_POWERS = [partial(operator.pow, k, 2) for k in range(5)]
_EXPECTED = {k: k**2 for k in range(5)}
_FAILING = [partial(operator.truediv, 1, k) for k in (1, 0, 1)]


def test_stored_result_is_reused_only_for_an_equal_call(tmp_path):
    def run(call):
        return resumed({0: Task("one", call)}, tmp_path)

    assert run(_POWERS[3]) == ({0: 9}, 0)
    assert run(_POWERS[3]) == ({0: 9}, 1)
    assert run(_POWERS[4]) == ({0: 16}, 0)
    assert [path.name for path in tmp_path.iterdir()] == ["one.json"]


@pytest.fixture(scope="module")
def cluster():
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as dask:
        yield dask.scheduler_address


@pytest.mark.parametrize("workers", [1, 2, "cluster"])
def test_calls_return_index_and_result_in_any_order(workers, request):
    if workers == "cluster":
        workers = request.getfixturevalue(workers)
    assert dict(carry_out(_POWERS, workers)) == _EXPECTED
    with pytest.raises(ZeroDivisionError):
        list(carry_out(_FAILING, workers))


def test_unreachable_scheduler_is_an_error(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("drake_oa.evaluation.results.CONNECT_TIMEOUT", 0.2)
    with pytest.raises(ValueError, match="cannot reach a Dask scheduler at nothing://x:1: "):
        list(carry_out(_POWERS, "nothing://x:1"))
