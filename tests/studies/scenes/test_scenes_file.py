"""Scenes files: written, read, and refused with the place of the fault."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from drake_oa.studies.scenes.scenes import Scenes, load_scenes, save_scenes
from drake_oa.studies.scenes.suites import draw_scenes

NAMES = [item.name for item in fields(Scenes)]


def arrays() -> dict[str, np.ndarray]:
    scenes = draw_scenes("clutter", 3)
    found = {name: np.array(getattr(scenes, name)) for name in NAMES}
    for name in ("center", "semi_axes", "R", "velocity"):
        found[name][1, 4] = np.nan
    return found


def test_what_is_written_is_read(tmp_path: Path) -> None:
    scenes = Scenes(**arrays())
    save_scenes(tmp_path / "scenes.npz", scenes)
    read = load_scenes(tmp_path / "scenes.npz")
    for name in NAMES:
        assert np.array_equal(getattr(read, name), getattr(scenes, name), equal_nan=True)
    assert read.present.sum() == 17


def changed(name: str, place: tuple, value: float | np.ndarray) -> dict[str, np.ndarray]:
    given = arrays()
    given[name][place] = value
    return given


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({k: v for k, v in arrays().items() if k != "R"}, "lacks R; needed: baseline, center"),
        (arrays() | {"R": np.zeros((3, 5, 3, 3))}, r"R must be \(3, 6, 3, 3\) for centers"),
        (arrays() | {"clearance": np.ones(2)}, r"clearance must be \(3,\) .* not \(2,\)"),
        (arrays() | {"clearance": np.array(["a"] * 3)}, "clearance must hold real numbers"),
        ({k: v[:0] for k, v in arrays().items()}, "no scene"),
        (changed("semi_axes", (2, 1, 0), -0.1), "semi_axes of scene 2, obstacle 1 must be posit"),
        (changed("R", (0, 3, 0, 0), 2.0), "R of scene 0, obstacle 3 must be a rotation"),
        (changed("velocity", (1, 2, 0), np.inf), "velocity of scene 1, obstacle 2 must be finite"),
        (changed("baseline", (1,), 500.0), r"baseline of scene 1 must be .* at most 100 \[m\]"),
        (changed("center", (2, 1), [450, 30, 0]), "center of scene 2, obstacle 1 .*millimetres"),
        (changed("clearance", (2,), 1.5), "clearance of scene 2 must be .* at most the baseline"),
        (changed("center", (2, 0), np.zeros(3)), "start of scene 2 lies .* inside an obstacle"),
    ],
)
def test_faults_are_named(tmp_path: Path, given: dict[str, np.ndarray], named: str) -> None:
    path = tmp_path / "faulty.npz"
    np.savez(path, **given)
    with pytest.raises(ValueError, match=named) as caught:
        load_scenes(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"not a zip file", b"PK\x03\x04 cut off"])
def test_foreign_files_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "foreign.npz"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"cannot be read as \.npz"):
        load_scenes(path)
