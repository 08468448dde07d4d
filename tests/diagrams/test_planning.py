"""Motions of the whole arm: who tells the shapes of things."""

import re
from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.primitives import ConstantValueSource

from drake_oa.common.config import ScenarioError
from drake_oa.common.messages import HoldCause, ObstacleClouds
from drake_oa.common.wires import connections
from drake_oa.diagrams.avoidance import Layers, build_avoidance
from drake_oa.geometry.solids import SURROUNDINGS
from drake_oa.planning.solid_scene import SolidScene
from drake_oa.runs.metrics import robot_metrics
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario, parse_scenario
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.shipped import shipped_scenarios
from tests.diagrams.test_other_arm import arm_text

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


def solids_seen(scenario: Scenario, seconds: float = 0.01) -> SolidScene:
    diagram = build_avoidance(scenario)
    simulator = Simulator(diagram)
    simulator.AdvanceTo(seconds)
    solids = diagram.GetSubsystemByName("solids")
    context = solids.GetMyContextFromRoot(simulator.get_context())
    return solids.GetOutputPort("solids_W").Eval(context)


CARTON = """
directives:
- add_directives: {file: package://drake_oa/scenes/table.dmd.yaml}
- add_model: {name: carton, file: package://drake_oa/obstacles/carton.sdf}
- add_weld: {parent: world, child: carton::body, X_PC: {translation: [0.45, 0.0, 0.0]}}
"""


def among_a_carton(*lines: str) -> Scenario:
    """`tabletop_box` with a carton in place of the box, which is not named as an obstacle."""
    name = "directives:\n- add_directives:\n    file: package://drake_oa/scenes/tabletop_box.dmd.yaml\n"
    text = shipped_scenarios()["tabletop_box"].read_text()
    assert name in text
    return parse_scenario(text.replace(name, CARTON.lstrip()), [*WHOLE_ARM, *lines])


def test_whatever_is_in_the_world_is_a_solid_whatever_its_name(caplog):
    scene = solids_seen(among_a_carton("perception=!GroundTruth {}"))
    assert {label.split("::")[0] for label in scene.labels} == {"table", "carton"}
    # Of what is not named as an obstacle the tool keeps what the links keep.
    assert (scene.solids.layout[:, 5] == SURROUNDINGS).all()
    assert not caplog.text


@pytest.mark.slow
def test_what_a_camera_sees_is_a_solid_whatever_its_name(caplog):
    scene = solids_seen(among_a_carton(), 0.07)
    assert scene.labels == ("obstacle 0", "the table")
    assert not [record for record in caplog.records if "no model instance" in record.message]


@pytest.mark.slow
@pytest.mark.parametrize("perception", [["perception=!GroundTruth {}"], []], ids=["truth", "depth"])
def test_it_is_gone_round(perception):
    scenario = among_a_carton("task.clearance=0.03", *perception)
    log = simulate(scenario)
    assert log.stop_reason == "goal"
    assert robot_metrics(scenario, log.q, log.q_world).contacts == ()


_SIX = """
task: {start: [0.5, -0.3, 0.35], goal: [0.5, 0.3, 0.35], duration: 2.0}
regulation: !Verified {}
robot:
  base_link: foot
  X_WB: {rpy: [0, 0, 3.1415927]}
  hand_link: wrist3
  p_HE: [0, 0, 0.1]
  tool_links: [wrist3]
  q_seed: [0.3, -1.5708, 1.5708, -1.5708, -1.5708, 0.0]
"""


