"""Reading scenarios: what is valid, and what each error says."""

import pytest

from drake_oa.scenario import (
    DepthCamera,
    GivenEllipsoids,
    GroundTruth,
    RecordedClouds,
    ScenarioError,
    load_scenario,
    parse_scenario,
    scenario_text,
    shipped_scenarios,
)

NAMES = ["free_space", "tabletop_box", "tabletop_clutter", "tabletop_irregular"]


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
        ("policy: {guidance: sideways}", ["policy.guidance", "counterphase", "printed"]),
        ("policy: {n_basis: 3.5}", ["policy.n_basis", "whole number"]),
        ("seed: {a: 1}", ["seed", "whole number"]),
        ("robot: {q_seed: [0, 0]}", ["robot.q_seed", "7"]),
        ("robot: null", ["robot", "GivenEllipsoids"]),
        ("cameras: [{name: a}, {name: a}]", ["cameras", "'a'", "own name"]),
        ("cameras: [{name: a, widht: 3}]", ["cameras[0].widht", "width"]),
        ("{cameras: [], perception: !DepthCamera {camera: left}}", ["'left'", "none"]),
        ("{seed: 1, seed: 2}", ["seed", "twice"]),
        ("perception: !RecordedClouds {segmentation: {voxle: 1}}", ["segmentation", "voxel"]),
        ("perception: !GivenEllipsoids {ellipsoids: [{semi_axes: [1, 0, 1]}]}", ["semi_axes"]),
        ("task: [", ["YAML"]),
    ],
)
def test_bad_scenario_is_refused_with_the_field_and_what_is_valid(
    text: str, said: list[str]
) -> None:
    with pytest.raises(ScenarioError) as error:
        parse_scenario(text)
    for words in said:
        assert words in str(error.value)


def test_unknown_scenario_lists_the_shipped_ones() -> None:
    with pytest.raises(ScenarioError) as error:
        load_scenario("tabletop_bok")
    assert all(name in str(error.value) for name in ["tabletop_bok", *NAMES])


@pytest.mark.parametrize("override", ["task", "=3", "task.clearance.deep=1"])
def test_bad_override_is_refused(override: str) -> None:
    with pytest.raises(ScenarioError, match=r"override|block"):
        load_scenario("tabletop_box", [override])
