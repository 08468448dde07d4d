"""`drake-oa play` in a real browser: its controls move the arm."""

import re
import time

import pytest

from tests.browser import PROGRAM, Browser
from tests.runs.test_play import SCENARIO, play, ticks


@pytest.mark.slow
@pytest.mark.skipif(PROGRAM is None, reason="there is no chromium")
def test_slider_in_the_browser_moves_the_arm() -> None:
    session = play(SCENARIO, "A post.")

    def move(name: str, value: float) -> None:
        """Moves a slider, and waits for the message of the page, which another thread receives."""
        page.evaluate(f"viewer.gui_controllers['{name}'].setValue({value}), 0")
        deadline = time.monotonic() + 60.0
        while abs(session.meshcat.GetSliderValue(name) - value) > 1e-6:
            assert time.monotonic() < deadline, name
            time.sleep(0.05)

    with Browser(session.page.url) as page:
        page.wait_for("'post: y [m]' in viewer.gui_controllers")
        ticks(session, 0.3)
        move("post: y [m]", 0.4)
        ticks(session, 0.6)
        assert list(session.logs) == ["leg_1"]
        move("goal z [m]", 0.45)
        while not session.is_returning:
            session.tick()
        assert session.tool_point()[2] == pytest.approx(0.45, abs=5e-3)
        page.wait_for("'post' in viewer.gui.__folders")
        controls = page.evaluate("Object.keys(viewer.gui_controllers)")
        assert controls.index("stop") < controls.index("speed") < controls.index("post: x [m]")
        # The motion back starts without an executed path.
        ticks(session, 0.5)
        panel = "document.getElementById('drake-oa').innerText"
        page.wait_for(f"{panel}.includes('executed path')")
        text = page.evaluate(panel)
        assert re.search(r"played A post.\nt = .*\ntool: clearance 0", text, re.DOTALL)
    session.finish()
