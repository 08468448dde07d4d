"""Unseen share of scenarios."""

import pytest

from drake_oa.runs.camera_placement import view_note
from drake_oa.scenario.loading import load_scenario


@pytest.mark.parametrize(
    ("name", "overrides", "begin"),
    [
        ("moving_obstacle", [], "cameras: 1"),
        ("tabletop_box", [], "cameras: "),
        ("tabletop_box", ["perception=!GroundTruth {}"], ""),
    ],
)
def test_the_unseen_share_of_the_space_near_the_arm_is_told(name, overrides, begin):
    note = view_note(load_scenario(name, overrides))
    assert note.startswith(begin)
    assert note.endswith("% of the space within 0.4 m of the arm is unseen" if begin else "")
