"""Verified motions of the whole arm: where shapes come from, and what is executed."""

import math
import re

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from drake_oa.common.messages import HoldReason
from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.geometry.collision_scene import ENVIRONMENT, CollisionScene
from drake_oa.runs.simulation import MAX_NORMALIZED_TIME, simulate
from drake_oa.scenario.loading import load_scenario, parse_scenario
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.shipped import shipped_scenarios
from tests.diagrams.six_arm import SIX_ARM, arm_text

GROUND_TRUTH = "perception=!GroundTruth {}"
WHOLE_ARM = ["inference=!Verified {}"]


def solids_seen(scenario: Scenario, seconds: float = 0.01) -> CollisionScene:
    diagram = build_avoidance(scenario)
    simulator = Simulator(diagram)
    simulator.AdvanceTo(seconds)
    geometries = diagram.GetSubsystemByName("collision_scene")
    context = geometries.GetMyContextFromRoot(simulator.get_context())
    return geometries.GetOutputPort("collision_scene_W").Eval(context)


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
    scene = solids_seen(among_a_carton(GROUND_TRUTH))
    assert {label.split("::")[0] for label in scene.labels} == {"table", "carton"}
    # Of what is not named as an obstacle the tool keeps what the links keep.
    assert (scene.geometries.layout[:, 5] == ENVIRONMENT).all()
    assert not caplog.text


def an_arm(tmp_path, old="", new="") -> Scenario:
    """An arm of six joints whose model has one text in place of another."""
    (tmp_path / "six.urdf").write_text(re.sub(old, new, arm_text(), flags=re.DOTALL))
    return parse_scenario(SIX_ARM, [GROUND_TRUTH], folder=tmp_path)


def test_a_link_without_shape_is_told_of_and_joints_without_limits_are_turned(tmp_path, caplog):
    def changed(found: re.Match) -> str:
        return {"t": 'type="continuous"', "l": "", "<": found[1] or ""}[found[0][0]]

    elbow = '(<link name="elbow">.*?)<collision>.*?</collision>'
    limits = f'{elbow}|type="revolute"|lower="-6.28" upper="6.28"'
    log = simulate(an_arm(tmp_path, limits, changed), duration=0.5)
    assert (
        "robot.model: no collision geometry of elbow: its clearance is not checked" in caplog.text
    )
    assert np.isfinite(log.q).all()
    assert np.linalg.norm(log.p_WE[-1] - log.p_WE[0]) > 0.01


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
inference: !Verified {}
"""


def test_it_waits_for_what_leaves_no_way_and_goes_on_when_that_leaves():
    log = simulate(parse_scenario(CRATE), duration=1.0)
    held = np.array([cause == HoldReason.OBSTACLES for cause in log.event_hold])
    assert any("would touch obstacle" in event for event in log.event)
    assert held.any()
    speed = np.linalg.norm(np.gradient(log.p_WE, log.t, axis=0), axis=1)
    assert speed[log.t < 0.4].max() < 0.02
    assert speed[log.t > 0.6].max() > 0.02


def test_a_motion_ends_when_it_has_arrived_not_before() -> None:
    # A stiff spring overcomes a coarse forcing term after s = 1 and a slow phase does not fade.
    empty = "perception=!GivenEllipsoids {}"
    late = simulate(load_scenario("free_space", ["policy.n_basis=5", empty]))
    assert (late.stop_reason, late.inference) == ("goal", "Paper")
    assert 1.0 < -math.log(late.phase[late.moving][-1]) / math.log(100.0) < MAX_NORMALIZED_TIME
    assert np.linalg.norm(late.desired_position[-1] - [1.0, 0.0, 0.0]) < 1e-3
    slow = simulate(load_scenario("free_space", ["policy.n_basis=4", "policy.alpha_k=2.0", empty]))
    assert -math.log(slow.phase[slow.moving][-1]) / 2.0 == pytest.approx(
        MAX_NORMALIZED_TIME, abs=0.02
    )
    left = slow.desired_position[slow.moving][-1] - [1.0, 0.0, 0.0]
    error = 1e3 * float(np.linalg.norm(left))
    assert error > 1.0
    reason = re.fullmatch(r"goal missed by (\d+\.\d) mm at s = 2\.2", slow.stop_reason)
    assert reason
    assert float(reason[1]) == pytest.approx(error, rel=0.05)
