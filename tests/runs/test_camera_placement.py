"""Unobserved fraction of the space near the arm, and suggested camera poses."""

import re

import numpy as np
import pytest
from pydrake.common.schema import Transform
from pydrake.systems.analysis import Simulator

from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.runs.camera_placement import (
    MAX_UNOBSERVED_FRACTION,
    camera_pose_around,
    observed_free_space,
    unobserved_near_arm,
    view_note,
)
from drake_oa.scenario.loading import load_scenario, parse_scenario, scenario_text
from drake_oa.world.delayed_camera import Rendered


def test_cameras_of_a_moving_scenario_observe_most_of_the_space():
    scenario = load_scenario("moving_obstacle")
    above = unobserved_near_arm(scenario)
    assert f" {above:.0%} of the space within 0.4 m of the arm " in view_note(scenario)
    assert 0.02 < above < 0.15
    # Behind most of the space that a camera observes from the front, no surface is in its range.
    scenario.cameras[0].X_PB = Transform(camera_pose_around(np.r_[0.4, 0.0, 0.3], 0.0, 0.6, 2.1))
    assert unobserved_near_arm(scenario) > 3.0 * above


@pytest.mark.parametrize("noise", ["null", "{}"])
def test_free_space_of_an_image_is_that_of_perception(noise):
    scenario = load_scenario("tabletop_box", [f"perception.noise={noise}"])
    simulator = Simulator(build_avoidance(scenario))
    simulator.Initialize()

    def value(name, port):
        system = simulator.get_system().GetSubsystemByName(name)
        return system.GetOutputPort(port).Eval(system.GetMyContextFromRoot(simulator.get_context()))

    image, X_WC = (value("delayed_camera", port) for port in ("depth_image", "camera_pose"))
    rendered = Rendered(image.data[:, :, 0], X_WC)
    space = observed_free_space(scenario.perception, scenario.cameras, [rendered])
    places = np.random.default_rng(0).uniform([-0.2, -0.7, 0.0], [1.0, 0.7, 1.0], (5000, 3))
    is_free = value("perception", "free_space_W").contains(places)
    assert 0.2 < is_free.mean() < 0.9
    np.testing.assert_array_equal(space.contains(places), is_free)


def test_view_note_is_empty_without_cameras():
    assert view_note(load_scenario("tabletop_box", ["perception=!GroundTruth {}"])) == ""


def test_suggested_camera_pose_has_the_stated_unobserved_fraction():
    scenario = load_scenario("tabletop_box")
    note = view_note(scenario)
    before, after = (int(share) / 100 for share in re.findall(r"(\d+)%", note))
    assert before == pytest.approx(unobserved_near_arm(scenario), abs=0.005)
    assert after < MAX_UNOBSERVED_FRACTION < before
    pose = re.search(r"X_PB: (\{.*\}) and segmentation", note)
    text = scenario_text(scenario).replace("far: 2.5", "far: 3.5")
    begin, end = text.index("  X_PB:"), text.index("  background:")
    moved = parse_scenario(f"{text[:begin]}  X_PB: {pose[1]}\n{text[end:]}")
    assert unobserved_near_arm(moved) == pytest.approx(after, abs=0.01)
