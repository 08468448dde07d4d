"""Asked against kept clearance of the whole robot's runs, drawn from the folders they are in."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

_RUN = re.compile(
    r"(?P<suite>\w+?)(-\w+?)?(-seed\d+)?-scene\d+-(?P<method>\w+)-(depth|truth)\.json"
)
_COLORS = ("#edae49", "#00798c", "#d1495b", "#2e4057")
_MOST = 0.32
"""What is kept beyond this is drawn as this [m]."""
_CONTACT = 1e-3
"""Where what touched is drawn: a contact is a little deeper than nothing [m]."""


@dataclass(frozen=True)
class Kept:
    """One run: what its tool was asked for as far as start and goal leave it, and kept [m]."""

    suite: str
    feasible: float
    kept: float
    touched: bool


def read_kept(folder: Path, method: str) -> list[Kept]:
    """The runs of a method that a folder holds, without those that kept distance to nothing.

    Raises:
        ValueError: naming the folder, where it holds none, or the file that is no result.
    """
    found = []
    for path in sorted(folder.glob("*.json")):
        name = _RUN.fullmatch(path.name)
        if name is None or name["method"] != method:
            continue
        try:
            run = json.loads(path.read_text())["content"]
            feasible, kept = run["feasible_clearance"], run["tool_clearance_min"]
        except (json.JSONDecodeError, KeyError, TypeError) as error:
            raise ValueError(f"{path} is no result of an evaluation: {error}") from error
        if feasible is not None and kept is not None:
            found.append(Kept(name["suite"], feasible, kept, bool(run["contacts"])))
    if not found:
        raise ValueError(f"{folder}: no results of {method!r} are in it")
    return found


def draw_kept(runs: Mapping[str, Sequence[Kept]]) -> Figure:
    """A panel a suite: kept over feasible clearance of the tool, a colour each of the folders."""
    suites = list(dict.fromkeys(run.suite for some in runs.values() for run in some))
    columns = min(len(suites), 3)
    rows = -(-len(suites) // columns)
    figure = Figure(figsize=(4.2 * columns, 4.0 * rows + 0.4), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for suite, axis in zip(suites, axes, strict=False):
        for (label, some), color in zip(runs.items(), _COLORS, strict=False):
            _draw(axis, label, [run for run in some if run.suite == suite], color)
        axis.plot([0.0, _MOST], [0.0, _MOST], color="#888888", linewidth=0.8, zorder=0)
        axis.set_title(suite)
        axis.legend(loc="upper left", fontsize="small")
    for axis in axes[len(suites) :]:
        axis.set_visible(False)
    figure.supxlabel("asked clearance, as far as start and goal leave it [m]")
    figure.supylabel("kept by the tool [m]; crosses: something was touched")
    return figure


def _draw(axis: Axes, label: str, runs: Sequence[Kept], color: str) -> None:
    for touched, marker in ((False, "o"), (True, "x")):
        some = [run for run in runs if run.touched == touched]
        if some:
            axis.scatter(
                [run.feasible for run in some],
                [min(max(run.kept, -_CONTACT), _MOST) for run in some],
                s=14.0 if marker == "o" else 24.0,
                marker=marker,
                color=color,
                alpha=0.7,
                linewidths=0.0 if marker == "o" else 1.2,
                label=f"{label}{', touched' if touched else ''}: {len(some)}",
            )
