"""Runs the commands of a page of results and inserts their outputs.

    python docs/update_results.py docs/results/moving.md --containing "--suite moving_high"

A command is a block of shell code that an output or the line `NOT_MEASURED` follows. Commands run
in `--folder`, in which an interrupted evaluation resumes; archives of problems are expected there.
The page is written after each command, with date and source digest. A command that fails stops.
"""

import argparse
import os
import re
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

from drake_oa.common.files import source_digest

ROOT = Path(__file__).parents[1]
"""Folder of the repository."""
NOT_MEASURED = "Not measured on this source yet."
"""Line of a page in place of an output."""
BLOCK = re.compile(
    rf"(?P<command>```sh\n(?:drake-oa evaluate|python -m) [^`\n]+\n```\n\n)"
    rf"(?:{re.escape(NOT_MEASURED)}\n|```text\n[^`]*```\n(?:\nMeasured on [^\n]*\n)?)"
)
"""A command with its output, or with the line `NOT_MEASURED`."""


def current_digest() -> str:
    """Returns the source digest of the files as they are now."""
    source_digest.cache_clear()
    return source_digest()


def output(command: str, folder: Path) -> str:
    """Runs a shell command; returns the lines of a page that show its output."""
    folder.mkdir(parents=True, exist_ok=True)
    # The program `drake-oa` of this environment is found without an activated environment.
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    environment = os.environ | {"PATH": path, "PYTHONPATH": str(ROOT)}
    digest = current_digest()
    result = subprocess.run(
        command,
        shell=True,
        check=True,
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
    )
    if current_digest() != digest:
        raise RuntimeError(f"the source changed during the command: {command}")
    today = datetime.now(UTC)
    measured = f"Measured on {today.day} {today:%B %Y}, source digest {digest[:12]}."
    return f"```text\n{result.stdout.strip()}\n```\n\n{measured}\n"


def main() -> None:
    """Runs the selected commands of a page, one after another."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("page", type=Path)
    parser.add_argument("--containing", default="", help="run only commands with this text")
    parser.add_argument("--folder", type=Path, default=ROOT / "build" / "results")
    options = parser.parse_args()
    commands = [match["command"] for match in BLOCK.finditer(options.page.read_text())]
    for command in commands:
        if options.containing in command:
            text = command + output(command.splitlines()[1], options.folder)
            # The page is read again, as it may have been edited meanwhile.
            page = options.page.read_text()
            place = next(m for m in BLOCK.finditer(page) if m["command"] == command)
            options.page.write_text(page[: place.start()] + text + page[place.end() :])


if __name__ == "__main__":
    main()
