"""A recording's page says what it shows: a title, a legend, and time, clearance and state."""

from __future__ import annotations

import html
import json

import numpy as np

from drake_oa.robot.plant import make_robot_plant
from drake_oa.runs.metrics import RobotJudge
from drake_oa.runs.motion_log import MotionLog
from drake_oa.scenario.scenario import Scenario
from drake_oa.viewing import drawing

_PERIOD = 0.1
"""Time between two readings [s]."""
_LEGEND = (
    (drawing.PLANNED, "planned path"),
    (drawing.EXECUTED, "executed path"),
    (drawing.CHOSEN, "the side that was chosen; the rings are what each side costs"),
)
_PAGE = """
<style>
  #drake-oa { position: fixed; left: 12px; bottom: 12px; font: 14px/1.5 sans-serif; color: #222;
    background: rgba(255, 255, 255, 0.8); padding: 8px 12px; border-radius: 6px;
    pointer-events: none; max-width: 30em; }
  #drake-oa i { display: inline-block; width: 22px; height: 5px; margin-right: 8px;
    vertical-align: middle; }
  #drake-oa-now { font-weight: bold; }
</style>
<div id="drake-oa"><b>TITLE</b><div id="drake-oa-now"></div>LEGEND</div>
<script>
  const drakeOa = READINGS;
  setInterval(() => {
    const time = viewer.animator ? viewer.animator.time : 0.0;
    let row = 0;
    while (row + 1 < drakeOa.length && drakeOa[row + 1][0] <= time + 1e-6) row += 1;
    document.getElementById("drake-oa-now").textContent = drakeOa[row][1];
  }, 50);
</script>
</body>"""


def label_page(
    page: str, name: str, scenario: Scenario, log: MotionLog, *, speed: float = 1.0
) -> str:
    """Adds title, legend and readings to the page of a recording.

    Args:
        page: HTML of a viewer after `drake_oa.viewing.viewer.recording`.
        name: of the scenario.
        scenario: what the log was made from.
        log: the motion that the page shows.
        speed: how much faster it is shown than it was.
    """
    title = html.escape(f"{name}: {scenario.description}".removesuffix(": "))
    legend = "".join(
        f'<div><i style="background: rgb{tuple(round(255 * c) for c in color)}"></i>{text}</div>'
        for color, text in _LEGEND
    )
    page = page.replace("<title>Drake MeshCat</title>", f"<title>{title}</title>", 1)
    # A "<" could end the script.
    rows = json.dumps(readings(scenario, log, speed=speed)).replace("<", "\\u003c")
    label = _PAGE.replace("TITLE", title).replace("LEGEND", legend).replace("READINGS", rows)
    head, _, tail = page.rpartition("</body>")
    return head + label + tail


def readings(scenario: Scenario, log: MotionLog, *, speed: float = 1.0) -> list[tuple[float, str]]:
    """Rows of time in the recording [s] and what is read then; one at least."""
    if not len(log.t):
        return [(0.0, "")]
    times = np.arange(0.0, log.t[-1] + _PERIOD, _PERIOD)
    rows = np.minimum(np.searchsorted(log.t, times), len(log.t) - 1)
    kept = np.full(len(rows), np.inf)
    if (
        scenario.robot is not None
        and log.q.shape[1] == make_robot_plant(scenario.robot).plant.num_positions()
    ):
        worlds = log.q_world[rows] if log.q_world.shape[1] else None
        kept = RobotJudge(scenario).metrics(log.q[rows], worlds).tool_clearance
    found = []
    for row, clearance in zip(rows, kept, strict=True):
        now = float(log.t[row])
        said = f"t = {now:.1f} s"
        if np.isfinite(clearance):
            said += f", tool clearance {clearance:.3f} m of {scenario.task.clearance:g} m asked"
        said += "".join(f", {word}" for word in [_state(log, now)] if word)
        found.append((round(now / speed, 3), said))
    return found


def _state(log: MotionLog, now: float) -> str:
    """What the supervisor does then and why, or what holds the motion; empty: nothing does."""
    row = int(np.searchsorted(log.supervision_time, now, side="right")) - 1
    if row >= 0 and log.supervision_action[row] != "run":
        return f"supervisor: {log.supervision_action[row]}, {log.supervision_reason[row]}"
    row = int(np.searchsorted(log.event_time, now, side="right")) - 1
    return log.event[row] if row >= 0 else ""
