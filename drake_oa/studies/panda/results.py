"""Results on disk, each in a small file of its own, so that an evaluation can resume.

A file holds its content and a key: a digest of everything that the content follows from,
the package's own source and models among it. A file whose key is another's is not taken.
"""

from __future__ import annotations

import hashlib
import json
import logging
from functools import cache
from importlib import resources
from importlib.metadata import version
from pathlib import Path
from typing import Any

from drake_oa.common.files import replace_text

_logger = logging.getLogger("drake_oa")

_SOURCES = {
    "drake_oa": ("*.py",),
    "drake_oa.diagrams": ("*.py", "*.scenario.yaml"),
    "drake_oa.models": ("*.sdf", "*.yaml", "*.urdf", "*.obj", "*.npz", "*.safetensors"),
}
_PACKAGES = ("drake", "numba", "numpy", "scipy")


@cache
def source_digest() -> str:
    """Digest of the package's source, its models, and the versions of what they call.

    As it is when it is first asked for: what a process has loaded does not change with it.
    """
    digest = hashlib.sha256()
    for package, patterns in _SOURCES.items():
        folder = Path(str(resources.files(package)))
        for path in sorted(p for pattern in patterns for p in folder.rglob(pattern)):
            digest.update(str(path.relative_to(folder)).encode())
            digest.update(hashlib.sha256(path.read_bytes()).digest())
    for name in _PACKAGES:
        digest.update(f"{name} {version(name)}".encode())
    return digest.hexdigest()


def content_key(*parts: object) -> str:
    """Digest of plain data."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


class ResultFolder:
    """Named results in a folder."""

    def __init__(self, folder: Path) -> None:
        """Makes the folder.

        Raises:
            ValueError: if it cannot be made or written to.
        """
        self._folder = folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
            trial = folder / ".writable"
            trial.write_text("")
            trial.unlink()
        except OSError as error:
            raise ValueError(f"cannot write results to {folder}: {error.strerror}") from None

    @property
    def path(self) -> Path:
        """The folder."""
        return self._folder

    def load(self, name: str, key: str) -> Any:
        """The content of a name, or None where there is none of this key.

        A file that cannot be read is warned of and counts as none.
        """
        path = self._folder / f"{name}.json"
        try:
            found = json.loads(path.read_text())
            same, content = found["key"] == key, found["content"]
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError) as error:
            _logger.warning("%s cannot be read and is made anew: %r", path, error)
            return None
        return content if same else None

    def save(self, name: str, key: str, content: Any) -> None:
        """Writes a content in one piece."""
        text = json.dumps({"key": key, "content": content}, indent=1, allow_nan=False)
        replace_text(self._folder / f"{name}.json", text + "\n")
