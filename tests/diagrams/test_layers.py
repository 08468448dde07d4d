"""Tests of custom layers and of registered configuration blocks."""

import dataclasses as dc

import pytest
from pydantic import Field
from pydantic.dataclasses import dataclass
from pydrake.common.value import Value
from pydrake.systems.primitives import ConstantValueSource

from drake_oa.common.config import BLOCK, ScenarioError, json_schema
from drake_oa.common.messages import ObstacleClouds
from drake_oa.common.signal_builder import connections
from drake_oa.diagrams.avoidance import Layers, build_avoidance, no_op
from drake_oa.diagrams.perception import SOURCES, register_source
from drake_oa.scenario.loading import load_scenario, parse_scenario, scenario_text
from drake_oa.scenario.scenario import Scenario


@dataclass(config=BLOCK)
class Nobody:
    """Perception source without obstacles."""

    period: float = Field(default=0.1, ge=1e-3, le=1.0)
    """Time between two observations [s]."""


@pytest.fixture
def nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    """Registers the block `Nobody` for the duration of a test."""
    field = next(item for item in dc.fields(Scenario) if item.name == "perception")
    # Set to their own values, so that monkeypatch restores them after registration.
    monkeypatch.setattr(field, "type", field.type)
    for name in ("fields", "core_schema", "validator", "serializer"):
        name = f"__pydantic_{name}__"
        monkeypatch.setattr(Scenario, name, getattr(Scenario, name))
    monkeypatch.setitem(SOURCES, Nobody, None)

    def add(signals, block, scenario, station) -> None:
        source = ConstantValueSource(Value(ObstacleClouds()))
        signals.add("perception", source, outputs={"y0": "obstacles_W"})

    register_source(Nobody, add)


@pytest.mark.usefixtures("nobody")
def test_registered_block_is_parsed_validated_written_and_built() -> None:
    scenario = load_scenario("tabletop_box", ["perception=!Nobody {period: 0.2}"])
    assert scenario.perception == Nobody(period=0.2)
    assert parse_scenario(scenario_text(scenario)).perception == scenario.perception
    with pytest.raises(ScenarioError, match=r"perception.period: must be .* <= 1"):
        load_scenario("tabletop_box", ["perception=!Nobody {period: 7}"])
    assert json_schema(Scenario)["properties"]["seed"]["description"]
    edges = connections(build_avoidance(scenario))
    assert ("perception.y0", "ellipsoid_descriptor.obstacles_W") in edges
    # The collision scene for the guard is built from its obstacles.
    assert ("perception.y0", "collision_scene.obstacles_W") in edges
    assert ("collision_scene.collision_scene_W", "motion_guard.collision_scene_W") in edges


def test_empty_layer_leaves_its_signals_unconnected() -> None:
    layers = dc.replace(Layers(), safety=no_op, posture=no_op)
    diagram = build_avoidance(
        load_scenario("tabletop_box", ["perception=!GroundTruth {}"]), layers=layers
    )
    names = {system.get_name() for system in diagram.GetSystems()}
    assert not names & {"motion_guard", "nominal_posture_source", "log_speed_scale"}
    readers = {reader for _, reader in connections(diagram)}
    assert "dmp_integrator.speed_scale" not in readers
    assert "controller.desired_posture" not in readers
