"""What a motion does under each fault: `python -m drake_oa.studies.panda.faults`.

Each fault befalls a motion of the same scenario, on its own; the table says what was slowed,
held or stopped and why, what was touched, and what the motion without a fault took.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drake_oa.common.console import BAD_INPUT, complain
from drake_oa.common.files import check_outputs, replace_text, software_versions
from drake_oa.common.messages import HoldCause
from drake_oa.runs.motion_log import MotionEnd
from drake_oa.runs.report import motion_report
from drake_oa.runs.simulation import MotionInterruptedError, simulate
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.scenario import Scenario

SCENARIO = "tabletop_box"
GROUND_TRUTH = "perception=!GroundTruth {}"
SAFE = (MotionEnd.STOPPED, MotionEnd.HELD)
"""How a motion ends that was brought to rest short of the goal."""


@dataclass(frozen=True)
class Case:
    """A fault, and how a motion that it befalls should end.

    Attributes:
        fault: blocks for the scenario's `faults`.
        ends: one of these.
        overrides: further changes to the scenario.
    """

    fault: str
    ends: tuple[MotionEnd, ...] = (MotionEnd.GOAL,)
    overrides: tuple[str, ...] = ()

    def scenario(self, name: str = SCENARIO) -> Scenario:
        """The scenario with the fault."""
        return load_scenario(name, [*self.overrides, f"faults=[{self.fault}]"])


CASES: dict[str, Case] = {
    "none": Case(""),
    "camera stops": Case("!CameraDropout {start: 1.0, duration: 1.0}"),
    "camera lost": Case("!CameraDropout {start: 1.0, duration: 1.0e+3}", ends=SAFE),
    "frames of NaN": Case("!NanFrames {start: 1.0, duration: 1.0}"),
    "frames in a burst": Case("!FrameBurst {start: 1.0, duration: 0.4}"),
    "a frame without table": Case("!TableMissing {start: 1.0, frames: 1}"),
    "a second without table": Case("!TableMissing {start: 1.0, frames: 30}"),
    "goal blocked": Case("!GoalBlocked {start: 1.0, duration: 2.0}"),
    "goal blocked, near it": Case("!GoalBlocked {start: 3.5, duration: 2.0}"),
    "torque saturation": Case("!TorqueSaturation {start: 1.0, duration: 1.0, scale: 0.4}"),
    "model error": Case("!ModelError {}"),
    "start in contact": Case("!StartInContact {}"),
    "start in contact, seen": Case("!StartInContact {}", overrides=(GROUND_TRUTH,)),
}
"""Name -> what is run."""


def run_case(case: Case, name: str = SCENARIO) -> dict[str, Any]:
    """The report of a motion under a fault: see `drake_oa.runs.report.motion_report`.

    Further keys: `fault` (its block) and `overrides`. A simulation that raises is reported
    until then; its `stop_reason` says what it raised.

    Args:
        case: the fault.
        name: of the scenario, or its file.

    Raises:
        ScenarioError: naming the field that does not fit.
    """
    scenario = case.scenario(name)
    try:
        log = simulate(scenario)
    except MotionInterruptedError as error:
        if isinstance(error.__cause__, KeyboardInterrupt):
            raise KeyboardInterrupt from error
        log = error.log
    return {
        "fault": case.fault,
        "overrides": list(case.overrides),
        **motion_report(scenario, log),
    }


def what_it_did(report: dict[str, Any]) -> str:
    """What was slowed, held or stopped, when and why, in one line."""
    steps = [
        (item["time"], item["action"], item["reason"])
        for item in report["supervision"]
        if item["action"] != "run"
    ]
    steps += [
        (item["time"], "hold", item["note"])
        for item in report["events"]
        if item["hold"] not in (HoldCause.NONE, HoldCause.SUPERVISOR)
    ]
    said: list[str] = []
    reasons: set[tuple[str, str]] = set()
    for time, action, reason in sorted(steps):
        # The same cause is named by the supervisor, then by the policy.
        cause = reason.partition(" (")[0]
        if (action, cause) not in reasons:
            reasons.add((action, cause))
            said.append(f"{action} at {time:.2f} s: {cause}")
    return "; ".join(said) or "went on"


_COLUMNS = (
    "fault",
    "what the motion did",
    "ended by",
    "contacts made",
    "tool clearance [m]",
    "robot clearance [m]",
    "goal error [mm]",
    "duration [s]",
)


def markdown_table(reports: dict[str, dict[str, Any]]) -> str:
    """A row a fault; `contacts made` leaves out those that the motion started in."""
    lines = ["| " + " | ".join(_COLUMNS) + " |", "|" + "---|" * len(_COLUMNS)]
    for name, report in reports.items():
        cells = [
            f"{name}: `{report['fault']}`" if report["fault"] else name,
            what_it_did(report),
            report["stop_reason"],
            str(len(report["made_contacts"])),
            _metres(report["tool_clearance_min"]),
            _metres(report["robot_clearance_min"]),
            f"{1e3 * report['goal_error']:.2f}",
            f"{report['duration']:.2f}",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _metres(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit status.

    It is 1 if a motion made a contact or did not end as its case should, 2 for bad input.
    """
    parser = argparse.ArgumentParser(
        prog="python -m drake_oa.studies.panda.faults",
        description="Runs a scenario under each fault and prints a table in Markdown.",
    )
    names = f"run only this; may be repeated; of: {', '.join(CASES)}"
    parser.add_argument("--fault", action="append", choices=CASES, metavar="NAME", help=names)
    parser.add_argument("--scenario", default=SCENARIO, help="a shipped name or a file")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the reports there")
    options = parser.parse_args(arguments)
    try:
        check_outputs(options.json)
        reports = _reports(options.scenario, options.fault or CASES, options.json)
    except (ValueError, OSError) as error:
        complain(str(error))
        return BAD_INPUT
    print(markdown_table(reports))
    return int(not all(_ended_well(CASES[name], report) for name, report in reports.items()))


def _reports(scenario: str, names: Iterable[str], file: Path | None) -> dict[str, dict[str, Any]]:
    """The report of each, written as soon as it is there."""
    reports: dict[str, dict[str, Any]] = {}
    for name in names:
        reports[name] = run_case(CASES[name], scenario)
        print(f"{name}: {reports[name]['stop_reason']}", file=sys.stderr, flush=True)
        if file is not None:
            whole = {"scenario": scenario, "versions": software_versions(), "faults": reports}
            replace_text(file, json.dumps(whole, indent=1) + "\n")
    return reports


def _ended_well(case: Case, report: dict[str, Any]) -> bool:
    touched = report["made_contacts"] or report["self_contacts"]
    return not touched and report["ended"] in case.ends


if __name__ == "__main__":
    sys.exit(main())
