"""Reading scenarios: what is valid, and what each error says."""

import itertools
from pathlib import Path

import pytest

from drake_oa.common.config import ScenarioError
from drake_oa.perception.config import CameraNoise, DepthCamera, GroundTruth, RecordedClouds
from drake_oa.regulation.config import Paper, Verified
from drake_oa.safety.config import EvasionParameters
from drake_oa.scenario.loading import load_scenario, parse_scenario, scenario_text
from drake_oa.scenario.perception import GivenEllipsoids
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.shipped import shipped_scenarios

NAMES = [
    "bookshelf",
    "cage",
    "demonstrated_arc",
    "demonstrated_pour",
    "free_space",
    "gen3_box",
    "gen3_clutter",
    "long_tool",
    "moving_goal",
    "moving_obstacle",
    "no_table",
    "paper_box",
    "paper_clutter",
    "paper_guidance",
    "paper_irregular",
    "pushed_robot",
    "shelf_elbow",
    "sudden_obstacle",
    "tabletop_box",
    "tabletop_clutter",
    "tabletop_irregular",
    "tilted_goal",
    "two_cameras",
    "ur5e_box",
    "ur5e_clutter",
    "ur5e_moving",
    "vanishing_obstacle",
]


def test_ships_the_documented_scenarios() -> None:
    assert sorted(shipped_scenarios()) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_every_shipped_scenario_loads_and_says_what_it_is(name: str) -> None:
    assert load_scenario(name).description


def test_defaults_are_a_valid_scenario() -> None:
    scenario = parse_scenario("{}")
    assert scenario.task.clearance == 0.15
    assert isinstance(scenario.perception, GroundTruth)


def test_text_form_reads_back_to_the_same_scenario() -> None:
    scenario = load_scenario("tabletop_box")
    assert scenario_text(parse_scenario(scenario_text(scenario))) == scenario_text(scenario)


def test_perception_is_swapped_by_its_block_alone() -> None:
    for text, kind in (
        ("!GroundTruth {}", GroundTruth),
        ("!RecordedClouds {folder: somewhere}", RecordedClouds),
        ("!DepthCamera {}", DepthCamera),
        ("!GivenEllipsoids {}", GivenEllipsoids),
    ):
        scenario = load_scenario("tabletop_box", [f"perception={text}"])
        assert isinstance(scenario.perception, kind)


def test_the_shipped_cameras_are_noisy_and_need_not_be() -> None:
    for name in set(NAMES) - {"free_space"}:
        assert load_scenario(name).perception.noise == CameraNoise()
    assert load_scenario("tabletop_box", ["perception.noise=null"]).perception.noise is None
    changed = load_scenario("tabletop_box", ["perception.noise={far: 3.0, shadows: false}"])
    assert changed.perception.noise == CameraNoise(far=3.0, shadows=False)
    assert load_scenario("tabletop_box", ["perception=!DepthCamera {}"]).perception.noise is None


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ("{lateral: -1}", ["perception.noise.lateral", "[0, 2]", "pixel"]),
        ("{seed: 1}", ["perception.noise.seed is not a field", "axial_offset"]),
        ("{correlation_u: 0.5}", ["perception.noise.correlation_u", "whole number"]),
        ("{near: 3.0, far: 2.0}", ["perception.noise.near must be less than far"]),
        ("true", ["perception.noise", "expected a block"]),
    ],
)
def test_unfit_noise_is_named(value: str, words: list[str]) -> None:
    with pytest.raises(ScenarioError) as caught:
        load_scenario("tabletop_box", [f"perception.noise={value}"])
    assert all(word in str(caught.value) for word in words), caught.value


def test_regulation_is_verified_unless_the_paper_s_is_asked_for() -> None:
    assert isinstance(parse_scenario("{}").regulation, Verified)
    # Without a tag it is the default one.
    assert parse_scenario("regulation: {rounds: 7}").regulation == Verified(rounds=7)
    assert parse_scenario("regulation: !Verified {slack: 0.001}").regulation == Verified(slack=1e-3)
    paper = load_scenario("free_space", ["regulation=!Paper {}"])
    assert isinstance(paper.regulation, Paper)
    assert isinstance(parse_scenario(scenario_text(paper)).regulation, Paper)


