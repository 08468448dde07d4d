"""Runs that are compared with stored results: names, arguments, and contents of results."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydrake.common.yaml import yaml_dump

from drake_oa.common.config import read_yaml
from drake_oa.evaluation.cameras import ONE_CAMERA, with_workspace_cameras
from drake_oa.evaluation.mbm.suite import mbm_suites
from drake_oa.evaluation.panda.evaluation import Criteria, run_text
from drake_oa.evaluation.panda.scene_arm import DEFAULT_SCENARIO, ELBOW_SCENARIO, base_scenario
from drake_oa.evaluation.panda.scenes import MOVING_KINDS
from drake_oa.evaluation.paper_tables import (
    TRIAL_KINDS,
    evaluate_novel,
    table_one_metrics,
    table_two_metrics,
)
from drake_oa.evaluation.scenes.evaluation import evaluate
from drake_oa.evaluation.scenes.methods import load_methods
from drake_oa.evaluation.scenes.suites import SUITES, draw_scenes
from drake_oa.perception.config import GroundTruth
from drake_oa.runs.report import motion_report
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario, parse_scenario, scenario_text
from drake_oa.scenario.shipped import missing_package, shipped_scenarios

SCENES = Path(__file__).with_name("scenes")
"""Folder of the stored random scenes."""
ARCHIVE = Path(__file__).parents[3] / "shared/problems/motionbenchmaker_panda.tar.bz2"
"""Problems of MotionBenchMaker, which are not part of this repository."""

_SEEDS = range(3)
"""Seeds of the runs of shipped scenarios from their own perception."""
_PANDA_SUITES = {
    "tabletop": DEFAULT_SCENARIO,
    "clutter6": DEFAULT_SCENARIO,
    "elbow": ELBOW_SCENARIO,
    "moving": DEFAULT_SCENARIO,
}
"""Suite -> shipped scenario whose camera, robot and parameters the scenes have."""
_PROBLEMS = 5
"""Number of MotionBenchMaker problems of each set."""
_TRIALS = 11
"""Number of trials of each kind of obstacles in the paper's Table III."""
_POINT_SUITES = ("novel", "hit")
"""Suites of synthetic scenes."""
_POINT_SCENES = 200
"""Number of scenes of each synthetic suite."""
_POINT_METHODS = ("paper", "verified")
"""Methods in synthetic scenes."""
_TABLE_SCENES = 4000
"""Number of scenes of the paper's Table II."""

_REPORTED = ("tool_clearance_min", "robot_clearance_min", "goal_error", "duration")
"""Keys of a report that are stored."""
_DIGITS = 6
"""Number of decimals of stored values."""

CRITERIA = Criteria()
"""Conditions of success in random scenes and trials."""

Call = tuple[str, tuple[Any, ...]]
"""Name of a function of this module and its arguments."""


def scenario_calls() -> dict[str, Call]:
    """Returns the runs of every shipped scenario with a robot whose model is installed."""
    calls: dict[str, Call] = {}
    for name, path in shipped_scenarios().items():
        if missing_package(path) or load_scenario(name).robot is None:
            continue
        for seed in _SEEDS:
            calls[f"{name}/seed{seed}"] = ("run_shipped", (name, seed, False))
        calls[f"{name}/truth"] = ("run_shipped", (name, 0, True))
    return calls


def suite_calls() -> dict[str, Call]:
    """Returns the robot's runs in random scenes, benchmark problems and trials of Table III."""
    calls: dict[str, Call] = {}
    for suite in _PANDA_SUITES:
        for number, scene in enumerate(_stored_scenes(suite)):
            calls[f"{suite}/{number}"] = ("run_scene", (suite, scene))
    if ARCHIVE.is_file():
        for suite in mbm_suites(ARCHIVE, None, (), ("verified",), _PROBLEMS):
            for number, draw in suite.drawings.items():
                calls[f"mbm-{suite.kind}/{number}"] = ("run_problem", (draw(),))
    for kind in TRIAL_KINDS:
        for trial in range(_TRIALS):
            calls[f"table3-{kind}/{trial}"] = ("run_trial", (f"paper_{kind}", trial))
    return calls


