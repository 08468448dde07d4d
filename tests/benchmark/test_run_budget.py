"""A run whose systems tell a stopwatch when they work."""

import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import LeafSystem

from drake_oa.benchmark import run_budget
from drake_oa.benchmark.run_budget import FRAMEWORK, PLANT, RENDERING, WATCHER, time_run
from drake_oa.benchmark.stopwatch import Stopwatch
from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.perception import depth_perception
from drake_oa.runs.simulation import MotionWatcher
from drake_oa.scenario.loading import load_scenario


def test_an_ideal_camera_renders_for_perception_itself_and_rows_add_up():
    scenario = load_scenario("tabletop_box", ["perception.noise=null"])
    found = {item.layer: item for item in time_run(scenario, 0.05)}
    assert "noise" not in found
    assert found[RENDERING].wall > 0.0
    assert {PLANT, FRAMEWORK, WATCHER} <= set(found)
    assert sum(item.share for item in found.values()) == pytest.approx(1.0)


def test_drake_is_left_as_it_was_also_after_an_error(monkeypatch):
    before = dict(vars(LeafSystem)), depth_perception.fuse
    monkeypatch.setattr(run_budget, "build_avoidance", lambda scenario: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        time_run(load_scenario("tabletop_box"), 0.05)
    assert (dict(vars(LeafSystem)), depth_perception.fuse) == before


def test_a_watched_run_is_the_same_motion():
    scenario = load_scenario("tabletop_box")

    def place(watch: Stopwatch | None):
        if watch is None:
            diagram = build_avoidance(scenario)
        else:
            with run_budget._watched_systems(watch):
                diagram = build_avoidance(scenario)
        simulator = Simulator(diagram)
        simulator.set_monitor(MotionWatcher(diagram, scenario, 1.0, None))
        simulator.AdvanceTo(0.1)
        plant = diagram.GetSubsystemByName("plant")
        return plant.GetPositions(plant.GetMyContextFromRoot(simulator.get_context())).tolist()

    assert place(Stopwatch()) == place(None)
