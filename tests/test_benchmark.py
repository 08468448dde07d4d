"""What `drake-oa benchmark` times, and that timing changes nothing."""

import gc
import json
import math

import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import LeafSystem

from drake_oa import benchmark
from drake_oa.benchmark import REST, Stopwatch, benchmark_table, drake_alone, run_benchmark
from drake_oa.common import thinking
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario


@pytest.fixture(scope="module")
def box():
    return load_scenario("tabletop_box")


@pytest.fixture(scope="module")
def figures(box):
    scenarios = {"tabletop_box": box, "free_space": load_scenario("free_space")}
    return run_benchmark(scenarios, seconds=0.1, runs=1)


def test_a_run_is_timed_with_its_layers_and_decisions(figures):
    assert json.loads(json.dumps(figures, allow_nan=False)) == figures
    assert {"cpu", "cores", "load"} <= set(figures["machine"])
    assert {"drake", "drake_oa", "numpy"} <= set(figures["versions"])
    for name, found in figures["scenarios"].items():
        run, thinking = found["run"], found["thinking"]
        assert run["real_time_factor"] > 0.0
        assert (run["drake_alone"] is None) == (name == "free_space")
        assert all(0.0 < seconds < math.inf for seconds in run["layers"].values())
        # The paper's regulation, of a free point, thinks at no cost.
        thinks = name != "free_space"
        assert (thinking["decisions"] > 0) == thinks
        assert (thinking["measured"] > 0.0) == (thinking["modelled"] > 0.0) == thinks
    layers = figures["scenarios"]["tabletop_box"]["run"]["layers"]
    assert {REST, "perception", "motion_verifier", "dmp_integrator", "controller"} <= set(layers)
    table = str(benchmark_table(figures))
    assert table.splitlines()[0].split() == ["tabletop_box", "free_space"]
    assert all(name in table for name in (*layers, "decisions", figures["machine"]["cpu"]))


def test_only_what_is_asked_for_is_timed():
    said = []
    found = run_benchmark(
        {"free_space": load_scenario("free_space")}, ["run"], seconds=0.05, on_part=said.append
    )
    assert said == ["free_space: run"]
    assert list(found["scenarios"]["free_space"]) == ["run"]
    assert "decisions" not in str(benchmark_table(found))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"parts": ["peel"]}, "valid are: run, thinking"),
        ({"seconds": 0.0}, "must be positive"),
    ],
)
def test_what_cannot_be_timed_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        run_benchmark({}, **options)


def test_the_arm_alone_is_held_and_outlives_what_built_it(box):
    diagram = drake_alone(box)
    gc.collect()
    simulator = Simulator(diagram)
    plant = diagram.GetSubsystemByName("plant")
    context = plant.GetMyContextFromRoot(simulator.get_context())
    before = plant.GetPositions(context)
    simulator.AdvanceTo(0.05)
    assert plant.GetPositions(context) == pytest.approx(before, abs=1e-3)
    with pytest.raises(ValueError, match="robot"):
        drake_alone(load_scenario("free_space"))


def test_a_watched_run_is_the_same_motion(box):
    def places():
        return simulate(box, duration=0.1).q.tolist()

    with benchmark._watched_systems(Stopwatch()):
        watched = places()
    assert watched == places()


def test_drake_is_left_as_it_was_also_after_an_error(box, monkeypatch):
    before = dict(vars(LeafSystem)), thinking.counted
    monkeypatch.setattr(benchmark, "simulate", lambda *_, **__: 1 / 0)
    for timing in (benchmark.time_layers, benchmark.time_thinking):
        with pytest.raises(ZeroDivisionError):
            timing(box, 0.05)
    assert (dict(vars(LeafSystem)), thinking.counted) == before


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
