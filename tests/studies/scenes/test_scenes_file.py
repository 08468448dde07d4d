"""Scenes files: written, read, and refused with the place of the fault."""

import zipfile
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


def test_scenes_without_any_obstacle_are_read(tmp_path: Path) -> None:
    given = arrays() | {"center": np.zeros((3, 0, 3)), "semi_axes": np.zeros((3, 0, 3))}
    given |= {"R": np.zeros((3, 0, 3, 3)), "velocity": np.zeros((3, 0, 3))}
    np.savez(tmp_path / "scenes.npz", **given)
    assert load_scenes(tmp_path / "scenes.npz").center.shape == (3, 0, 3)


def changed(name: str, place: tuple, value: float | np.ndarray) -> dict[str, np.ndarray]:
    given = arrays()
    given[name][place] = value
    return given


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({k: v for k, v in arrays().items() if k != "R"}, "lacks R; needed: baseline, center"),
        (arrays() | {"center": np.zeros((3, 6))}, r"center must be \(N, M, 3\)"),
        (arrays() | {"R": np.zeros((3, 5, 3, 3))}, r"R must be \(N, M, 3, 3\) with N = 3, M = 6"),
        (arrays() | {"baseline": np.ones((3, 1))}, r"baseline must be \(N,\)"),
        (arrays() | {"clearance": np.ones(2)}, r"clearance must be \(N,\) with N = 3, not \(2,\)"),
        (arrays() | {"clearance": np.array(["a"] * 3)}, "clearance must hold real numbers"),
        ({k: v[:0] for k, v in arrays().items()}, "no scene"),
        (changed("semi_axes", (2, 1, 0), -0.1), "semi_axes of scene 2, obstacle 1 must be posit"),
        (changed("semi_axes", (0, 0, 2), 0.0), "semi_axes of scene 0, obstacle 0 must be posit"),
        (changed("R", (0, 3, 0, 0), 2.0), "R of scene 0, obstacle 3 must be a rotation"),
        (changed("R", (0, 3), np.diag([1.0, 1.0, -1.0])), "R of scene 0, obstacle 3 must be a rot"),
        (changed("velocity", (1, 2, 0), np.inf), "velocity of scene 1, obstacle 2 must be finite"),
        (changed("center", (1, 2, 0), np.nan), "scene 1, obstacle 2 must be finite, or NaN"),
        (changed("baseline", (1,), 0.0), "baseline of scene 1 must be positive"),
        (changed("baseline", (1,), np.nan), "baseline of scene 1 must be positive"),
        (changed("baseline", (1,), 500.0), r"baseline of scene 1 must be .* at most 100 \[m\]"),
        (changed("center", (2, 1), [450, 30, 0]), "center of scene 2, obstacle 1 .*millimetres"),
        (changed("clearance", (0,), 0.0), "clearance of scene 0 must be positive and at most"),
        (changed("clearance", (2,), -0.1), "clearance of scene 2 must be positive"),
        (changed("clearance", (2,), 1.5), "clearance of scene 2 must be .* at most the baseline"),
        (changed("clearance", (2,), np.nan), "clearance of scene 2 must be positive"),
        (changed("center", (2, 0), np.zeros(3)), "start of scene 2 lies .* inside an obstacle"),
    ],
)
def test_faults_are_named(tmp_path: Path, given: dict[str, np.ndarray], named: str) -> None:
    path = tmp_path / "faulty.npz"
    np.savez(path, **given)
    with pytest.raises(ValueError, match=named) as caught:
        load_scenes(path)
    assert str(path) in str(caught.value)


def test_more_than_memory_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "huge.npz"
    N, M = 10**6, 10**6
    shapes = {"baseline": (N,), "clearance": (N,), "R": (N, M, 3, 3)}
    with zipfile.ZipFile(path, "w") as archive:
        for name in NAMES:
            with archive.open(f"{name}.npy", "w") as file:
                header = {"descr": "<f8", "fortran_order": False}
                header["shape"] = shapes.get(name, (N, M, 3))
                np.lib.format.write_array_header_1_0(file, header)
    with pytest.raises(ValueError, match=r"cannot be read as \.npz"):
        load_scenes(path)


@pytest.mark.parametrize("content", [b"", b"not a zip file", b"PK\x03\x04 cut off"])
def test_foreign_files_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "foreign.npz"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"cannot be read as \.npz"):
        load_scenes(path)


def test_a_file_cut_off_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "cut.npz"
    np.savez(path, **arrays())
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(ValueError, match=r"cannot be read as \.npz"):
        load_scenes(path)


def test_objects_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "objects.npz"
    np.savez(path, **arrays() | {"baseline": np.array([None, 1, 2], dtype=object)})
    with pytest.raises(ValueError, match=r"cannot be read as \.npz"):
        load_scenes(path)


def test_an_absent_file_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="No such file"):
        load_scenes(tmp_path / "absent.npz")