def point_calls() -> dict[str, Call]:
    """Returns the runs of each method on the synthetic suites."""
    return {
        f"{suite}-{method}": ("run_points", (suite, method))
        for suite in _POINT_SUITES
        for method in _POINT_METHODS
    }


def table_calls() -> dict[str, Call]:
    """Returns the computations of the paper's Tables I and II."""
    return {"table1": ("first_table", ()), "table2": ("second_table", ())}


def carry_out_call(name: str, arguments: tuple[Any, ...]) -> dict[str, Any]:
    """Carries out a call of a function of this module; returns JSON data."""
    logging.disable(logging.ERROR)
    result = globals()[name](*arguments)
    return json.loads(json.dumps(result, default=float))


def run_shipped(name: str, seed: int, truth: bool) -> dict[str, Any]:
    """Simulates the avoiding motion of a shipped scenario to its end."""
    scenario = load_scenario(name)
    scenario.seed = seed
    if truth:
        scenario = replace(scenario, perception=GroundTruth())
    return _summary(motion_report(scenario, simulate(scenario)))


def run_scene(suite: str, scene: Mapping[str, Any]) -> dict[str, Any]:
    """Simulates the verified method on a stored scene, from depth."""
    data = read_yaml(scenario_text(base_scenario(_PANDA_SUITES[suite])))
    data["task"] |= {"start": scene["start"], "goal": scene["goal"]}
    data |= {"seed": scene["seed"], "obstacles": scene["obstacles"]}
    scenario = parse_scenario(yaml_dump(data))
    if suite in MOVING_KINDS:
        scenario = with_workspace_cameras(scenario, ONE_CAMERA)
    return _run(scenario_text(scenario), "verified", "depth")


def run_problem(text: str) -> dict[str, Any]:
    """Simulates the verified method on a problem of MotionBenchMaker, from ground truth."""
    (criteria,) = {suite.criteria for suite in mbm_suites(ARCHIVE, None, ("box",), (), 1)}
    return _run(text, "verified", "truth", criteria)


def run_trial(name: str, seed: int) -> dict[str, Any]:
    """Simulates a trial of the paper's Table III, from depth."""
    scenario = load_scenario(name)
    scenario.seed = seed
    return _run(scenario_text(scenario), "paper", "depth")


def run_points(suite: str, method: str) -> dict[str, Any]:
    """Runs a method on the scenes of a synthetic suite; returns a list for each quantity."""
    scenes = draw_scenes(suite, _POINT_SCENES, 0)
    of_method = load_methods([method])[method]
    result = evaluate(method, of_method, scenes, SUITES[suite].settings).of()
    success = ~result.collided & ~result.is_short
    return {
        "success": success.tolist(),
        "collided": result.collided.tolist(),
        "clearance": result.min_clearance.round(_DIGITS).tolist(),
        "path_ratio": result.path_ratio.round(_DIGITS).tolist(),
    }


def first_table() -> dict[str, Any]:
    """Returns the errors of the paper's Table I."""
    return {file: chain["networks"] for file, chain in table_one_metrics()["chains"].items()}


def second_table() -> dict[str, Any]:
    """Returns the metrics of the paper's Table II."""
    scenes = draw_scenes("demo", _TABLE_SCENES, 0)
    metrics = table_two_metrics(evaluate_novel(scenes), scenes, 0)
    return {
        f"{row['baseline']:g} m": {key: row[key] for key in row["agrees"]}
        for row in metrics["by_baseline"]
    }


def _stored_scenes(suite: str) -> list[dict[str, Any]]:
    """Loads the stored scenes of a suite."""
    scenes: list[dict[str, Any]] = json.loads((SCENES / f"{suite}.json").read_text())
    return scenes


def _summary(report: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the stored quantities of a report."""
    metrics = {key: report[key] for key in _REPORTED}
    rounded = {k: None if v is None else round(float(v), _DIGITS) for k, v in metrics.items()}
    contacts = sorted([*report["contacts"], *report["self_contacts"]])
    return {"ended": report["ended"], "contacts": contacts, **rounded}


def _run(text: str, method: str, perception: str, criteria: Criteria = CRITERIA) -> dict[str, Any]:
    """Runs a scenario and returns the stored quantities of the result."""
    result = run_text(text, method, perception, None, criteria)
    success = {"success": result["outcome"] == "success", "reason": result["reason"]}
    return success | _summary(result)
