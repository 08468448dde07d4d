"""What a recording's page says."""

import re
from dataclasses import replace

from drake_oa.runs.page import label_page, readings
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import parse_scenario

TEXT = """
description: A ball < a box
task: {start: [0.45, -0.2, 0.3], goal: [0.45, 0.2, 0.3], duration: 1.0, clearance: 0.05}
perception: !GroundTruth {}
obstacles: [{name: ball, shapes: [!Sphere {radius: 0.05}], translation: [0.6, 0.0, 0.2]}]
"""
PAGE = "<html><head><title>Drake MeshCat</title></head><body><p>scene</p></body></html>"


def test_a_page_is_labelled() -> None:
    scenario = parse_scenario(TEXT)
    log = simulate(scenario, duration=0.3)
    text = label_page(PAGE, "mine", scenario, log, speed=2.0)
    assert "<title>mine: A ball &lt; a box</title>" in text
    assert text.index("<p>scene</p>") < text.index("planned path") < text.index("</body></html>")
    assert re.search(r"t = 0\.1 s, tool clearance 0\.\d+ m of 0\.05 m asked", text)
    held = replace(
        log, supervision_time=[0.05], supervision_action=["hold"], supervision_reason=["x"]
    )
    times, said = zip(*readings(scenario, held, speed=2.0), strict=True)
    assert times[:2] == (0.0, 0.05)
    assert "supervisor" not in said[0]
    assert said[1].endswith("supervisor: hold, x")
