import gc
import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from pydrake.systems.analysis import Simulator

from drake_oa.app.benchmark_command import PARTS as COMMAND_PARTS
from drake_oa.app.cli import main
from drake_oa.benchmark import benchmark
from drake_oa.benchmark.benchmark import (
    FRAME_TARGET,
    KERNEL_TARGET,
    PAPER_TARGET,
    PARTS,
    POLICY_TARGET,
    REAL_TIME_TARGET,
    TIMES_TARGET,
    VERIFICATION_TARGET,
    Effort,
    run_benchmark,
)
from drake_oa.benchmark.benchmark_figures import Figure, benchmark_table
from drake_oa.benchmark.policy_timings import OBSTACLES, six_obstacles, time_kernel, time_policy
from drake_oa.benchmark.run_timings import bare_station
from drake_oa.common.schema_check import ScenarioError
from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.scenario.loading import load_scenario


@pytest.fixture(scope="module")
def scenario():
    return load_scenario("tabletop_box")


SMALL = Effort(
    seconds=0.05, steps=15, frames=2, rows=64, baseline_rows=32, scenes=1, readable_rows=1
)


@pytest.fixture(scope="module")
def figures(scenario):
    return run_benchmark(scenario, effort=SMALL)


def test_every_figure_has_a_target_and_a_baseline(figures):
    asked = {}
    for item in figures["figures"]:
        asked.setdefault(item["part"], []).append(item["target"])
        assert math.isfinite(item["value"]), item
        assert item["value"] > 0.0, item
        assert item["baseline_name"]
        if item["baseline"] is None:
            assert "not installed" in item["baseline_name"]
            assert item["ratio"] is item["times_better"] is None
        else:
            assert item["ratio"] == pytest.approx(item["value"] / item["baseline"])
    assert asked == {
        "rollouts": [PAPER_TARGET, TIMES_TARGET, TIMES_TARGET],
        "policy": [KERNEL_TARGET, POLICY_TARGET, None],
        "verification": [VERIFICATION_TARGET],
        "run": [REAL_TIME_TARGET],
        "perception": [FRAME_TARGET],
        "thinking": [None],
    }


def test_the_breakdown_names_every_layer_once(figures):
    shares = [(item["part"], item["layer"]) for item in figures["breakdown"]]
    assert len(shares) == len(set(shares))
    assert {
        "route",
        "regressor chain",
        "coupling and DMP",
        "controller",
        "rendering",
        "noise",
        "segmentation and fusion",
        "descriptor",
        "from rest, slowest scene",
    } <= {layer for _, layer in shares}
    assert all(math.isfinite(item["value"]) for item in figures["breakdown"])
    assert all(item["value"] > 0.0 for item in figures["breakdown"])


def test_the_budget_of_a_run_has_every_layer_and_adds_up_to_the_whole(figures):
    budget = {item["layer"]: item for item in figures["budget"]}
    assert len(budget) == len(figures["budget"])
    assert {
        "rendering",
        "segmentation",
        "tracking and fusion",
        "descriptor",
        "decision",
        "policy",
        "controller",
        "supervisor",
        "plant",
        "Simulator and logs",
    } <= set(budget)
    assert sum(item["share"] for item in budget.values()) == pytest.approx(1.0)
    assert budget["rendering"]["rate"] == 30.0
    table = benchmark_table(figures)
    assert "by processor time" in table
    assert all(layer in table for layer in budget)


@pytest.mark.parametrize("package", ["movement_primitives", "pytransform3d"])
def test_a_peer_that_is_missing_leaves_no_figure(monkeypatch, package):
    monkeypatch.setitem(sys.modules, "drake_oa.studies.scenes.peers", None)
    monkeypatch.setattr(
        benchmark.importlib,
        "import_module",
        lambda name: (_ for _ in ()).throw(ModuleNotFoundError(name, name=package)),
    )
    baseline, text = benchmark._peer_step(6)
    assert baseline is None
    assert f"{package} is not installed" in text
    figure = Figure("policy", "x", 1.0, "us", "<=", 2.0, baseline, text)
    assert figure.met is True
    assert figure.ratio is figure.times_better is None
    assert replace(figure, relative=True).met is None


def test_only_what_is_asked_for_is_timed():
    # Neither needs a robot or a camera.
    said = []
    found = run_benchmark(
        load_scenario("free_space"), ["verification", "rollouts"], effort=SMALL, on_part=said.append
    )
    assert said == ["rollouts", "verification"]
    assert {item["part"] for item in found["figures"]} == set(said) == set(found["notes"])
    assert found["scenario"] is None
    assert found["budget"] == []
    assert "scaled up" in benchmark_table(found)


