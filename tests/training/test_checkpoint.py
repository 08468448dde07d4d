"""The folder of an unfinished training."""

import numpy as np
import pytest

from drake_oa.training.checkpoint import Checkpoint

SETTINGS = {"recipe": "test", "seed": 3, "axis": (1.0, 2.0)}


def test_what_was_saved_is_found_again(tmp_path):
    first = Checkpoint(tmp_path / "c", SETTINGS)
    assert not first.resumed
    assert first.load("set") is None
    first.save("set", x=np.arange(3), number=5, flag=True, columns=np.ones((2, 3)).T)
    again = Checkpoint(tmp_path / "c", SETTINGS)
    assert again.resumed
    found = again.load("set")
    np.testing.assert_array_equal(found["x"], np.arange(3))
    assert (int(found["number"]), bool(found["flag"])) == (5, True)
    assert found["columns"].shape == (3, 2)
    again.remove()
    assert not (tmp_path / "c").exists()


def test_other_settings_are_refused_until_it_is_told_to_restart(tmp_path):
    Checkpoint(tmp_path, SETTINGS).save("set", x=np.arange(3))
    other = {**SETTINGS, "seed": 4}
    with pytest.raises(ValueError, match=r"other settings \(seed differ\).*--restart"):
        Checkpoint(tmp_path, other)
    fresh = Checkpoint(tmp_path, other, restart=True)
    assert not fresh.resumed
    assert fresh.load("set") is None


def test_a_folder_of_something_else_is_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("42")
    with pytest.raises(ValueError, match="is no checkpoint"):
        Checkpoint(tmp_path, SETTINGS, restart=True)
    assert (tmp_path / "thesis.tex").read_text() == "42"


def test_a_damaged_file_is_named(tmp_path):
    checkpoint = Checkpoint(tmp_path, SETTINGS)
    (tmp_path / "set.npz").write_bytes(b"no more")
    with pytest.raises(ValueError, match=r"set\.npz cannot be read"):
        checkpoint.load("set")
