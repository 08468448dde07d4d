"""What `drake-oa benchmark` times, and that timing changes nothing."""

import json
import math

import pytest
from pydrake.systems.framework import LeafSystem

from drake_oa import benchmark
from drake_oa.benchmark import REST, Stopwatch, benchmark_table, run_benchmark
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario


@pytest.fixture(scope="module")
def box():
    return load_scenario("tabletop_box")


@pytest.fixture(scope="module")
def figures(box):
    scenarios = {"tabletop_box": box, "free_space": load_scenario("free_space")}
    said = []
    found = run_benchmark(scenarios, seconds=0.1, on_scenario=said.append)
    assert said == list(scenarios)
    return found


def test_runs_are_timed_with_their_systems(figures):
    assert json.loads(json.dumps(figures, allow_nan=False)) == figures
    assert {"cpu", "cores", "load"} <= set(figures["machine"])
    assert {"drake", "drake_oa", "numpy"} <= set(figures["versions"])
    for found in figures["scenarios"].values():
        assert found["run"]["real_time_factor"] > 0.0
        assert all(0.0 < seconds < math.inf for seconds in found["run"]["layers"].values())
    layers = figures["scenarios"]["tabletop_box"]["run"]["layers"]
    assert {REST, "perception", "motion_verifier", "dmp_integrator", "controller"} <= set(layers)
    table = str(benchmark_table(figures))
    assert table.splitlines()[0].split() == ["tabletop_box", "free_space"]
    assert all(name in table for name in (*layers, figures["machine"]["cpu"]))


def test_a_time_that_is_not_positive_is_refused():
    with pytest.raises(ValueError, match="must be positive"):
        run_benchmark({}, seconds=0.0)


def test_a_watched_run_is_the_same_motion(box):
    def places():
        return simulate(box, duration=0.1).q.tolist()

    with benchmark._watched_systems(Stopwatch()):
        watched = places()
    assert watched == places()


def test_drake_is_left_as_it_was_also_after_an_error(box, monkeypatch):
    before = dict(vars(LeafSystem))
    monkeypatch.setattr(benchmark, "simulate", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        benchmark.time_layers(box, 0.05)
    assert dict(vars(LeafSystem)) == before


class Clock:
    """Time that passes as told."""

    now = 0.0

    def perf_counter(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr("drake_oa.benchmark.time", clock)
    return clock


def test_each_moment_is_that_of_the_innermost_section(clock):
    watch = Stopwatch()
    clock.now += 1.0
    with watch.section("outer"):
        clock.now += 2.0
        with watch.section("inner"):
            clock.now += 4.0
        with watch.section("outer"):
            clock.now += 8.0
        clock.now += 16.0
    watch.stop()
    assert watch.spent == {REST: 1.0, "outer": 26.0, "inner": 4.0}
