"""Which commit a result names."""

import shutil
import subprocess
from pathlib import Path

import pytest

from drake_oa.common.provenance import source_commit

needs_git = pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")


def git(folder: Path, *arguments: str) -> str:
    who = [
        "-c",
        "user.name=Test",
        "-c",
        "user.email=test@example.org",
        "-c",
        "commit.gpgsign=false",
    ]
    command = ["git", "-C", str(folder), *who, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    (tmp_path / "code.py").write_text("1\n")
    git(tmp_path, "init")
    git(tmp_path, "add", "code.py")
    git(tmp_path, "commit", "-m", "First")
    return tmp_path


@needs_git
def test_a_clean_checkout_is_named_by_its_commit(checkout: Path) -> None:
    commit = git(checkout, "rev-parse", "--short", "HEAD")
    assert source_commit(checkout) == commit
    (checkout / "untracked.txt").write_text("a result\n")
    assert source_commit(checkout) == commit


@needs_git
def test_a_changed_checkout_is_called_dirty(checkout: Path) -> None:
    (checkout / "code.py").write_text("2\n")
    assert source_commit(checkout) == git(checkout, "rev-parse", "--short", "HEAD") + "-dirty"
    git(checkout, "add", "code.py")
    assert source_commit(checkout).endswith("-dirty")


@needs_git
def test_a_repository_without_a_commit_names_none(tmp_path: Path) -> None:
    git(tmp_path, "init")
    assert source_commit(tmp_path) == ""


def test_a_folder_that_is_no_checkout_names_none(tmp_path: Path) -> None:
    assert source_commit(tmp_path) == ""
