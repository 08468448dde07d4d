"""Current folder of the tests of commands."""

from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def _own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Changes to a temporary folder, because commands write to the current one."""
    monkeypatch.chdir(tmp_path)