def test_override_replaces_one_field() -> None:
    scenario = load_scenario("tabletop_box", ["task.clearance=0.1", "seed=7"])
    assert scenario.task.clearance == 0.1
    assert scenario.seed == 7


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("task: {clearence: 0.1}", ["task.clearence", "clearance", "duration"]),
        ("tusk: {}", ["tusk", "task", "perception"]),
        ("perception: !Sonar {}", ["perception", "!Sonar", "!DepthCamera", "!GroundTruth"]),
        ("task: {clearance: wide}", ["task.clearance", "number", "wide"]),
        ("task: {clearance: -0.1}", ["task.clearance", "-0.1", "(0, 2]"]),
        ("task: {clearance: .nan}", ["task.clearance", "nan"]),
        ("task: {goal: [1, 2]}", ["task.goal", "3 numbers", "2"]),
        ("task: {goal: [0.45, -0.45, 0.3]}", ["task.goal", "start"]),
        ("task: 3", ["task", "block"]),
        ("regulation: !Sampled {}", ["regulation", "!Sampled", "!Verified", "!Paper"]),
        ("regulation: Verified", ["regulation", "!Verified, !Paper", "'Verified'"]),
        ("regulation: {candidates: 4}", ["regulation.candidates", "8", "[8, 4096]"]),
        ("regulation: {rounds: 1.5}", ["regulation.rounds", "whole number"]),
        ("regulation: {slack: -1}", ["regulation.slack", "-1", "[0, 0.1] [m]"]),
        ("regulation: !Paper {rounds: 3}", ["regulation.rounds is not a field"]),
        ("policy: {guidance: sideways}", ["policy.guidance", "counterphase", "printed"]),
        ("policy: {n_basis: 3.5}", ["policy.n_basis", "whole number"]),
        ("seed: {a: 1}", ["seed", "whole number"]),
        ("robot: {q_seed: [0, .inf]}", ["robot.q_seed[1]", "finite"]),
        ("robot: {X_WB: {translation: [0, 0, 30]}}", ["robot.X_WB.translation[2]", "20] [m]"]),
        ("robot: {X_WB: {rpy: [0, 0]}}", ["robot.X_WB.rpy", "3 numbers"]),
        ("robot: {X_WB: {rotation: [0, 0, 0]}}", ["robot.X_WB.rotation", "translation, rpy"]),
        ("obstacles: [{rpy: [0, 0, 90]}]", ["obstacles[0].rpy[2]: 90 rad", "90 degrees are 1.571"]),
        ("robot: {annulus: {height: [0, 1]}}", ["robot.annulus: ", "2, 11 and 11"]),
        ("robot: {annulus: {height: [1, 0], inner: [0, 0], outer: [1, 1]}}", ["must increase"]),
        ("robot: {annulus: {height: [0, 1], inner: [0, 2], outer: [1, 1]}}", ["inner[1]: 2"]),
        ("robot: null", ["robot", "GivenEllipsoids"]),
        ("cameras: [{name: a}, {name: a}]", ["cameras", "'a'", "own name"]),
        ("cameras: [{width: 100000}]", ["cameras[0].width: 100000", "[1, 4096] [pixel]"]),
        ("cameras: [{}, {name: b, height: 0}]", ["cameras[1].height: 0", "[1, 4096] [pixel]"]),
        ("cameras: [{name: a, widht: 3}]", ["cameras[0].widht", "width"]),
        ("{cameras: [], perception: !DepthCamera {camera: left}}", ["'left'", "none"]),
        (
            "{cameras: [{name: a}], perception: !DepthCamera {cameras: [a, b]}}",
            ["perception.cameras[1]", "'b'", "cameras has a"],
        ),
        (
            "{cameras: [{name: a}], perception: !DepthCamera {cameras: [a, a]}}",
            ["perception.cameras[0]", "'a'", "twice"],
        ),
        (
            "{cameras: [{name: a}, {name: b}], "
            "perception: !DepthCamera {camera: b, cameras: [a, b]}}",
            ["perception.camera: 'b'", "exclude"],
        ),
        (
            "{cameras: [{name: a}, {name: b, fps: 15}], "
            "perception: !DepthCamera {cameras: [a, b]}}",
            ["cameras[1].fps: 'b' has 15, 'a' 10 [1/s]", "the same times"],
        ),
        (
            "{cameras: [{name: a}, {name: b, output_delay: 0.03}], "
            "perception: !DepthCamera {cameras: [a, b]}}",
            ["cameras[1].output_delay", "0.03", "[s]"],
        ),
        ("perception: !DepthCamera {cameras: left}", ["perception.cameras", "list"]),
        (
            "{cameras: [{name: camera}], perception: !DepthCamera {}, "
            "faults: [!CameraDropout {camera: left}]}",
            ["faults[0].camera", "'left'", "camera"],
        ),
        ("{seed: 1, seed: 2}", ["seed", "twice"]),
        ("perception: !RecordedClouds {segmentation: {voxle: 1}}", ["segmentation", "voxel"]),
        ("perception: !GivenEllipsoids {ellipsoids: [{semi_axes: [1, 0, 1]}]}", ["semi_axes"]),
        ("task: [", ["YAML"]),
        ("[1]", ["block", "list"]),
        ("just text", ["block", "just text"]),
        ("{1: 2}", ["name must be text", "'1'"]),
        ("task: {? [1, 2] : 3}", ["name must be text", "list"]),
        ("task: {? {a: b} : 3}", ["name must be text", "block"]),
        ("perception: !GroundTruth", ["perception", "!GroundTruth {}"]),
        ("task: !Foo {}", ["task", "no tag", "!Foo"]),
        ("robot: !Robot {}", ["robot", "no tag", "!Robot"]),
        ("cameras: [3]", ["cameras[0]: expected a block"]),
        ("cameras: [{width: abc}]", ["cameras[0].width", "whole number"]),
        ("cameras: [{X_PB: {translation: [a, 0, 0]}}]", ["cameras[0].X_PB.translation[0]"]),
        ("cameras: [{focal: !Fov {x: 1}}]", ["cameras[0].focal", "!Fov", "!FovDegrees"]),
        ("directives: [{add_model: {nam: a}}]", ["directives[0].add_model.nam", "file"]),
        (
            "perception: !DepthCamera {segmentation: {voxel: abc}}",
            ["perception.segmentation.voxel", "number"],
        ),
        ("task: {clearance: 1e-1}", ["task.clearance", "write 0.1 or 1.0e-1"]),
        ("task: {goal: [.inf, 0, 0]}", ["task.goal[0]: must be a finite number [m], not inf"]),
        ("evasion: {horizon: 0.5}", ["evasion.horizon", "0.7"]),
    ],
)
def test_bad_scenario_is_refused_with_the_field_and_what_is_valid(
    text: str, said: list[str]
) -> None:
    with pytest.raises(ScenarioError) as error:
        parse_scenario(text)
    for words in said:
        assert words in str(error.value)


