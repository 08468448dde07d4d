"""Panel with title, readings and legend, which is added to the HTML page of Meshcat: to a
recording, or to the live page.
"""

from __future__ import annotations

import html
import json
import sys
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from string import Template
from typing import Any, NamedTuple
from urllib.request import ProxyHandler, build_opener

from pydrake.geometry import Meshcat

from drake_oa.viewing import drawing

_MAX_LAG = 0.15
"""Time within which a live page should draw a frame; if drawing lasts longer, the simulation waits
before the next frame [s]."""
_PAGE_TIMEOUT = 10.0
"""Time without a request from a live page after which the page counts as closed, so that the
simulation no longer waits for it [s]."""
_FRAME = "/drake_oa_frame"
"""Path of an empty node in Meshcat's scene tree. Its property `renderOrder` carries the number of
the last frame that was sent to a live page."""


class Reading(NamedTuple):
    """Text of the panel's readings from one time of the run on, with a warning if there is one.

    Attributes:
        time: simulated time from which the text is displayed [s].
        text: lines of the panel's readings.
        alert: warning that is displayed in red; empty: no warning.
    """

    time: float
    text: str
    alert: str = ""


def _css(color: drawing.Color) -> str:
    """Returns a color as CSS text, for the style of the panel's legend."""
    return f"rgb{tuple(round(255 * part) for part in color)}"


_LEGEND = (
    (_css(drawing.NOMINAL), "nominal path", "motion/nominal/path"),
    (_css(drawing.EXECUTED), "executed path", "motion/executed"),
    (_css(drawing.SELECTED), "selected side", "decision/.*/direction"),
    (
        f"linear-gradient(to right, {', '.join(map(_css, drawing.COST_COLORS))})",
        "cost of a side, 0 to 1; rings from inside: ",
        "decision/.*/rings/.*/.*",
    ),
    (_css(drawing.ELLIPSOID), "ellipsoid of an obstacle", "descriptor/.*/ellipsoid"),
    ("#777", "observed points", "perception/cloud"),
)
"""Rows of the panel's legend: CSS color, text, and path in Meshcat's scene tree, in which each part
is a regular expression. A row is displayed while an object at a matching path is visible."""
_STYLE = """
<style>
  body { overflow: hidden; }
  #drake-oa { position: fixed; left: 12px; bottom: 12px; font: 13px/1.4 sans-serif; color: #222;
    background: rgba(255, 255, 255, 0.85); padding: 8px 12px; border-radius: 6px;
    pointer-events: none; max-width: min(30em, 45vw); overflow-wrap: break-word; }
  #drake-oa i { display: inline-block; width: 22px; height: 5px; margin-right: 8px;
    vertical-align: middle; }
  #drake-oa-now { white-space: pre-line; }
  #drake-oa-alert { color: #b00; font-weight: bold; white-space: pre-line; }
  .dg.main { max-height: 100vh; overflow: hidden auto !important; }
</style>"""
"""HTML element with the CSS style of the panel on Meshcat's page."""
_PANEL = Template("""
<div id="drake-oa"><b>$title</b> <span>$description</span><div id="drake-oa-now"></div>
<div id="drake-oa-alert"></div>$legend</div>
<script>
  // Name of a visible node at a path of patterns below a node; undefined if none is visible.
  function drakeOaShown(node, path, key) {
    if (!node || !node.object.visible) return undefined;
    if (!path.length && "<object>" in node.children) return key;
    for (const [name, child] of Object.entries(node.children)) {
      if (path.length && !RegExp(`^(${path[0]})$`).test(name)) continue;
      const found = drakeOaShown(child, path.slice(1), path.length ? name : key);
      if (found !== undefined) return found;
    }
  }
  function drakeOaShow([time, text, alert]) {
    document.getElementById("drake-oa-now").textContent = text;
    document.getElementById("drake-oa-alert").textContent = alert;
    for (const row of document.querySelectorAll("#drake-oa [data-path]")) {
      const root = viewer.scene_tree.children["drake_oa"];
      const found = drakeOaShown(root, row.dataset.path.split("/"), "");
      row.hidden = found === undefined;
      row.lastChild.textContent = row.dataset.path.endsWith("/.*") ? found : "";
    }
  }
  $script
</script>
</body>""")
"""HTML template of the panel on Meshcat's page, with the JavaScript that updates the panel's
readings and legend."""
_RECORDED = Template("""
  const drakeOa = $readings;
  setInterval(() => {
    const time = viewer.animator ? viewer.animator.time : 0.0;
    let row = 0;
    while (row + 1 < drakeOa.length && drakeOa[row + 1][0] <= time + 1e-6) row += 1;
    drakeOaShow(drakeOa[row]);
  }, 50);""")
"""JavaScript template for the page of a recording, which displays the reading at the present time
of the playback."""
_LIVE = """
  let drakeOaAsked = 0;
  function drakeOaAsk(now) {
    requestAnimationFrame(drakeOaAsk);
    if (now < drakeOaAsked) return;
    drakeOaAsked = now + 2000;  // Timeout of the answer.
    const frame = viewer.scene_tree.children["drake_oa_frame"];
    const drawn = frame ? frame.object.renderOrder : 0;
    fetch(`${location.origin}/reading/${drawn}`).then((answer) => answer.json())
      .then(drakeOaShow).then(() => drakeOaAsked = now + 30, () => {});
  }
  requestAnimationFrame(drakeOaAsk);
  function drakeOaHidden() {
    // A hidden or closed page draws no frames: report all as drawn, so that the server continues.
    if (document.hidden) fetch(`${location.origin}/reading/Infinity`, {keepalive: true});
  }
  document.addEventListener("visibilitychange", drakeOaHidden);
  drakeOaHidden();"""
