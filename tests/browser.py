"""Headless Chromium that is controlled by its DevTools protocol."""

import asyncio
import json
import shutil
import subprocess
import tempfile
import time
import urllib.request
import weakref
from pathlib import Path
from typing import Any

from tornado.websocket import websocket_connect

PROGRAM = shutil.which("chromium") or shutil.which("chromium-browser")
"""Path of the program; None: it is not installed."""
_FLAGS = ("--headless=new", "--no-sandbox", "--use-angle=swiftshader")
_FLAGS += ("--enable-unsafe-swiftshader", "--remote-debugging-port=0", "--window-size=1400,900")
"""Command line options of the program."""


class Browser:
    """Browser with one page, which the end of a `with` block closes."""

    def __init__(self, url: str) -> None:
        """Starts the browser with the page of a URL."""
        self._folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        command = [str(PROGRAM), *_FLAGS, f"--user-data-dir={self._folder.name}", url]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self._process = subprocess.Popen(command, **quiet)
        self._loop = asyncio.new_event_loop()
        # Also if the connection fails.
        weakref.finalize(self, self._process.kill)
        self._socket = self._loop.run_until_complete(self._connect())

    async def _connect(self) -> Any:
        """Connects to the page; raises TimeoutError after 60 s."""
        port = Path(self._folder.name) / "DevToolsActivePort"
        deadline = time.monotonic() + 60.0
        while time.monotonic() < deadline:
            if port.is_file() and (lines := port.read_text().split()):
                with urllib.request.urlopen(f"http://localhost:{lines[0]}/json") as answer:
                    pages = [page for page in json.load(answer) if page["type"] == "page"]
                if pages:
                    address = pages[0]["webSocketDebuggerUrl"]
                    return await websocket_connect(address, max_message_size=2**28)
            await asyncio.sleep(0.1)
        raise TimeoutError("the browser has no page after 60 s")

    def call(self, method: str, **parameters: Any) -> Any:
        """Calls a method of the DevTools protocol, and returns its result."""

        async def request() -> Any:
            content = {"id": 1, "method": method, "params": parameters}
            await self._socket.write_message(json.dumps(content))
            while True:
                message = json.loads(await self._socket.read_message())
                # Messages without this ID are events.
                if message.get("id") == 1:
                    return message["result"]

        return self._loop.run_until_complete(asyncio.wait_for(request(), 60.0))

    def evaluate(self, script: str) -> Any:
        """Returns the value of a JavaScript expression on the page."""
        result = self.call("Runtime.evaluate", expression=script, returnByValue=True)
        return result["result"].get("value")

    def wait_for(self, condition: str, timeout: float = 60.0) -> None:
        """Waits until a JavaScript expression is true; raises TimeoutError after a timeout [s]."""
        deadline = time.monotonic() + timeout
        while not self.evaluate(condition):
            if time.monotonic() > deadline:
                raise TimeoutError(f"not true after {timeout:.0f} s: {condition}")
            time.sleep(0.2)

    def __enter__(self) -> "Browser":
        return self

    def __exit__(self, *error: object) -> None:
        self._socket.close()
        self._process.terminate()
        self._process.wait(20.0)
        self._loop.close()
        self._folder.cleanup()
