"""Reading of scenarios: valid texts, overrides, relative files, and texts of errors."""

from pathlib import Path

import pytest

from drake_oa.common.config import ScenarioError
from drake_oa.inference.config import Paper, Verified
from drake_oa.perception.config import CameraNoise, GroundTruth, RecordedClouds
from drake_oa.scenario.loading import load_scenario, parse_scenario, scenario_text
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.shipped import shipped_scenarios


@pytest.mark.parametrize("name", shipped_scenarios())
def test_a_shipped_scenario_has_a_description_and_reads_back_from_its_text(name: str) -> None:
    scenario = load_scenario(name)
    assert scenario.description
    again = parse_scenario(scenario_text(scenario))
    for block in ("task", "obstacles", "faults", "perception", "inference"):
        assert getattr(again, block) == getattr(scenario, block)
    if name != "free_space":
        assert scenario.perception.noise == CameraNoise()


def test_inference_is_verified_unless_paper_is_selected() -> None:
    assert isinstance(parse_scenario("{}").inference, Verified)
    assert isinstance(parse_scenario("{}").perception, GroundTruth)
    # A block without a tag is the default one.
    assert parse_scenario("inference: {generations: 7}").inference == Verified(generations=7)
    assert parse_scenario("inference: !Verified {slack: 0.001}").inference == Verified(slack=1e-3)
    paper = load_scenario("free_space", ["inference=!Paper {}"])
    assert isinstance(paper.inference, Paper)
    assert isinstance(parse_scenario(scenario_text(paper)).inference, Paper)


TWO_CAMERAS = "cameras: [{name: a}, {name: b, fps: 10}]\nperception: !DepthCamera {%s}"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        # Inconsistent fields.
        ("task: {goal: [0.45, -0.45, 0.3]}", ["task.goal", "start"]),
        ("task: {goal_moves: [[2, 0, 0, 1], [2, 0, 0, 1]]}", ["goal_moves[1]", "later"]),
        ("robot: null", ["robot", "GivenEllipsoids"]),
        ("{cameras: [], perception: !DepthCamera {camera: left}}", ["'left'", "none"]),
        (TWO_CAMERAS % "cameras: [a, c]", ["perception.cameras[1]", "'c'"]),
        (TWO_CAMERAS % "camera: b, cameras: [a, b]", ["perception.camera: 'b'"]),
        ((TWO_CAMERAS % "cameras: [a, b]").replace("10", "15"), ["cameras[1].fps", "15", "10"]),
        (
            f"{TWO_CAMERAS % 'camera: a'}\nfaults: [!CameraDropout {{camera: left}}]",
            ["faults[0].camera", "'left'"],
        ),
        (
            "faults: [!CameraDropout {}]",
            ["faults[0]: !CameraDropout requires 'perception: !DepthCamera'", "!GroundTruth"],
        ),
        (
            "{robot: null, perception: !GivenEllipsoids {}, faults: [!TorqueSaturation {}]}",
            ["!TorqueSaturation requires a robot"],
        ),
        # Tagged blocks.
        ("perception: !Sonar {}", ["perception", "!Sonar", "!DepthCamera", "!GroundTruth"]),
        ("perception: !GroundTruth", ["perception", "!GroundTruth {}"]),
        ("task: !Foo {}", ["task", "!Foo"]),
        # Blocks defined by Drake.
        ("cameras: [{width: 100000}]", ["cameras[0].width", "100000"]),
        ("cameras: [{X_PB: {translation: [a, 0, 0]}}]", ["cameras[0]", "'a'"]),
        ("directives: [{add_model: {nam: a}}]", ["directives[0]", "'nam'"]),
        # YAML.
        ("{seed: 1, seed: 2}", ["seed", "twice"]),
        ("[1]", ["block", "list"]),
        ("{1: 2}", ["name must be text", "'1'"]),
    ],
)
def test_error_of_an_invalid_scenario_names_the_field_and_the_valid_values(
    text: str, words: list[str]
) -> None:
    with pytest.raises(ScenarioError) as error:
        parse_scenario(text)
    for text in words:
        assert text in str(error.value)


@pytest.mark.parametrize("text", ["", "\n", "# nothing but words\n"])
def test_empty_file_gives_all_defaults(text: str, tmp_path: Path) -> None:
    file = tmp_path / "empty.scenario.yaml"
    file.write_text(text)
    assert load_scenario(str(file)) == Scenario()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"task: &a {goal: *a}", "blocks or lists are nested too deeply"),
        (b"cameras: " + b"[" * 3000 + b"]" * 3000, "blocks or lists are nested too deeply"),
        (b"\x7fELF\xc5\x00", "can't decode byte 0xc5"),
    ],
)
def test_error_of_an_unreadable_scenario_names_the_file(
    content: bytes, words: str, tmp_path: Path
) -> None:
    file = tmp_path / "odd.scenario.yaml"
    file.write_bytes(content)
    with pytest.raises(ScenarioError, match=words) as caught:
        load_scenario(str(file))
    assert str(caught.value).startswith(file.name)


def test_unknown_scenario_lists_the_shipped_ones() -> None:
    with pytest.raises(ScenarioError) as error:
        load_scenario("tabletop_bok")
    assert all(name in str(error.value) for name in ["tabletop_bok", *shipped_scenarios()])


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("task.goal=[", "YAML"),
        ("perception=!GroundTruth", "write '!GroundTruth {}'"),
        ("task", "override"),
        ("task.clearance.deep=1", "block"),
    ],
)
def test_error_of_an_invalid_override_names_the_override(override: str, words: str) -> None:
    with pytest.raises(ScenarioError) as error:
        load_scenario("tabletop_box", [override])
    assert override.partition("=")[0] in str(error.value)
    assert words in str(error.value)


FILES = ["perception=!RecordedClouds {folder: f}", "task.demonstration=f", "inference.chain=f"]


def files(scenario: Scenario) -> set[str]:
    """Returns the files named in perception, task and inference."""
    assert isinstance(scenario.perception, RecordedClouds)
    return {scenario.perception.folder, *scenario.task.demonstration, scenario.inference.chain}


def test_files_in_a_scenario_are_relative_to_it(tmp_path: Path) -> None:
    path = tmp_path / "mine.scenario.yaml"
    path.write_text(
        "{perception: !RecordedClouds {folder: f}, task: {demonstration: f}, "
        "inference: !Verified {chain: f}}"
    )
    assert files(load_scenario(str(path))) == {str(tmp_path / "f")}


def test_files_in_overrides_are_relative_to_the_current_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert files(load_scenario("tabletop_box", FILES)) == {str(tmp_path / "f")}


def test_camera_pose_of_recorded_clouds_is_read_and_written() -> None:
    block = "!RecordedClouds {folder: f, X_WC: {translation: [1, 2, 3]}}"
    scenario = parse_scenario(f"perception: {block}")
    for one in (scenario, parse_scenario(scenario_text(scenario))):
        assert isinstance(one.perception, RecordedClouds)
        assert one.perception.X_WC is not None
        assert one.perception.X_WC.translation.tolist() == [1.0, 2.0, 3.0]
