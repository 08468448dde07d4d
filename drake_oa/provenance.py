"""What a result was made with."""

from __future__ import annotations

import subprocess
from importlib.metadata import version
from pathlib import Path


def software_versions() -> tuple[str, ...]:
    """ "name version" of what the result depends on, and the commit when known."""
    found = [
        f"{name} {version(name)}" for name in ("drake_oa", "drake", "numpy", "scipy", "open3d")
    ]
    commit = source_commit()
    return (*found, f"commit {commit}") if commit else tuple(found)


def source_commit() -> str:
    """Commit of the checkout this package runs from, or "" when there is none."""
    folder = Path(__file__).resolve().parents[1]
    if not (folder / ".git").exists():
        return ""
    try:
        answer = subprocess.run(
            ["git", "-C", str(folder), "rev-parse", "--short", "HEAD"],
            capture_output=True,
            text=True,
            timeout=10,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return answer.stdout.strip() if answer.returncode == 0 else ""