"""JavaScript of a live page, which requests readings from the server and reports the number of the
last drawn frame."""
_FOLDERS = """
    // A control named "FOLDER: NAME" is placed in a folder; the first control opens the panel.
    const drakeOaAdd = viewer.set_control.bind(viewer);
    viewer.set_control = (name, ...rest) => {
      const gui = viewer.gui, [folder, label] = name.split(": ");
      gui.width = 320;
      gui.open();
      gui.__folders["Scene"].close();
      if (label) viewer.gui = gui.__folders[folder] || gui.addFolder(folder);
      drakeOaAdd(name, ...rest);
      viewer.gui = gui;
      if (label) viewer.gui_controllers[name].name(label);
    };
"""
"""JavaScript of a live page, which places the sliders and buttons of Meshcat's control panel in
folders."""


def panel_page(page: str, title: str, description: str, readings: list[Reading] | None) -> str:
    """Adds the panel with title, readings and legend to a page of Meshcat, and returns its HTML.

    Args:
        page: HTML of a page of Meshcat, a recording or the live page.
        title: title of the panel and of the browser window.
        description: text that follows the title in the panel.
        readings: readings of a recording, at least one, ordered by time; None: a live page, which
            requests readings from its server.
    """
    title, description = html.escape(title), html.escape(description)
    legend = "".join(
        f'<div hidden data-path="{path}"><i style="background: {color}"></i>{text}'
        "<span></span></div>"
        for color, text, path in _LEGEND
    )
    script = _LIVE
    if readings is not None:
        # An unescaped "<" could end the script element.
        rows = json.dumps(readings).replace("<", "\\u003c")
        script = _RECORDED.safe_substitute(readings=rows)
    panel = _PANEL.safe_substitute(
        title=title, description=description, legend=legend, script=script
    )
    page = page.replace("<title>Drake MeshCat</title>", f"<title>{title}</title>", 1)
    head, _, tail = page.rpartition("</body>")
    return head + _STYLE + panel + tail


def _live_page(meshcat: Meshcat, title: str, description: str) -> str:
    """Returns the HTML of Meshcat's live page with the panel added.

    Scripts and messages of the page still come from Meshcat's server.

    Args:
        meshcat: Meshcat instance.
        title: title of the panel and of the browser window.
        description: text that follows the title in the panel.
    """
    # A proxy set in the environment cannot reach ports of this computer.
    with build_opener(ProxyHandler({})).open(meshcat.web_url()) as answer:
        page: str = answer.read().decode()
    page = page.replace("<head>", f'<head><base href="{meshcat.web_url()}/">', 1)
    address = f"{_FOLDERS}    url = {json.dumps(meshcat.ws_url())};"
    page = page.replace("    url = location.toString();", address, 1)
    return panel_page(page, title, description, None)


class _PageServer(ThreadingHTTPServer):
    """HTTP server of the live page, which prints no error when the browser closes a connection."""

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Prints an error of a request, unless the page has closed the connection."""
        if not isinstance(sys.exc_info()[1], ConnectionError):
            super().handle_error(request, client_address)


class LivePage:
    """Server of Meshcat's live page with the panel, reachable from this computer only.

    The page requests readings repeatedly; each request contains the number of the last frame that
    the page has drawn. The method `pace` lets the simulation wait until the previous frame is
    drawn, so that the page lags by less than half a second. The simulation does not wait for a
    hidden or closed page.

    Attributes:
        url: address of the page.
        reading: text that the panel displays at present; the user of this class sets it.
    """

    def __init__(self, meshcat: Meshcat, title: str, description: str = "") -> None:
        """Starts the server of the page in a background thread.

        Args:
            meshcat: Meshcat instance.
            title: title of the panel and of the browser window.
            description: text that follows the title in the panel.
        """
        self.reading = Reading(0.0, "")
        self._meshcat = meshcat
        self._frame, self._drawn_frame = 0, 0.0
        self._sent_time = self._request_time = -_PAGE_TIMEOUT
        live, page = self, _live_page(meshcat, title, description)

        class Handler(BaseHTTPRequestHandler):
            """Handler of HTTP requests to the live page's server, which returns the page or the
            present reading.
            """

            def do_GET(self) -> None:
                """Answers a GET request: returns the present reading as JSON for paths below
                /reading/, and the HTML page for other paths.
                """
                kind, body = "application/json", json.dumps(live.reading)
                if self.path.startswith("/reading/"):
                    live._drawn_frame = float(self.path.rpartition("/")[2])
                    live._request_time = time.monotonic()
                else:
                    kind, body = "text/html", page
                self.send_response(200)
                self.send_header("Content-Type", f"{kind}; charset=utf-8")
                self.end_headers()
                self.wfile.write(body.encode())

            def log_message(self, *_: object) -> None:
                """Suppresses the log line of each request."""

        try:
            # The same address in each run, if its port is free.
            self._server = _PageServer(("localhost", meshcat.port() + 1000), Handler)
        except OSError:
            self._server = _PageServer(("localhost", 0), Handler)
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        self.url = f"http://localhost:{self._server.server_port}"

    def pace(self) -> None:
        """Ends a frame of the live page; before that, waits if the page needs longer than
        `_MAX_LAG` to draw the previous frame.
        """
        while self._drawn_frame < self._frame:
            now = time.monotonic()
            if now - self._sent_time < _MAX_LAG or now - self._request_time > _PAGE_TIMEOUT:
                return
            time.sleep(0.005)
        self._frame += 1
        self._sent_time = time.monotonic()
        self._meshcat.SetProperty(_FRAME, "renderOrder", float(self._frame))

    def close(self) -> None:
        """Stops the server of the live page, so that the page is no longer available."""
        self._server.shutdown()
        self._server.server_close()
