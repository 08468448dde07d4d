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


def source_commit(folder: Path | None = None) -> str:
    """Commit of a checkout, or "" when there is none.

    Args:
        folder: root of the checkout; None for the one this package runs from.

    Returns:
        The short hash, with "-dirty" appended when a tracked file has changes.
    """
    folder = folder or Path(__file__).resolve().parents[2]
    if not (folder / ".git").exists():
        return ""
    commit = _git(folder, "rev-parse", "--short", "HEAD")
    if not commit:
        return ""
    changes = _git(folder, "status", "--porcelain", "--untracked-files=no")
    return f"{commit}-dirty" if changes else commit


def _git(folder: Path, *arguments: str) -> str:
    """What git prints, or "" when it fails."""
    try:
        answer = subprocess.run(
            ["git", "--no-optional-locks", "-C", str(folder), *arguments],
            capture_output=True,
            text=True,
            timeout=10,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return answer.stdout.strip() if answer.returncode == 0 else ""
