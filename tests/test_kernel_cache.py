"""Compiled kernels always have a place."""

import os
from pathlib import Path

import pytest

from drake_oa.kernel_cache import provide_kernel_cache


@pytest.fixture(autouse=True)
def _own_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    # Set first, so that what the function sets is undone afterwards.
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    monkeypatch.setenv("XDG_CACHE_HOME", os.devnull)


def read_only(package: Path) -> Path:
    """A package beside whose source nothing can be kept, not even by root."""
    (package / "__pycache__").touch()
    return package


def test_beside_the_source_by_default(tmp_path: Path) -> None:
    assert provide_kernel_cache(tmp_path) is None
    assert not os.environ["NUMBA_CACHE_DIR"]


def test_in_the_users_cache_of_a_read_only_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert provide_kernel_cache(read_only(tmp_path)) is None
    assert not os.environ["NUMBA_CACHE_DIR"]


def test_in_a_temporary_folder_where_nothing_else_can_be_written(tmp_path: Path) -> None:
    folder = provide_kernel_cache(read_only(tmp_path))
    assert folder is not None
    assert os.environ["NUMBA_CACHE_DIR"] == folder.name
    assert Path(folder.name).stat().st_mode & 0o777 == 0o700
    folder.cleanup()


def test_what_the_user_chose_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/mine")
    assert provide_kernel_cache(read_only(tmp_path)) is None
    assert os.environ["NUMBA_CACHE_DIR"] == "/mine"
