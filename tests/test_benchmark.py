"""Metrics of `drake-oa benchmark`; timing does not affect the motion."""

import json
import math

import pytest
from pydrake.common.value import Value
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from drake_oa.benchmark import REMAINDER, benchmark_table, run_benchmark, timed_systems
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario


def test_benchmark_measures_runs_and_their_systems():
    scenarios = {name: load_scenario(name) for name in ("tabletop_box", "free_space")}
    metrics = run_benchmark(scenarios, seconds=0.1)
    assert json.loads(json.dumps(metrics, allow_nan=False)) == metrics
    assert {"drake", "drake_oa", "numpy"} <= set(metrics["versions"])
    for item in metrics["scenarios"].values():
        assert item["real_time_factor"] > 0.0
        assert all(0.0 <= seconds < math.inf for seconds in item["layers"].values())
    layers = metrics["scenarios"]["tabletop_box"]["layers"]
    listed = {REMAINDER, "perception", "motion_verifier", "dmp_integrator", "controller"}
    assert listed <= layers.keys()
    table = str(benchmark_table(metrics))
    assert table.splitlines()[0].split() == list(scenarios)
    assert all(name in table for name in (*layers, metrics["machine"]["cpu"]))


def test_timing_changes_neither_motion_nor_drake():
    box, before = load_scenario("tabletop_box"), dict(vars(LeafSystem))
    with timed_systems():
        timed = simulate(box, duration=0.1).q.tolist()
    assert timed == simulate(box, duration=0.1).q.tolist()
    with pytest.raises(ZeroDivisionError), timed_systems():
        raise ZeroDivisionError
    assert dict(vars(LeafSystem)) == before


class Slow(LeafSystem):
    """System whose output evaluates the input, if that is connected, and then advances a clock."""

    def __init__(self, seconds, clock):
        super().__init__()
        port = self.DeclareAbstractInputPort("before", Value(0))

        def calc(context, output):
            if port.HasValue(context):
                port.Eval(context)
            clock.append(clock[-1] + seconds)

        self.DeclareAbstractOutputPort("after", lambda: Value(0), calc)


def test_time_counts_for_the_innermost_system(monkeypatch):
    builder, clock = DiagramBuilder(), [0.0]
    monkeypatch.setattr("drake_oa.benchmark.time.perf_counter", lambda: clock[-1])
    with timed_systems() as wall_times:
        one, other = (builder.AddNamedSystem(f"{s}", Slow(s, clock)) for s in (0.1, 0.02))
    builder.Connect(one.get_output_port(), other.get_input_port())
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    other.get_output_port().Eval(other.GetMyContextFromRoot(context))
    assert wall_times == pytest.approx({"0.1": 0.1, "0.02": 0.02})
