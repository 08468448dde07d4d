"""What the generators of scenes drop is counted, and counting changes no scene."""

import dataclasses
import hashlib
import json

import pytest

from drake_oa.studies.panda.scenes import draw_panda_scene
from drake_oa.studies.tally import Tally, drawn_figures, drawn_lines

_DIGESTS = {
    "tabletop": "0d7868a80228",
    "moving": "d10e717e8fdd",
    "elbow": "a4283f503dec",
    "clutter6": "1d3045b732f9",
}
"""Of scene 0 of seed 0 of each kind."""


def digest(scenario):
    things = [dataclasses.asdict(item) for item in scenario.obstacles]
    told = json.dumps([things, scenario.task.start, scenario.task.goal, scenario.seed])
    rounded = json.loads(told, parse_float=lambda number: f"{float(number):.6f}")
    return hashlib.sha256(json.dumps(rounded).encode()).hexdigest()[:12]


@pytest.mark.parametrize("kind", _DIGESTS)
def test_a_seed_gives_the_scenes_that_it_always_gave(kind):
    assert digest(draw_panda_scene(0, 0, kind=kind)) == _DIGESTS[kind]


def test_shares_are_of_all_scenes_the_greatest_first():
    one, other = Tally(), Tally()
    assert one.takes("courses", "")
    assert not one.takes("courses", "too high")
    for reason in ("", "too low", "too low"):
        other.takes("courses", reason)
    other.takes("scenes", "")
    drawn = drawn_figures([one.counts, other.counts])
    assert drawn == {
        "courses": {"looked_at": 5, "dropped": {"too low": 0.4, "too high": 0.2}},
        "scenes": {"looked_at": 1, "dropped": {}},
    }
    assert list(drawn["courses"]["dropped"]) == ["too low", "too high"]
    assert drawn_lines(drawn) == [
        "courses looked at: 5; dropped: 40.0% (too low), 20.0% (too high)",
        "scenes looked at: 1; dropped: none",
    ]


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
