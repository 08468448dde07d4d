"""Motions of the whole arm: who tells the shapes of things."""

from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.primitives import ConstantValueSource

from drake_oa.common.config import ScenarioError
from drake_oa.common.messages import ObstacleClouds
from drake_oa.common.wires import connections
from drake_oa.diagrams.avoidance import Layers, build_avoidance
from drake_oa.scenario.loading import load_scenario

WHOLE_ARM = ["regulation=!Verified {}", "evasion=null"]


def test_what_a_camera_sees_becomes_solids():
    edges = connections(build_avoidance(load_scenario("tabletop_box", WHOLE_ARM)))
    assert ("perception.obstacles_W", "solids.obstacles_W") in edges
    assert any(reader == "solids.camera_pose" for _, reader in edges)
    assert ("solids.solids_W", "motion_selector.solids_W") in edges


def test_what_a_source_of_ones_own_sees_becomes_solids():
    cloud = np.array([0.45, 0.0, 0.2]) + 0.02 * np.random.default_rng(1).normal(size=(200, 3))
    seen = ObstacleClouds(0.0, (cloud,), np.array([7]))

    def add(wires, scenario, station):
        source = ConstantValueSource(Value(seen))
        wires.add("perception", source, offers={"y0": "obstacles_W"})

    scenario = load_scenario("tabletop_box", [*WHOLE_ARM, "perception=!RecordedClouds {folder: .}"])
    diagram = build_avoidance(scenario, layers=replace(Layers(), perception=add))
    simulator = Simulator(diagram)
    simulator.Initialize()
    simulator.AdvanceTo(0.01)
    solids = diagram.GetSubsystemByName("solids")
    scene = solids.GetOutputPort("solids_W").Eval(
        solids.GetMyContextFromRoot(simulator.get_context())
    )
    assert scene.labels == ("obstacle 7", "the table")
    selector = diagram.GetSubsystemByName("motion_selector")
    context = selector.GetMyContextFromRoot(simulator.get_context())
    assert len(selector.GetOutputPort("decision").Eval(context)) == 2


def test_ellipsoids_that_hold_the_tool_are_no_shapes():
    given = "perception=!GivenEllipsoids {ellipsoids: []}"
    with pytest.raises(ScenarioError, match="!Verified needs obstacles that are seen"):
        build_avoidance(load_scenario("tabletop_box", [*WHOLE_ARM, given]))