def test_the_shortest_horizon_is_one_that_evasion_takes() -> None:
    evasion = parse_scenario("evasion: {horizon: 0.7}").evasion
    assert evasion is not None
    assert EvasionParameters(horizon=evasion.horizon).times[-1] == 0.7


@pytest.mark.parametrize("text", ["", "\n", "# nothing but words\n"])
def test_a_file_that_states_nothing_is_all_defaults(text: str, tmp_path: Path) -> None:
    file = tmp_path / "empty.scenario.yaml"
    file.write_text(text)
    assert load_scenario(str(file)) == Scenario()


def alias_bomb(levels: int = 9, width: int = 9) -> str:
    """Lists of aliases of lists: width^levels values in a few lines."""
    names = [f"a{k}" for k in range(levels)]
    rows = [f"a0: &a0 [{', '.join('x' * width)}]"]
    for inner, name in itertools.pairwise(names):
        rows.append(f"{name}: &{name} [{', '.join([f'*{inner}'] * width)}]")
    return "\n".join(rows) + "\n"


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (alias_bomb().encode(), "more than 100000 values"),
        (b"task: &a {goal: *a}", "more than 100000 values"),
        (b"cameras: " + b"[" * 3000 + b"]" * 3000, "too many blocks or lists within each other"),
        (b"\x7fELF\xc5\x00", "can't decode byte 0xc5"),
    ],
)
def test_a_file_that_is_no_scenario_is_named(content: bytes, said: str, tmp_path: Path) -> None:
    file = tmp_path / "odd.scenario.yaml"
    file.write_bytes(content)
    with pytest.raises(ScenarioError, match=said) as caught:
        load_scenario(str(file))
    assert str(caught.value).startswith(file.name)


