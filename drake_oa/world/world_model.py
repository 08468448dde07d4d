"""Models of a scenario in the simulated plant: functions that add the robot, the models of Drake's
model directives, and the obstacles.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

from pydrake.multibody.parsing import (
    FlattenModelDirectives,
    LoadModelDirectives,
    ModelDirective,
    ModelDirectives,
    PackageMap,
    ProcessModelDirectives,
)
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex

from drake_oa.common.config import ScenarioError, field_errors
from drake_oa.robot.formats.model_file import add_installed_package, check_links, named_warnings
from drake_oa.robot.plant import add_robot, known_packages, make_parser
from drake_oa.scenario.scenario import Scenario, robot_of
from drake_oa.world.obstacles import add_obstacle


def add_world(plant: MultibodyPlant, scenario: Scenario) -> ModelInstanceIndex:
    """Adds the models of a scenario to a plant: the robot, the models of its Drake model
    directives, and its obstacles.

    Args:
        plant: plant that is registered with a scene graph and not finalized.
        scenario: scenario with a robot.

    Returns:
        Model instance of the robot.

    Raises:
        ScenarioError: naming the invalid field of the scenario.
    """
    robot = add_robot(plant, robot_of(scenario))
    parser = make_parser(plant)
    with field_errors("directives", RuntimeError):
        _check_directives(scenario.directives, parser.package_map())
        with named_warnings():
            ProcessModelDirectives(ModelDirectives(directives=scenario.directives), parser)
    for obstacle in scenario.obstacles:
        add_obstacle(plant, obstacle)
    return robot


def flat_directives(directives: list[ModelDirective]) -> list[ModelDirective]:
    """Returns Drake model directives in which each `add_directives` is replaced by the directives
    of the included file.

    Raises:
        ScenarioError: for a directive with an invalid file or model.
    """
    packages = known_packages()
    _check_directives(directives, packages)
    flat = FlattenModelDirectives(ModelDirectives(directives=directives), packages)
    return list(flat.directives)


def _check_directives(
    directives: Sequence[ModelDirective], packages: PackageMap, chain: tuple[Path, ...] = ()
) -> None:
    """Checks model directives, and the files that they include, before Drake reads them.

    Args:
        directives: directives of the scenario, or of the last file in `chain`.
        packages: package map of the parser; installed Python packages that the URLs of the
            directives name are added to it.
        chain: files that include the directives, outermost file first; empty for directives of the
            scenario.

    Raises:
        ScenarioError: for a file that includes itself, a relative file name in an included file, or
            an invalid model.
    """
    where = f"directives: '{chain[-1]}'" if chain else "directives"
    for directive in directives:
        block = directive.add_model or directive.add_directives
        if block is None:
            continue
        if "://" not in block.file:
            raise ScenarioError(
                f"{where}: '{block.file}' must be a URL, package://NAME/... or file:///...; "
                "only file names in the scenario itself can be relative"
            )
        add_installed_package(packages, block.file, where)
        file = Path(packages.ResolveUrl(block.file))
        if directive.add_model is not None:
            # Drake rejects files that are no XML, with its own error.
            with contextlib.suppress(ElementTree.ParseError, OSError):
                check_links(ElementTree.parse(file).getroot(), file, where)
        elif file in chain:
            names = " -> ".join(map(str, (*chain, file)))
            raise ScenarioError(f"directives: files must not include themselves: {names}")
        else:
            nested = LoadModelDirectives(str(file)).directives
            _check_directives(nested, packages, (*chain, file))
