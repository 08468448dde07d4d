import gc
import json
import math

import pytest
from pydrake.systems.analysis import Simulator

from drake_oa.benchmark import (
    FRAME_TARGET,
    POLICY_TARGET,
    REAL_TIME_TARGET,
    Figure,
    benchmark_table,
    run_benchmark,
)
from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.scenario import ScenarioError, load_scenario
from drake_oa.timings import OBSTACLES, bare_station, six_obstacles


@pytest.fixture(scope="module")
def scenario():
    return load_scenario("tabletop_box")


@pytest.fixture(scope="module")
def figures(scenario):
    return run_benchmark(scenario, seconds=0.05, steps=15, frames=2)


def test_every_figure_has_a_target_and_a_baseline(figures):
    targets = [item["target"] for item in figures["figures"]]
    assert targets == [REAL_TIME_TARGET, POLICY_TARGET, FRAME_TARGET]
    for item in figures["figures"]:
        for key in ("value", "baseline", "ratio"):
            assert math.isfinite(item[key]), item
            assert item[key] > 0.0, item
        assert item["ratio"] == pytest.approx(item["value"] / item["baseline"])
        assert item["baseline_name"]


def test_the_breakdown_names_every_layer_once(figures):
    layers = [item["layer"] for item in figures["breakdown"]]
    assert len(layers) == len(set(layers))
    assert {
        "route",
        "regressor chain",
        "coupling and DMP",
        "controller",
        "rendering",
        "segmentation and fusion",
        "descriptor",
    } <= set(layers)
    assert all(math.isfinite(item["value"]) for item in figures["breakdown"])
    assert all(item["value"] > 0.0 for item in figures["breakdown"])


def test_the_report_says_where_it_was_made_and_is_json(figures):
    read = json.loads(json.dumps(figures))
    assert read == figures
    assert {"cpu", "cores", "load", "python", "system"} <= set(read["machine"])
    assert {"drake", "drake_oa", "numpy"} <= set(read["versions"])
    assert "commit" in read


def test_the_table_shows_each_target_and_the_machine(figures):
    table = benchmark_table(figures)
    for text in (">= 1", "<= 200 us", "<= 33 ms", "real-time factor", "policy step"):
        assert text in table
    assert figures["machine"]["cpu"] in table
    assert figures["versions"]["drake"] in table


@pytest.mark.parametrize(
    ("relation", "value", "met"), [(">=", 1.1, True), (">=", 0.9, False), ("<=", 0.9, True)]
)
def test_a_figure_knows_whether_its_target_is_met(relation, value, met):
    figure = Figure("x", value, "", relation, 1.0, 2.0, "y")
    assert figure.met is met
    assert figure.ratio == pytest.approx(0.5 * value)


def test_all_six_obstacles_take_part_in_the_policy(scenario):
    diagram = build_avoidance(six_obstacles(scenario))
    simulator = Simulator(diagram)
    simulator.Initialize()
    root = simulator.get_context()
    chain = diagram.GetSubsystemByName("regressor_chain")
    coupling = chain.GetOutputPort("coupling_parameters").Eval(chain.GetMyContextFromRoot(root))
    assert len(coupling) == OBSTACLES
    assert (coupling.alpha > 0.0).all()


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


@pytest.mark.parametrize("counts", [{"seconds": 0.0}, {"steps": 0}, {"frames": 0}])
def test_nothing_to_time_is_refused(scenario, counts):
    with pytest.raises(ValueError, match="positive"):
        run_benchmark(scenario, **counts)