def test_unknown_scenario_lists_the_shipped_ones() -> None:
    with pytest.raises(ScenarioError) as error:
        load_scenario("tabletop_bok")
    assert all(name in str(error.value) for name in ["tabletop_bok", *NAMES])


@pytest.mark.parametrize(
    ("override", "said"),
    [("task.goal=[", "YAML"), ("perception=!GroundTruth", "write '!GroundTruth {}'")],
)
def test_an_override_that_is_no_yaml_is_named(override: str, said: str) -> None:
    with pytest.raises(ScenarioError) as error:
        load_scenario("tabletop_box", [override])
    assert f"override '{override}'" in str(error.value)
    assert said in str(error.value)


def test_blocks_of_drake_are_read_with_their_tags() -> None:
    scenario = parse_scenario(
        """
        cameras:
        - focal: !FovDegrees {x: 58.0}
          renderer_class: !RenderEngineVtkParams {}
          X_PB: {translation: !GaussianVector {mean: [1, 2, 3], stddev: [0, 0, 0]}}
        - {name: other, center_x: null, renderer_class: RenderEngineVtk}
        """
    )
    assert [camera.name for camera in scenario.cameras] == ["preview_camera", "other"]


FILES = ["perception=!RecordedClouds {folder: f}", "task.demonstration=f", "regulation.weights=f"]


def files(scenario: Scenario) -> set[str]:
    assert isinstance(scenario.perception, RecordedClouds)
    return {scenario.perception.folder, *scenario.task.demonstration, scenario.regulation.weights}


def test_files_in_a_scenario_are_relative_to_it(tmp_path: Path) -> None:
    path = tmp_path / "mine.scenario.yaml"
    path.write_text(
        "{perception: !RecordedClouds {folder: f}, task: {demonstration: f}, "
        "regulation: !Paper {weights: f}}"
    )
    assert files(load_scenario(str(path))) == {str(tmp_path / "f")}


def test_files_in_overrides_are_relative_to_the_current_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert files(load_scenario("tabletop_box", FILES)) == {str(tmp_path / "f")}


def test_the_pose_of_a_recording_s_camera_is_read_and_written() -> None:
    block = "!RecordedClouds {folder: f, X_WC: {translation: [1, 2, 3]}}"
    scenario = parse_scenario(f"perception: {block}")
    for one in (scenario, parse_scenario(scenario_text(scenario))):
        assert isinstance(one.perception, RecordedClouds)
        assert one.perception.X_WC is not None
        assert one.perception.X_WC.translation.tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize("override", ["task", "=3", "task.clearance.deep=1"])
def test_bad_override_is_refused(override: str) -> None:
    with pytest.raises(ScenarioError, match=r"override|block"):
        load_scenario("tabletop_box", [override])
