"""`drake-oa new` and `drake-oa check`."""

from pathlib import Path

import pytest

from drake_oa.app.main import main
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario, scenario_text

WRONG = """
task: {clearence: 1, start: [0.45, -0.4]}
sed: 1
obstacles: [{name: a, shapes: [!Bx {size: [1, 1, 1]}]}]
"""
TORN = """
obstacles: [{name: a, shapes: []}]
perception: !DepthCamera {camera: kamera}
"""
FAR = """
task: {goal: [3, 0, 0]}
directives: [{add_model: {name: a, file: b.sdf}}]
"""
BLOCKED = """
obstacles: [{name: a, shapes: [!Sphere {radius: 0.1}], translation: [0.45, 0.45, 0.3]}]
"""


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_a_new_scenario_is_right_and_moves(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["new", "mine"]) == 0
    assert capsys.readouterr().out.split() == ["mine.scenario.yaml", "scenario.schema.json"]
    assert main(["check", "mine.scenario.yaml"]) == 0
    assert "asked clearance: 0.1 m" in capsys.readouterr().out
    assert Path("mine.check.png").stat().st_size > 20_000
    log = simulate(load_scenario("mine.scenario.yaml"), duration=0.05)
    assert log.stop_reason == "time limit of 0.05 s"
    assert main(["new", "mine"]) == 2
    assert "exists already" in capsys.readouterr().err


def test_one_may_begin_with_what_is_shipped() -> None:
    assert main(["new", "other", "--like", "cage"]) == 0
    own = load_scenario("other.scenario.yaml")
    assert scenario_text(own) == scenario_text(load_scenario("cage"))


def test_a_name_is_no_path_to_elsewhere(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["new", "a b"]) == 2
    assert "a name is made of" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            WRONG,
            [
                "task.clearence is not a field (did you mean clearance?)",
                "task.start: expected 3 numbers, not 2",
                "sed is not a field (did you mean seed?)",
                "obstacles[0].shapes[0]: tag !Bx is not one of !Box",
            ],
        ),
        (TORN, ["obstacles[0].shapes: is empty", "there is no camera 'kamera'"]),
        (FAR, ["b.sdf' which does not exist", "task.goal: out of reach"]),
    ],
)
def test_all_that_is_wrong_is_said(
    text: str, said: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    Path("own.yaml").write_text(text)
    assert main(["check", "own.yaml"]) == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == len(said)
    assert all(part in line for part, line in zip(said, lines, strict=True))


@pytest.mark.parametrize("command", ["run", "play"])
def test_a_start_in_contact_is_refused(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("own.yaml").write_text(BLOCKED.replace("0.45, 0.45", "0.45, -0.45"))
    assert main([command, "own.yaml"]) == 2
    assert "task.start: contact of panda_link7 - obstacle_a" in capsys.readouterr().err


def test_what_was_read_is_not_written_over(capsys: pytest.CaptureFixture[str]) -> None:
    text = "task: {demonstration: way.csv}"
    Path("own.yaml").write_text(text)
    Path("way.csv").write_text("t,x,y,z\n0,0,0,0\n1,1,0,0\n")
    for output in ("own.yaml", "way.csv"):
        assert main(["run", "own.yaml", "--html", output]) == 2
        assert f"cannot write {output}: the command reads this file" in capsys.readouterr().err
    assert Path("own.yaml").read_text() == text


def test_a_goal_in_contact_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    Path("own.yaml").write_text(BLOCKED)
    assert main(["check", "own.yaml", "--no-plot"]) == 1
    assert "obstacle_a" in capsys.readouterr().out
