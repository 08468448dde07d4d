"""Panel beside the picture of Meshcat, in recordings and live pages: title, readings, legend."""

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

_LATE = 0.15
"""Time that a frame may be sent before the page has drawn the previous one [s]."""
_GONE = 10.0
"""A page that has not asked for so long holds nobody back [s]."""
_FRAME = "/drake_oa_frame"
"""Node of the scene whose render order is the number of the last frame sent."""


class Reading(NamedTuple):
    """Text of the panel at one instant: time in the page [s], lines, and what is wrong."""

    time: float
    text: str
    alert: str = ""


def _css(color: drawing.Color) -> str:
    return f"rgb{tuple(round(255 * part) for part in color)}"


_LEGEND = (
    (_css(drawing.PLANNED), "planned path", "motion/planned/path"),
    (_css(drawing.EXECUTED), "executed path", "motion/executed"),
    (_css(drawing.CHOSEN), "chosen side", "decision/.*/direction"),
    (
        f"linear-gradient(to right, {', '.join(map(_css, drawing.COST_COLORS))})",
        "cost of a side, 0 to 1; rings from inside: ",
        "decision/.*/rings/.*/.*",
    ),
    (_css(drawing.ELLIPSOID), "ellipsoid of an obstacle", "descriptor/.*/ellipsoid"),
    ("#777", "points that a camera sees", "perception/cloud"),
)
"""Color, text and path in the scene of what may be drawn; shown while it is visible there."""
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
_PANEL = Template("""
<div id="drake-oa"><b>$title</b> <span>$description</span><div id="drake-oa-now"></div>
<div id="drake-oa-alert"></div>$legend</div>
<script>
  // The key of what is visible under a node along a path of patterns, or nothing.
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
_RECORDED = Template("""
  const drakeOa = $readings;
  setInterval(() => {
    const time = viewer.animator ? viewer.animator.time : 0.0;
    let row = 0;
    while (row + 1 < drakeOa.length && drakeOa[row + 1][0] <= time + 1e-6) row += 1;
    drakeOaShow(drakeOa[row]);
  }, 50);""")
_LIVE = """
  let drakeOaAsked = 0;
  function drakeOaAsk(now) {
    requestAnimationFrame(drakeOaAsk);
    if (now < drakeOaAsked) return;
    drakeOaAsked = now + 2000;  // Until the answer.
    const frame = viewer.scene_tree.children["drake_oa_frame"];
    const drawn = frame ? frame.object.renderOrder : 0;
    fetch(`${location.origin}/reading/${drawn}`).then((answer) => answer.json())
      .then(drakeOaShow).then(() => drakeOaAsked = now + 30, () => {});
  }
  requestAnimationFrame(drakeOaAsk);
  function drakeOaHidden() {
    // Nothing is drawn in a page that is hidden or closed, so that all counts as drawn.
    if (document.hidden) fetch(`${location.origin}/reading/Infinity`, {keepalive: true});
  }
  document.addEventListener("visibilitychange", drakeOaHidden);
  drakeOaHidden();"""
_FOLDERS = """
    // A control called "FOLDER: NAME" is in a folder; the first one opens the panel.
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


def panel_page(page: str, title: str, description: str, readings: list[Reading] | None) -> str:
    """Adds the panel to a page of Meshcat.

    Args:
        page: HTML of Meshcat, a recording or its live page.
        title: of the panel and the window.
        description: text behind the title.
        readings: rows by time, one at least; None: the page asks its server for them.
    """
    title, description = html.escape(title), html.escape(description)
    legend = "".join(
        f'<div hidden data-path="{path}"><i style="background: {color}"></i>{text}'
        "<span></span></div>"
        for color, text, path in _LEGEND
    )
    script = _LIVE
    if readings is not None:
        # A "<" could end the script.
        rows = json.dumps(readings).replace("<", "\\u003c")
        script = _RECORDED.safe_substitute(readings=rows)
    panel = _PANEL.safe_substitute(
        title=title, description=description, legend=legend, script=script
    )
    page = page.replace("<title>Drake MeshCat</title>", f"<title>{title}</title>", 1)
    head, _, tail = page.rpartition("</body>")
    return head + _STYLE + panel + tail


def _live_page(meshcat: Meshcat, title: str, description: str) -> str:
    """Fetches Meshcat's page; its script and messages come from where Meshcat serves them."""
    # A proxy of the environment does not reach this machine's own ports.
    with build_opener(ProxyHandler({})).open(meshcat.web_url()) as answer:
        page: str = answer.read().decode()
    page = page.replace("<head>", f'<head><base href="{meshcat.web_url()}/">', 1)
    address = f"{_FOLDERS}    url = {json.dumps(meshcat.ws_url())};"
    page = page.replace("    url = location.toString();", address, 1)
    return panel_page(page, title, description, None)


class _PageServer(ThreadingHTTPServer):
    """Serves a page that may be closed at any time."""

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Prints what went wrong, unless the page was closed."""
        if not isinstance(sys.exc_info()[1], ConnectionError):
            super().handle_error(request, client_address)


class LivePage:
    """Meshcat's live page with the panel, served to this machine only.

    The page says which frame it has drawn whenever it asks for the reading. `pace` holds back
    whoever draws until the previous frame is drawn, so that the page stays less than half a
    second behind; a page that is hidden or closed holds nobody back.

    Attributes:
        url: where it is.
        reading: what the panel shows.
    """

    def __init__(self, meshcat: Meshcat, title: str, description: str = "") -> None:
        """Starts the server.

        Args:
            meshcat: the viewer.
            title: of the panel.
            description: text behind the title.
        """
        self.reading = Reading(0.0, "")
        self._meshcat = meshcat
        self._frame, self._drawn = 0, 0.0
        self._sent = self._asked = -_GONE
        live, page = self, _live_page(meshcat, title, description)

        class Handler(BaseHTTPRequestHandler):
            """Answers with the page, or with the reading."""

            def do_GET(self) -> None:
                kind, body = "application/json", json.dumps(live.reading)
                if self.path.startswith("/reading/"):
                    live._drawn = float(self.path.rpartition("/")[2])
                    live._asked = time.monotonic()
                else:
                    kind, body = "text/html", page
                self.send_response(200)
                self.send_header("Content-Type", f"{kind}; charset=utf-8")
                self.end_headers()
                self.wfile.write(body.encode())

            def log_message(self, *_: object) -> None:
                """Logs nothing."""

        try:
            # The same address run after run, where it is free.
            self._server = _PageServer(("localhost", meshcat.port() + 1000), Handler)
        except OSError:
            self._server = _PageServer(("localhost", 0), Handler)
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        self.url = f"http://localhost:{self._server.server_port}"

    def pace(self) -> None:
        """Ends a frame; waits while the page has not drawn the previous one for too long."""
        while self._drawn < self._frame:
            now = time.monotonic()
            if now - self._sent < _LATE or now - self._asked > _GONE:
                return
            time.sleep(0.005)
        self._frame += 1
        self._sent = time.monotonic()
        self._meshcat.SetProperty(_FRAME, "renderOrder", float(self._frame))

    def close(self) -> None:
        """Ends the server."""
        self._server.shutdown()
        self._server.server_close()