@pytest.mark.parametrize("parts", [["peel"], []])
def test_unknown_parts_are_refused(scenario, parts):
    with pytest.raises(ValueError, match="valid are: rollouts, policy"):
        run_benchmark(scenario, parts)


def test_the_command_knows_every_part_and_writes_what_it_prints(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], figures
) -> None:
    assert tuple(PARTS) == COMMAND_PARTS
    asked = []

    def measured(scenario, parts, *, on_part):
        asked.append(parts)
        on_part("run")
        return figures

    monkeypatch.setattr(benchmark, "run_benchmark", measured)
    out = tmp_path / "new" / "figures.json"
    assert main(["benchmark", "--only", "run", "--only", "policy", "--json", str(out)]) == 0
    printed = capsys.readouterr()
    assert printed.out == benchmark_table(figures) + "\n"
    assert "timing run" in printed.err
    assert asked == [["run", "policy"]]
    assert json.loads(out.read_text()) == figures


def test_a_file_that_cannot_be_written_is_refused_at_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["benchmark", "--json", str(tmp_path)]) == 2
    assert "cannot write" in capsys.readouterr().err


def test_the_report_says_where_it_was_made_and_is_json(figures):
    read = json.loads(json.dumps(figures))
    assert read == figures
    assert {"cpu", "cores", "load", "python", "system"} <= set(read["machine"])
    assert {"drake", "drake_oa", "numpy"} <= set(read["versions"])
    assert "commit" in read


def test_the_table_shows_each_target_and_the_machine(figures):
    table = benchmark_table(figures)
    for text in (
        ">= 1",
        "<= 10 us",
        "<= 60 us",
        "<= 33 ms",
        "<= 3 ms",
        "<= 10 s",
        "10 times better",
        "real-time factor",
        "policy step",
    ):
        assert text in table
    assert figures["machine"]["cpu"] in table
    assert figures["versions"]["drake"] in table


@pytest.mark.parametrize(
    ("relation", "value", "relative", "met", "times"),
    [
        (">=", 1.1, False, True, 0.55),
        (">=", 0.9, False, False, 0.45),
        ("<=", 0.9, False, True, 2 / 0.9),
        ("<=", 1.9, True, True, 2 / 1.9),
        ("<=", 2.1, True, False, 2 / 2.1),
    ],
)
def test_a_figure_knows_whether_its_target_is_met(relation, value, relative, met, times):
    figure = Figure("p", "x", value, "", relation, 1.0, 2.0, "y", relative)
    assert figure.met is met
    assert figure.ratio == pytest.approx(0.5 * value)
    assert figure.times_better == pytest.approx(times)
    assert replace(figure, target=None).met is None


def test_all_six_obstacles_take_part_in_the_policy(scenario):
    diagram = build_avoidance(six_obstacles(scenario))
    simulator = Simulator(diagram)
    simulator.Initialize()
    root = simulator.get_context()
    chain = diagram.GetSubsystemByName("regressor_chain")
    coupling = chain.GetOutputPort("coupling_parameters").Eval(chain.GetMyContextFromRoot(root))
    assert len(coupling) == OBSTACLES
    assert (coupling.alpha > 0.0).all()


def test_the_policy_is_timed_compiled_and_through_its_systems(scenario):
    kernel, (complete, running) = time_kernel(scenario, 4, steps=3), time_policy(scenario, 5)
    assert [len(times) for times in (kernel, complete, running)] == [4, 5, 5]
    assert all(math.isfinite(time) and time > 0.0 for time in (*kernel, *complete, *running))


def test_the_bare_arm_is_held_and_outlives_what_built_it(scenario):
    diagram = bare_station(scenario, render=False)
    gc.collect()
    simulator = Simulator(diagram)
    simulator.Initialize()
    plant = diagram.GetSubsystemByName("plant")
    context = plant.GetMyContextFromRoot(simulator.get_context())
    before = plant.GetPositions(context)
    simulator.AdvanceTo(0.05)
    assert plant.GetPositions(context) == pytest.approx(before, abs=1e-3)


def test_a_scenario_without_robot_or_camera_is_refused():
    with pytest.raises(ScenarioError, match="DepthCamera"):
        run_benchmark(load_scenario("free_space"))
    with pytest.raises(ScenarioError, match="DepthCamera"):
        bare_station(load_scenario("tabletop_box", ["perception=!GroundTruth {}"]))


@pytest.mark.parametrize(
    "counts",
    [
        {"seconds": 0.0},
        {"steps": 0},
        {"frames": 0},
        {"rows": -1},
        {"rows": 10, "baseline_rows": 11},
        {"readable_rows": 65},
    ],
)
def test_nothing_to_time_is_refused(counts):
    with pytest.raises(ValueError, match="must be"):
        Effort(**counts)
