"""What a training has computed so far, kept in a folder from which it goes on."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from drake_oa.common.files import read_arrays, replace_arrays, replace_json

Arrays = dict[str, np.ndarray[Any, Any]]

Report = Callable[[str, float], None]
"""Told the stage and the fraction of it that is done."""

_SETTINGS = "settings.json"


class Checkpoint:
    """A folder with the training's settings and one file a stage.

    Files are replaced whole, so that an interruption leaves the one before.
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any], *, restart: bool = False) -> None:
        """Opens the folder, or makes it.

        Args:
            folder: where.
            settings: all that decides the result (recipe, seed, ...), as JSON would
                hold it.
            restart: whether to throw away what is there.

        Raises:
            ValueError: if what is there was made with other settings, or is no
                checkpoint.
        """
        self.folder = folder
        wanted, path = json.loads(json.dumps(settings)), folder / _SETTINGS
        self.resumed = folder.is_file() or (folder.is_dir() and any(folder.iterdir()))
        if self.resumed and not path.is_file():
            raise ValueError(
                f"{folder} exists and is no checkpoint: name another folder by --checkpoint"
            )
        if self.resumed and restart:
            self.remove()
            self.resumed = False
        if not self.resumed:
            folder.mkdir(parents=True, exist_ok=True)
            replace_json(path, wanted)
            return
        found = json.loads(path.read_text())
        if found != wanted:
            keys = sorted(k for k in {*found, *wanted} if found.get(k) != wanted.get(k))
            raise ValueError(
                f"{folder} holds a training with other settings ({', '.join(keys)} differ): "
                "use those, name another folder by --checkpoint, or discard it by --restart"
            )

    def save(self, stage: str, **arrays: Any) -> None:
        """Writes the arrays and numbers of a stage in place of those before."""
        replace_arrays(self.folder / f"{stage}.npz", arrays)

    def load(self, stage: str) -> Arrays | None:
        """Reads the arrays of a stage; None: there are none.

        Raises:
            ValueError: if the file is damaged.
        """
        path = self.folder / f"{stage}.npz"
        return read_arrays(path) if path.is_file() else None

    def remove(self) -> None:
        """Deletes the folder."""
        shutil.rmtree(self.folder)
