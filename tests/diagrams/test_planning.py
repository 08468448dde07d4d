"""Tests of verified motions of the whole arm in the diagram: collision scene, holds, ends."""

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
from tests.diagrams.six_arm import six_scenario

GROUND_TRUTH = "perception=!GroundTruth {}"
WHOLE_ARM = ["inference=!Verified {}"]


def collision_scene(scenario: Scenario, seconds: float = 0.01) -> CollisionScene:
    """Returns the collision scene of a diagram after a time [s]."""
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


def with_carton(*lines: str) -> Scenario:
    """Returns `tabletop_box` with a carton that is not named as an obstacle in place of its box."""
    name = "directives:\n- add_directives:\n    file: package://drake_oa/scenes/tabletop_box.dmd.yaml\n"
    text = shipped_scenarios()["tabletop_box"].read_text()
    assert name in text
    return parse_scenario(text.replace(name, CARTON.lstrip()), [*WHOLE_ARM, *lines])


def test_collision_scene_contains_models_of_any_name(caplog):
    scene = collision_scene(with_carton(GROUND_TRUTH))
    assert {label.split("::")[0] for label in scene.labels} == {"table", "carton"}
    # For the environment, the clearance of the tool is that of the links.
    assert (scene.geometries.layout[:, 5] == ENVIRONMENT).all()
    assert not caplog.text


def test_link_without_geometry_is_logged_and_joints_without_limits_move(tmp_path, caplog):
    def changed(match: re.Match) -> str:
        return {"t": 'type="continuous"', "l": "", "<": match[1] or ""}[match[0][0]]

    elbow = '(<link name="elbow">.*?)<collision>.*?</collision>'
    limits = f'{elbow}|type="revolute"|lower="-6.28" upper="6.28"'
    log = simulate(six_scenario(tmp_path, limits, changed), duration=0.5)
    unchecked = "robot.model: no collision geometry of elbow: its clearance is not checked"
    assert unchecked in caplog.text
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


def test_motion_is_held_while_no_path_exists_and_resumes_afterwards():
    log = simulate(parse_scenario(CRATE), duration=1.0)
    held = np.array([cause == HoldReason.OBSTACLES for cause in log.event_hold])
    assert any("would touch obstacle" in event for event in log.event)
    assert held.any()
    speed = np.linalg.norm(np.gradient(log.p_WE, log.t, axis=0), axis=1)
    assert speed[log.t < 0.4].max() < 0.02
    assert speed[log.t > 0.6].max() > 0.02


def test_motion_ends_on_arrival_or_at_the_latest_end() -> None:
    # A stiff spring overcomes a coarse forcing term after s = 1 and a slow phase does not fade.
    empty = "perception=!GivenEllipsoids {}"
    late = simulate(load_scenario("free_space", ["policy.n_basis=5", empty]))
    assert (late.stop_reason, late.inference) == ("goal", "Paper")
    assert 1.0 < -math.log(late.phase[late.moving][-1]) / math.log(100.0) < MAX_NORMALIZED_TIME
    assert np.linalg.norm(late.desired_position[-1] - [1.0, 0.0, 0.0]) < 1e-3
    slow = simulate(load_scenario("free_space", ["policy.n_basis=4", "policy.alpha_k=2.0", empty]))
    end = -math.log(slow.phase[slow.moving][-1]) / 2.0
    assert end == pytest.approx(MAX_NORMALIZED_TIME, abs=0.02)
    error = 1e3 * math.dist(slow.desired_position[slow.moving][-1], [1.0, 0.0, 0.0])
    assert error > 1.0
    reason = re.fullmatch(r"goal missed by (\d+\.\d) mm at s = 2\.2", slow.stop_reason)
    assert reason
    assert float(reason[1]) == pytest.approx(error, rel=0.05)
