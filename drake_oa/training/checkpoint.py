"""What a training has computed so far, kept in a folder from which it goes on."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from drake_oa.common.files import replace_file, replace_json

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
        wanted = json.loads(json.dumps(settings))
        if folder.is_file() or (folder.is_dir() and any(folder.iterdir())):
            self._check(wanted, restart)
        self.resumed = folder.is_dir() and any(folder.iterdir())
        folder.mkdir(parents=True, exist_ok=True)
        if not self.resumed:
            replace_json(folder / _SETTINGS, wanted)

    def _check(self, wanted: dict[str, Any], restart: bool) -> None:
        path = self.folder / _SETTINGS
        try:
            found = json.loads(path.read_text())
        except (OSError, ValueError):
            raise ValueError(
                f"{self.folder} exists and is no checkpoint: name another folder by --checkpoint"
            ) from None
        if restart:
            self.remove()
        elif found != wanted:
            keys = sorted(k for k in {*found, *wanted} if found.get(k) != wanted.get(k))
            raise ValueError(
                f"{self.folder} holds a training with other settings ({', '.join(keys)} differ): "
                "use those, name another folder by --checkpoint, or discard it by --restart"
            )

    def save(self, stage: str, **arrays: Any) -> None:
        """Writes the arrays and numbers of a stage in place of those before."""
        named = {name: np.array(value, order="C") for name, value in arrays.items()}
        replace_file(self.folder / f"{stage}.safetensors", lambda path: save_file(named, path))

    def load(self, stage: str) -> Arrays | None:
        """The arrays of a stage, None where there are none.

        Raises:
            ValueError: if the file is damaged.
        """
        path = self.folder / f"{stage}.safetensors"
        if not path.is_file():
            return None
        try:
            return load_file(path)
        except SafetensorError as error:
            raise ValueError(f"{path} is damaged ({error}): start anew by --restart") from error

    def remove(self) -> None:
        """Deletes the folder."""
        shutil.rmtree(self.folder)
