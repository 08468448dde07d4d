"""Results on disk: taken when their key is right, made anew otherwise."""

import json

import pytest

from drake_oa.studies.results import ResultFolder, content_key


def test_a_result_comes_back_by_its_key_only(tmp_path):
    folder = ResultFolder(tmp_path / "a" / "b")
    folder.save("one", "key", {"x": 1.5})
    assert folder.load("one", "key") == {"x": 1.5}
    assert folder.load("one", "other") is None
    assert folder.load("two", "key") is None
    assert [path.name for path in folder.path.iterdir()] == ["one.json"]


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"key": "key"}', "\x00\xff"])
def test_a_file_that_cannot_be_read_is_warned_of(tmp_path, caplog, text):
    folder = ResultFolder(tmp_path)
    (tmp_path / "one.json").write_bytes(text.encode("latin-1"))
    assert folder.load("one", "key") is None
    assert "one.json cannot be read and is made anew" in caplog.text


def test_a_folder_that_is_a_file_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="cannot write"):
        ResultFolder(tmp_path / "file")


def test_keys_tell_their_parts_apart_and_stay():
    assert content_key("a", 1) == content_key("a", 1)
    assert len({content_key("a", 1), content_key("a", 2), content_key("a", None)}) == 3


def test_what_is_not_finite_is_not_written(tmp_path):
    with pytest.raises(ValueError):
        ResultFolder(tmp_path).save("one", "key", float("nan"))
    assert json.dumps(ResultFolder(tmp_path).load("one", "key")) == "null"
