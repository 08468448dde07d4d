"""Reading of demonstration files: valid formats, errors, and the shipped demonstrations."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from drake_oa.common.config import ScenarioError
from drake_oa.common.messages import FloatArray
from drake_oa.scenario.demonstration import (
    demonstrated_orientation,
    demonstrated_path,
    read_demonstration,
    read_demonstrations,
)
from drake_oa.scenario.loading import load_scenario, parse_scenario, scenario_text
from drake_oa.scenario.scenario import Scenario
from tests.builders import load_module

S = np.linspace(0.0, 1.0, 11)
PATH = np.column_stack([0.1 * np.sin(np.pi * S), S, 0.0 * S])
SHIPPED = Path(__file__).resolve().parents[2] / "models" / "demonstrations"


def scenario_with_demonstrations(*files: Path | str) -> Scenario:
    """Loads a shipped scenario with other demonstration files."""
    return load_scenario("tabletop_box", [f"task.demonstration=[{', '.join(map(str, files))}]"])


def csv(folder: Path, *lines: str, name: str = "demo.csv") -> Path:
    """Writes a CSV file of the given lines."""
    file = folder / name
    file.write_text("\n".join(lines) + "\n")
    return file


def rows(*columns: FloatArray) -> list[str]:
    """Returns the CSV rows of the given columns."""
    return [",".join(f"{value:.9g}" for value in row) for row in np.column_stack(columns)]


# Valid formats ------------------------------------------------------------------------


@pytest.mark.parametrize("header", ["t,x,y,z", "z, t ,x,y", "\ufefft,x,y,z"])
def test_columns_of_a_csv_follow_its_header(header: str, tmp_path: Path) -> None:
    columns = {"t": 3.0 * S, "x": PATH[:, 0], "y": PATH[:, 1], "z": PATH[:, 2]}
    names = [name.strip("\ufeff ") for name in header.split(",")]
    lines = rows(*(columns[name] for name in names))
    demonstration = read_demonstration(csv(tmp_path, header, *lines, "", ""))
    np.testing.assert_allclose(demonstration.path, PATH, atol=1e-8)
    np.testing.assert_allclose(demonstration.t, 3.0 * S, atol=1e-8)
    assert demonstration.orientations is None


def test_csv_and_npz_give_the_same_primitives(tmp_path: Path) -> None:
    half = 0.25 * np.pi + 0.2 * S
    q = np.column_stack([np.cos(half), 0.0 * S, 0.0 * S, np.sin(half)])
    # Quaternions of any sign and length are valid.
    q *= np.where(np.arange(11) % 2, -2.0, 1.0)[:, None]
    np.savez(tmp_path / "demo.npz", path=PATH, quaternion=q)
    file = csv(tmp_path, "x,y,z,qw,qx,qy,qz", *rows(PATH, q))
    one, other = (scenario_with_demonstrations(each) for each in (tmp_path / "demo.npz", file))
    a, b = (demonstrated_path(each) for each in (one, other))
    np.testing.assert_allclose(a.weights, b.weights, atol=1e-4)
    assert a.duration == b.duration == one.task.duration
    r, s = (demonstrated_orientation(each) for each in (one, other))
    assert r is not None
    assert s is not None
    np.testing.assert_allclose(r.total, [0.0, 0.0, 0.4], atol=1e-6)
    np.testing.assert_allclose(r.dmp.weights, s.dmp.weights, atol=1e-3)


def test_one_file_is_a_list_of_one_and_none_an_empty_one() -> None:
    for text, files in (("a.npz", ["a.npz"]), ("''", []), ("[a.npz, b.csv]", ["a.npz", "b.csv"])):
        task = parse_scenario(f"task: {{demonstration: {text}}}", folder=Path("/there")).task
        assert task.demonstration == [f"/there/{name}" for name in files]
    scenario = parse_scenario("task: {demonstration: package://drake_oa/demonstrations/pour.csv}")
    assert scenario.task.demonstration == ["package://drake_oa/demonstrations/pour.csv"]
    again = parse_scenario(scenario_text(scenario))
    assert again.task.demonstration == scenario.task.demonstration
    with pytest.raises(
        ScenarioError, match=r"task\.demonstration\[0\]: should be a valid string, not 3"
    ):
        parse_scenario("task: {demonstration: [3]}")


# Errors -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (["0,0,0,0", "1,0,1,0"], ["its first line is '0,0,0,0'", "names its columns, x,y,z"]),
        (["t,x,y,w", "0,0,0,0"], ["its first line is 't,x,y,w'", "qw,qx,qy,qz"]),
        (["x,y,z,qw,qx", "0,0,0,0,0"], ["its first line is", "qw,qx,qy,qz"]),
        (["x,y,z", "0,0,0", "1,a,0"], ["could not convert string 'a'", "row 1, column 2"]),
        (["x,y,z", "0,0,0", "1,nan,0", "1,1,1"], ["sample 1 is not", "sample 0 is line 2"]),
        (["t,x,y,z", "0,0,0,0", "5200,0,1,0"], ["span 5200 s, at most 600", "in seconds"]),
        (
            ["x,y,z,qw,qx,qy,qz", "0,0,0,1,0,0,0", "1,0,0,0,1,0,0"],
            ["sample 0 and the next differ by 180 degrees"],
        ),
    ],
)
def test_error_of_an_invalid_csv_names_the_sample_and_the_problem(
    lines: list[str], words: list[str], tmp_path: Path
) -> None:
    with pytest.raises(ScenarioError) as error:
        demonstrated_path(scenario_with_demonstrations(csv(tmp_path, *lines)))
    for word in ("task.demonstration: ", "demo.csv", *words):
        assert word in str(error.value)
    assert len(str(error.value).splitlines()) == 1


def test_error_names_the_invalid_file_of_several(tmp_path: Path) -> None:
    np.savez(tmp_path / "good.npz", path=PATH)
    np.savez(tmp_path / "nan.npz", path=np.where(S[:, None] == S[4], np.nan, PATH))
    np.savez(tmp_path / "turns.npz", path=PATH, R=np.tile(np.eye(3), (11, 1, 1)))
    np.savez(tmp_path / "back.npz", path=PATH * np.sin(np.pi * S)[:, None])
    for one, other, message in (
        ("good", "nan", r"nan\.npz': path and t must be finite: sample 4 is"),
        ("turns", "good", r"good\.npz' has no orientations, other files have"),
        ("good", "back", r"good\.npz', '.*back\.npz': the path must end"),
    ):
        files = (tmp_path / f"{name}.npz" for name in (one, other))
        with pytest.raises(ScenarioError, match=message):
            demonstrated_path(scenario_with_demonstrations(*files))


@pytest.mark.parametrize("kind", ["npz", "csv"])
def test_too_many_samples_are_rejected(kind: str, tmp_path: Path) -> None:
    file = tmp_path / f"demo.{kind}"
    if kind == "npz":
        np.savez(file, path=np.zeros((1_000_001, 3), dtype=np.int8))
    else:
        file.write_bytes(b"x,y,z\n" + b"0,0,0\n" * 1_000_001)
    with pytest.raises(ScenarioError, match=r"more than 1000000 samples.*reduce its sampling rate"):
        read_demonstrations(scenario_with_demonstrations(file).task)


# Shipped demonstrations ---------------------------------------------------------------


def test_script_reproduces_the_shipped_demonstrations(tmp_path: Path) -> None:
    module = load_module(SHIPPED / "generate_demonstrations.py")
    module.FOLDER = tmp_path
    module.main()
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == sorted(p.name for p in SHIPPED.iterdir() if p.suffix in (".csv", ".npz"))
    assert names == ["arc_1.npz", "arc_2.npz", "arc_3.npz", "pour.csv", "wipe.npz"]
    for name in names:
        one, other = (read_demonstration(folder / name) for folder in (tmp_path, SHIPPED))
        np.testing.assert_allclose(one.path, other.path, atol=2e-6)
        np.testing.assert_allclose(one.t, other.t, atol=2e-6)
        if one.orientations is not None:
            np.testing.assert_allclose(one.orientations, other.orientations, atol=1e-5)