def an_arm(tmp_path, old="", new="") -> Scenario:
    """An arm of six joints whose model has one text in place of another."""
    (tmp_path / "six.urdf").write_text(re.sub(old, new, arm_text(), flags=re.DOTALL))
    return parse_scenario(_SIX + "  model: six.urdf\n", folder=tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            "<collision>.*?</collision>",
            "",
            r"robot.tool_links: \['wrist3'\] have no collision geometry; the model needs a <coll",
        ),
        (
            '<joint name="wrist3_joint" type="revolute">',
            '<joint name="wrist3_joint" type="prismatic">',
            "robot.model: joint 'wrist3_joint' moves 'tool_point' and is of type prismatic; the "
            "arm's joints must be revolute",
        ),
    ],
    ids=["no collision geometry", "prismatic"],
)
def test_an_arm_that_cannot_be_measured_is_refused(tmp_path, old, new, words):
    with pytest.raises(ScenarioError, match=words):
        build_avoidance(an_arm(tmp_path, old, new))


def test_a_link_without_shape_is_told_of_and_joints_without_limits_are_turned(tmp_path, caplog):
    def changed(found: re.Match) -> str:
        return {"t": 'type="continuous"', "l": "", "<": found[1] or ""}[found[0][0]]

    elbow = '(<link name="elbow">.*?)<collision>.*?</collision>'
    limits = f'{elbow}|type="revolute"|lower="-6.28" upper="6.28"'
    log = simulate(an_arm(tmp_path, limits, changed), duration=0.5)
    assert "robot.model: elbow: no collision geometry, so nothing keeps it clear" in caplog.text
    assert np.isfinite(log.q).all()
    assert np.linalg.norm(log.p_WE[-1] - log.p_WE[0]) > 0.01


def test_an_arm_that_begins_in_itself_is_refused():
    q = "q_start: [0.0, 1.2, 0.0, -3.0, 0.0, 1.0, 0.0]"
    text = f"task: {{{q}, goal: [0.45, 0.45, 0.3]}}\nregulation: !Verified {{}}\n"
    with pytest.raises(ScenarioError, match=r"task.start: .* panda_link\d is \d+ mm inside panda_"):
        build_avoidance(parse_scenario(text))


CRATE = """
obstacles:
- name: crate
  translation: [0.45, 0.45, 0.25]
  present: [0.0, 0.4]
  shapes:
  - !Box {size: [0.4, 0.02, 0.5], translation: [0.0, 0.15, 0.0]}
  - !Box {size: [0.4, 0.02, 0.5], translation: [0.0, -0.15, 0.0]}
  - !Box {size: [0.02, 0.3, 0.5], translation: [0.2, 0.0, 0.0]}
  - !Box {size: [0.02, 0.3, 0.5], translation: [-0.2, 0.0, 0.0]}
  - !Box {size: [0.42, 0.32, 0.02], translation: [0.0, 0.0, 0.26]}
regulation: !Verified {}
"""


def test_it_waits_for_what_leaves_no_way_and_goes_on_when_that_leaves():
    log = simulate(parse_scenario(CRATE), duration=1.0)
    held = np.array([cause == HoldCause.OBSTACLES for cause in log.event_hold])
    assert any("would touch obstacle" in event for event in log.event)
    assert held.any()
    speed = np.linalg.norm(np.gradient(log.p_WE, log.t, axis=0), axis=1)
    assert speed[log.t < 0.4].max() < 0.02
    assert speed[log.t > 0.6].max() > 0.02


def test_sixty_obstacles_are_decided_among():
    rng = np.random.default_rng(3)
    around = rng.uniform(0.75, 1.0, 60) * np.exp(1j * rng.uniform(-np.pi, np.pi, 60))
    balls = [
        f"- {{name: b{k}, translation: [{p.real:.3f}, {p.imag:.3f}, {rng.uniform(0.05, 0.9):.3f}], "
        "shapes: [!Sphere {radius: 0.04}]}"
        for k, p in enumerate(around)
    ]
    text = "task: {clearance: 0.05}\nregulation: !Verified {}\nobstacles:\n" + "\n".join(balls)
    log = simulate(parse_scenario(text), duration=0.6)
    assert np.linalg.norm(log.p_WE[-1] - log.p_WE[0]) > 0.005
    assert log.shortfall[-1] == 0.0
