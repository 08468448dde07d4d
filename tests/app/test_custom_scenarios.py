"""`drake-oa new` and `drake-oa check`."""

from pathlib import Path

import pytest

from drake_oa.app.main import main
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario, scenario_text

WRONG = """
sed: 1
obstacles: [{name: a, shapes: []}]
"""
FAR = """
task: {goal: [3, 0, 0]}
directives: [{add_model: {name: a, file: b.sdf}}]
"""
BLOCKED = """
obstacles: [{name: a, shapes: [!Sphere {radius: 0.1}], translation: [0.45, 0.45, 0.3]}]
"""


def test_new_scenario_has_no_errors_and_can_be_simulated(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["new", "mine"]) == 0
    assert capsys.readouterr().out.split() == ["mine.scenario.yaml", "scenario.schema.json"]
    assert main(["check", "mine.scenario.yaml", "--plot", "mine.png"]) == 0
    out = capsys.readouterr().out
    assert "requested clearance: 0.1 m\nnot obstacles, since not named obstacle...: table" in out
    assert "of the space within 0.4 m of the arm is unobserved" in out.split("58 x 45 deg\n")[1]
    assert Path("mine.png").stat().st_size > 20_000
    log = simulate(load_scenario("mine.scenario.yaml"), duration=0.05)
    assert log.stop_reason == "time limit of 0.05 s"
    assert main(["new", "other", "--like", "cage"]) == 0
    assert scenario_text(load_scenario("other.scenario.yaml")) == scenario_text(
        load_scenario("cage")
    )


@pytest.mark.parametrize(
    ("text", "errors"),
    [
        (WRONG, ["obstacles[0].shapes", "sed"]),
        (FAR, ["b.sdf' which does not exist", "task.goal: out of reach"]),
        (BLOCKED, ["task.goal: contact of"]),
    ],
)
def test_all_errors_are_reported(
    text: str, errors: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    Path("own.yaml").write_text(text)
    assert main(["check", "own.yaml"]) == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == len(errors)
    assert all(any(part in line for line in lines) for part in errors)
