"""A scene is its kind's, seed's and index's for ever, and what was dropped for it is counted."""

import dataclasses
import hashlib
import json

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder

from drake_oa.perception.config import DepthCamera, GroundTruth
from drake_oa.scenario.loading import parse_scenario, scenario_text
from drake_oa.studies.panda.scenes import draw_panda_scene
from drake_oa.studies.results import Tally
from drake_oa.world.station import make_station

_DIGESTS = {
    "tabletop": "0d7868a80228",
    "moving": "d10e717e8fdd",
    "elbow": "a4283f503dec",
    "clutter6": "1d3045b732f9",
    "moving_hard": "09f89c8d4c8e",
}
"""Of scene 0 of seed 0 of each kind."""


def digest(scenario):
    things = [dataclasses.asdict(item) for item in scenario.obstacles]
    told = json.dumps([things, scenario.task.start, scenario.task.goal, scenario.seed])
    rounded = json.loads(told, parse_float=lambda number: f"{float(number):.6f}")
    return hashlib.sha256(json.dumps(rounded).encode()).hexdigest()[:12]


@pytest.mark.parametrize("kind", _DIGESTS)
def test_a_seed_gives_the_scenes_that_it_always_gave(kind):
    scene = draw_panda_scene(0, 0, kind=kind)
    assert digest(scene) == _DIGESTS[kind]
    text = scenario_text(scene)
    assert scenario_text(parse_scenario(text)) == text


def test_perception_changes_nothing_else():
    seen = draw_panda_scene(1, 0)
    truth = draw_panda_scene(1, 0, perception="truth")
    assert isinstance(truth.perception, GroundTruth)
    assert isinstance(seen.perception, DepthCamera)
    assert (truth.obstacles, truth.task, truth.seed) == (seen.obstacles, seen.task, seen.seed)
    other = draw_panda_scene(1, 1)
    assert other.task != seen.task
    assert other.seed != seen.seed


def test_a_second_camera_stands_opposite_to_the_first():
    one, two = (draw_panda_scene(1, 0, perception=name) for name in ("depth", "depth2"))
    assert (one.obstacles, one.task, one.seed) == (two.obstacles, two.task, two.seed)
    assert two.perception.names == ("camera", "opposite")
    assert two.perception.noise == one.perception.noise
    text = scenario_text(two)
    assert scenario_text(parse_scenario(text)) == text
    builder = DiagramBuilder()
    for camera in two.cameras:
        camera.output_delay = 0.0
    cameras = make_station(builder, two).cameras
    context = builder.Build().CreateDefaultContext()
    places = {
        name: camera.pose.Eval(camera.pose.get_system().GetMyContextFromRoot(context))
        for name, camera in cameras.items()
    }
    middle = 0.5 * (places["camera"].translation() + places["opposite"].translation())
    np.testing.assert_allclose(middle[:2], [0.45, 0.0], atol=1e-3)
    np.testing.assert_allclose(
        places["camera"].rotation().matrix()[:, 2] * [-1.0, -1.0, 1.0],
        places["opposite"].rotation().matrix()[:, 2],
        atol=1e-9,
    )


def test_scenes_that_are_looked_at_are_taken_or_dropped_for_a_reason():
    tally = Tally()
    draw_panda_scene(0, 1, tally=tally)
    scenes = tally.counts["scenes"]
    assert scenes[""] == 1
    assert scenes.keys() - {""} <= {
        "the planned motion is clear",
        "the planned motion touches the table",
        "the arm cannot follow the straight line",
        "start or goal leave the robot less than 5 cm",
    }
    again = Tally()
    draw_panda_scene(0, 1, tally=again)
    assert again.counts == tally.counts
    pairs = tally.counts["pairs of start and goal"]
    assert pairs[""] == sum(scenes.values())
