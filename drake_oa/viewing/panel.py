"""Panel with title, readings and legend, which is added to the HTML page of Meshcat: to a
recording, or to the live page, which displays a simulation or a replay while it runs.

Readings are lines of text on the state of the run at one time.
"""

from __future__ import annotations

import html
import json
import sys
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
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
    """Text that the panel displays from one simulated time on, with a warning if there is one.

    Attributes:
        time: simulated time from which the text is displayed [s].
        text: lines on the state of the run, for example time, clearances and the reason for which
            the motion is held (stopped on its path).
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
"""Rows of the panel's legend: CSS color, text, and path in Meshcat's scene tree. Each name in the
path is a regular expression. A row is displayed while an object at a matching path is visible."""


def _resource(name: str) -> str:
    """Returns the text of a file in the folder of this module.

    - panel.html: template of the panel on Meshcat's page, with its style, and with the JavaScript
      that updates readings and legend.
    - panel_recorded.js: template of the JavaScript on the page of a recording, which displays the
      reading at the present time of the playback.
    - panel_live.js: JavaScript of a live page, which requests readings from the server and reports
      the number of the last drawn frame.
    - panel_folders.js: JavaScript of a live page, which places the sliders and buttons of Meshcat's
      control panel in folders.
    """
    return Path(__file__).with_name(name).read_text()


def panel_page(page: str, title: str, description: str, readings: list[Reading] | None) -> str:
    """Adds the panel with title, readings and legend to a page of Meshcat, and returns its HTML.

    Args:
        page: HTML of a page of Meshcat, a recording or the live page.
        title: title of the panel and of the browser window.
        description: text that follows the title in the panel.
        readings: texts of a recording, at least one, ordered by time; None: a live page, which
            requests readings from its server.
    """
    title, description = html.escape(title), html.escape(description)
    legend = "".join(
        f'<div hidden data-path="{path}"><i style="background: {color}"></i>{text}'
        "<span></span></div>"
        for color, text, path in _LEGEND
    )
    script = _resource("panel_live.js")
    if readings is not None:
        # An unescaped "<" could end the script element.
        rows = json.dumps(readings).replace("<", "\\u003c")
        script = Template(_resource("panel_recorded.js")).safe_substitute(readings=rows)
    panel = Template(_resource("panel.html")).safe_substitute(
        title=title, description=description, legend=legend, script=script
    )
    page = page.replace("<title>Drake MeshCat</title>", f"<title>{title}</title>", 1)
    head, _, tail = page.rpartition("</body>")
    return head + panel + tail


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
    address = f"{_resource('panel_folders.js')}    url = {json.dumps(meshcat.ws_url())};"
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
        """Sends the number of the next frame to the live page, if the page has drawn the previous
        one, and waits if the page is late.

        As long as the previous number was sent less than `_MAX_LAG` ago and its frame is not drawn,
        the method returns at once without sending. After this time it waits for the page: once the
        frame is drawn, it sends the next number; if the page counts as closed, it only returns.
        """
        while self._drawn_frame < self._frame:
            now = time.monotonic()
            if now - self._sent_time < _MAX_LAG or now - self._request_time > _PAGE_TIMEOUT:
                return
            time.sleep(0.005)
        self._frame += 1
        self._sent_time = time.monotonic()
        self._meshcat.SetProperty(_FRAME, "renderOrder", float(self._frame))
