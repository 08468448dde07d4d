"""Animations of the gallery: runs shipped scenarios and records their pages in headless Chromium.

`make gallery` records all scenarios whose packages are installed, or those of `NAMES="a b"`, into
`docs/results/recordings`. Each animation shows time, clearances and legend of the panel.
"""

import base64
import io
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image

from drake_oa.runs.motion_log import load_logs
from drake_oa.scenario.shipped import missing_package, shipped_scenarios
from tests.browser import Browser

FOLDER = Path(__file__).parent / "results" / "recordings"
"""Folder of the animations."""
VIEWPORT, SIZE = (960, 600), (640, 400)
"""Width and height of the page and of an animation [pixel]."""
FRAMES = 36
"""Number of frames of an animation."""
EYES = {"bookshelf": (-0.95, -1.75, 1.35)}
"""Name of a scenario -> position of the viewer's camera in the world [m]; for other scenarios it is
the default, from which the shelf hides the arm."""
TIMEOUT = 120.0
"""Maximum time until a page has loaded its recording [s]."""


def record(name: str, folder: Path) -> None:
    """Runs a scenario and writes its animation; a run that misses the goal raises."""
    page, log = folder / f"{name}.html", folder / f"{name}.npz"
    command = ["run", name, "--html", str(page), "--log", str(log)]
    subprocess.run([sys.executable, "-m", "drake_oa.app.main", *command], check=True)
    end = load_logs(log)["avoiding"].duration
    width, height = VIEWPORT
    with Browser(page.as_uri()) as browser:
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        browser.call("Emulation.setDeviceMetricsOverride", **metrics)
        browser.wait_for("window.viewer && viewer.animator.actions.length > 0", TIMEOUT)
        browser.evaluate("document.querySelector('#drake-oa span').hidden = true")
        if name in EYES:
            x, y, z = EYES[name]
            path = "['Cameras', 'default', 'rotated', '<object>']"
            # The camera's frame has y up.
            browser.evaluate(f"viewer.set_property({path}, 'position', {[x, z, -y]})")
        images = [frame(browser, end * i / (FRAMES - 1)) for i in range(FRAMES)]
    FOLDER.mkdir(parents=True, exist_ok=True)
    images[0].save(
        FOLDER / f"{name}.webp",
        save_all=True,
        append_images=images[1:],
        duration=[round(1e3 * end / FRAMES)] * (FRAMES - 1) + [1500],
        loop=0,
        quality=55,
        method=6,
    )


def frame(browser: Browser, t: float) -> Image.Image:
    """Returns the picture of a recorded page at a time [s]."""
    browser.evaluate(
        f"viewer.animator.pause(); viewer.animator.seek({t}); viewer.animator.time = {t}"
    )
    # The panel follows the player every 50 ms.
    time.sleep(0.2)
    png = base64.b64decode(browser.call("Page.captureScreenshot")["data"])
    return Image.open(io.BytesIO(png)).convert("RGB").resize(SIZE, Image.Resampling.LANCZOS)


def main() -> None:
    """Records the scenarios named on the command line, or all."""
    names = sys.argv[1:] or [
        name for name, path in shipped_scenarios().items() if not missing_package(path)
    ]
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            print(name, flush=True)
            record(name, Path(folder))


if __name__ == "__main__":
    main()
