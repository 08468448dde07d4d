"""Tests of output checks, atomic replacement of files and the source digest."""

import os
from pathlib import Path

import pytest

from drake_oa.common.files import (
    OutputError,
    check_outputs,
    replace_file,
    replace_text,
    source_digest,
)


def test_checking_creates_folders_and_leaves_files_unchanged(tmp_path: Path) -> None:
    existing = tmp_path / "existing.json"
    existing.write_text("before")
    check_outputs(existing, tmp_path / "new" / "fresh.json", None)
    assert existing.read_text() == "before"
    assert sorted(tmp_path.rglob("*")) == [existing, tmp_path / "new"]


@pytest.mark.parametrize(
    ("name", "reason"),
    [("", "Is a directory"), ("file/x.json", "File exists"), ("a" * 300, "too long")],
)
def test_the_error_names_path_and_reason(name: str, reason: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    path = tmp_path / name
    with pytest.raises(ValueError, match="cannot write") as error:
        check_outputs(path)
    assert str(path) in str(error.value)
    assert reason in str(error.value)


def test_an_output_that_is_also_an_input_or_another_output_is_refused(tmp_path: Path) -> None:
    path, same = tmp_path / "x", tmp_path / "y" / ".." / "x"
    check_outputs(path, None, None, tmp_path / "y")
    with pytest.raises(ValueError, match="another output names this file"):
        check_outputs(path, None, same)
    with pytest.raises(ValueError, match=r"cannot write .*x: the command reads this file"):
        check_outputs(path, read=[same])


def test_a_file_is_replaced_also_through_a_link(tmp_path: Path) -> None:
    path, link = tmp_path / "x.json", tmp_path / "link.json"
    link.symlink_to(path)
    for text in ("first", "second"):
        replace_text(link, text)
        assert path.read_text() == text
    assert link.is_symlink()
    assert sorted(item.name for item in tmp_path.iterdir()) == ["link.json", "x.json"]


def test_a_pipe_is_written_directly(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        replace_text(pipe, "text")
        assert os.read(reader, 10) == b"text"
    finally:
        os.close(reader)
    assert pipe.is_fifo()


def test_a_failed_write_leaves_only_the_old_file(tmp_path: Path) -> None:
    file = tmp_path / "existing"
    file.write_text("before")

    def fail(path: Path) -> None:
        path.write_text("half")
        raise OSError("full")

    with pytest.raises(OutputError, match=r"cannot write .*existing: full"):
        replace_file(file, fail)
    assert file.read_text() == "before"
    assert list(tmp_path.iterdir()) == [file]


def test_the_source_digest_covers_code_and_models_of_motions_but_no_comments(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("drake_oa.common.files.package_folder", tmp_path.joinpath)
    digests = [source_digest.__wrapped__()]
    for name in ("drake_oa/policy/dmp.py", "drake_oa.models/box.sdf", "drake_oa/app/run.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(name)
        digests.append(source_digest.__wrapped__())
    assert len(set(digests[:3])) == 3
    assert digests[3] == digests[2]
    code = 'def f():\n{}    return """x"""\n'
    docstring, comment = '    """Returns x."""\n', '    """Returns\n    x.\n    """\n\n    # Why.\n'
    digests = []
    for text in (docstring, comment, "    g()\n"):
        (tmp_path / "drake_oa/policy/dmp.py").write_text(code.format(text))
        digests.append(source_digest.__wrapped__())
    assert digests[0] == digests[1] != digests[2]
