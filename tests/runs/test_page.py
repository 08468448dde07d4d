"""Panel of recordings and live pages."""

import json
import re
import time
from dataclasses import replace
from threading import Timer
from urllib.request import urlopen

import pytest
from pydrake.geometry import Meshcat

from drake_oa.runs.motion_log import MotionLog
from drake_oa.runs.page import LivePanel, label_page, readings
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import parse_scenario
from drake_oa.viewing.panel import LivePage
from drake_oa.viewing.viewer import open_page, start_viewer

TEXT = """
description: A ball < a box
task: {start: [0.45, -0.2, 0.3], goal: [0.45, 0.2, 0.3], duration: 1.0, clearance: 0.05}
perception: !GroundTruth {}
obstacles: [{name: ball, shapes: [!Sphere {radius: 0.05}], translation: [0.6, 0.0, 0.2]}]
"""
SCENARIO = parse_scenario(TEXT)
PAGE = "<html><head><title>Drake MeshCat</title></head><body><p>scene</p></body></html>"
CLEARANCE = r"t = 0\.[123] s\navoiding motion: verified, obstacles from ground truth\n" + (
    r"(motion source: \w+\n)?tool: clearance 0\.\d+ m \(min 0\.\d+, requested 0\.05\)\n"
    r"whole arm: clearance 0\.\d+ m \(min 0\.\d+, requested 0\.03\)\n"
)


def get(page: LivePage, path: str) -> str:
    """Returns the response of the page's server to a path."""
    with urlopen(page.url + path) as answer:
        text: str = answer.read().decode()
    return text


@pytest.fixture(scope="module")
def viewer() -> Meshcat:
    """Viewer without a browser."""
    return start_viewer(browser=False)


@pytest.fixture
def page(viewer: Meshcat) -> LivePage:
    """Live page of the viewer."""
    return open_page(viewer, "mine: avoiding motion", SCENARIO.description)


@pytest.fixture(scope="module")
def simulated(viewer: Meshcat) -> tuple[MotionLog, str]:
    """Log of a motion of 0.3 s, and the last reading of its live page."""
    page = open_page(viewer, "mine", "")
    log = simulate(SCENARIO, duration=0.3, on_step=LivePanel(page, SCENARIO))
    text: str = json.loads(get(page, "/reading/0"))[1]
    return log, text


def test_live_pages_and_recordings_have_the_same_panel(
    simulated: tuple[MotionLog, str], page: LivePage, viewer: Meshcat
) -> None:
    log, live = simulated
    assert viewer.ws_url() in get(page, "/")
    recorded = label_page(PAGE, "mine", SCENARIO, log)
    for text in (recorded, get(page, "/")):
        assert "<title>mine: avoiding motion</title>" in text
        assert "A ball &lt; a box" in text
        assert text.index("<body>") < text.index("nominal path") < text.index("</body>")
    assert recorded.index("<p>scene</p>") < recorded.index("nominal path")
    rows = readings(SCENARIO, log)
    assert [row.time for row in rows[:2]] == [0.0, 0.1]
    for text in (rows[-1].text, live):
        assert re.match(CLEARANCE, text)
    with_hold = replace(
        log, supervision_time=[0.05], supervision_action=["hold"], supervision_reason=["x"]
    )
    texts = [row.text for row in readings(SCENARIO, with_hold)]
    assert "motion guard" not in texts[0]
    assert texts[1].endswith("motion guard: hold, x")


def test_the_page_names_a_motion_without_avoidance_and_its_contacts(
    simulated: tuple[MotionLog, str],
) -> None:
    scenario = parse_scenario(TEXT.replace("[0.6, 0.0, 0.2]", "[0.45, -0.2, 0.3]"))
    text = label_page(PAGE, "mine", scenario, replace(simulated[0], avoid_obstacles=False))
    assert "<title>mine: nominal motion (without avoidance)</title>" in text
    assert re.search(r'"contact: panda_\w+ - obstacle_ball', text)


def test_frame_waits_until_the_page_has_drawn_the_previous_one(page: LivePage) -> None:
    page.pace()
    get(page, "/reading/0")
    time.sleep(0.2)
    requests: list[str] = []

    def request() -> None:
        requests.append("/reading/1")
        get(page, requests[0])

    timer = Timer(0.2, request)
    timer.start()
    page.pace()
    assert requests
    timer.join()
