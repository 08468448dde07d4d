"""Checks of model files and directives before Drake reads them."""

from pathlib import Path

import pytest
from pydrake.multibody.plant import MultibodyPlant

from drake_oa.common.config import ScenarioError
from drake_oa.scenario.loading import parse_scenario
from drake_oa.world.world_model import add_world

SDF = """<sdf version="1.9"><model name="m"><link name="lamp">{mass}
<collision name="c"><geometry>{shape}</geometry></collision></link></model></sdf>"""
BOX = "<box><size>1 1 {z}</size></box>"
MASS = "<inertial><mass>-3</mass></inertial>"
NESTED = "directives:\n- add_directives: {{file: {} }}\n"


def error_of(folder: Path, directive: str) -> str:
    """Returns the text of the error for a directive."""
    scenario = parse_scenario(f"directives: [{directive}]", folder=folder)
    with pytest.raises(ScenarioError) as caught:
        add_world(MultibodyPlant(0.001), scenario)
    return str(caught.value)


@pytest.mark.parametrize(
    ("mass", "shape", "words"),
    [
        ("", BOX.format(z=0), "link 'lamp': size of <box> must be positive [m], not 1 1 0"),
        (MASS, BOX.format(z=1), "link 'lamp': <mass> must be at least 0 kg, not -3"),
    ],
)
def test_error_of_an_invalid_model_names_file_and_link(
    tmp_path: Path, mass: str, shape: str, words: str
) -> None:
    (tmp_path / "m.sdf").write_text(SDF.format(mass=mass, shape=shape))
    text = error_of(tmp_path, "add_model: {name: obstacle_m, file: m.sdf}")
    assert text.startswith("directives: ")
    assert "m.sdf'" in text
    assert words in text


def test_error_of_directives_that_include_themselves_names_the_files(tmp_path: Path) -> None:
    for name, other in (("a", "b"), ("b", "a")):
        text = NESTED.format((tmp_path / f"{other}.dmd.yaml").as_uri())
        (tmp_path / f"{name}.dmd.yaml").write_text(text)
    a, b = tmp_path / "a.dmd.yaml", tmp_path / "b.dmd.yaml"
    assert f"{a} -> {b} -> {a}" in error_of(tmp_path, "add_directives: {file: a.dmd.yaml}")


def test_error_of_a_relative_name_in_nested_directives_names_the_file(tmp_path: Path) -> None:
    (tmp_path / "a.dmd.yaml").write_text(NESTED.format("b.dmd.yaml"))
    text = error_of(tmp_path, "add_directives: {file: a.dmd.yaml}")
    assert f"'{tmp_path / 'a.dmd.yaml'}': 'b.dmd.yaml' must be a URL" in text
