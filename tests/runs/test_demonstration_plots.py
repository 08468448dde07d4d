"""Demonstrations drawn, before a run and beside one."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.figure import Figure

from drake_oa.runs.demonstration_plots import draw_taught, taught
from drake_oa.runs.log_plots import draw_run
from drake_oa.runs.motion_log import MotionLog
from drake_oa.runs.report import motion_metrics
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.scenario import Scenario

DEMONSTRATIONS = "package://drake_oa/demonstrations"


def scenario(files: str) -> Scenario:
    return load_scenario("free_space", [f"task.demonstration={files}"])


def words(figure: Figure) -> str:
    return "\n".join(
        str(item.get_text()) for item in figure.findobj(lambda a: hasattr(a, "get_text"))
    )


def test_demonstrations_are_put_where_the_task_is() -> None:
    arcs = scenario("[" + ", ".join(f"{DEMONSTRATIONS}/arc_{n}.npz" for n in (1, 2, 3)) + "]")
    shown = taught(arcs)
    assert shown is not None
    assert [len(p) for p in shown.p] == [517, 491, 528]
    for p in shown.p:
        np.testing.assert_allclose(p[[0, -1]], [arcs.task.start, arcs.task.goal], atol=1e-9)
    np.testing.assert_allclose(shown.motion_p[-1], arcs.task.goal, atol=1e-3)
    # Repetitions differ by 2 cm and more; no tremor accounts for that.
    assert 5e-3 < max(shown.off) < 4e-2
    assert shown.motion_turn is None
    assert shown.turns == []
    assert taught(load_scenario("free_space")) is None


def test_what_is_taught_is_drawn_with_units_and_every_sample() -> None:
    pour = scenario(f"{DEMONSTRATIONS}/pour.csv")
    shown = taught(pour)
    assert shown is not None
    assert shown.off[0] < 2e-3
    assert shown.motion_turn is not None
    off = np.linalg.norm(shown.motion_turn.r[-1] - shown.turns[0].r[-1])
    assert off < np.radians(1.5)
    figure = Figure(figsize=(14.0, 10.0), layout="constrained")
    draw_taught(figure, "title", pour, shown)
    figure.canvas.draw()
    said = words(figure)
    for expected in (
        "1 demonstration of 5.94 s",
        "35 basis",
        "z [m]",
        "turn about x [deg]",
        "goal",
    ):
        assert expected in said
    panels = [ax for part in figure.subfigs for ax in part.axes]
    assert len(panels) == 8
    for ax in panels:
        assert any(len(line.get_xdata()) == len(shown.p[0]) for line in ax.lines)


def test_a_run_is_drawn_beside_what_was_shown(straight_log: Callable[..., MotionLog]) -> None:
    pour = scenario(f"{DEMONSTRATIONS}/pour.csv")
    shown, log = taught(pour), straight_log()
    figure = Figure(figsize=(14.0, 10.0), layout="constrained")
    draw_run(figure, "t", pour, {"modulated": log}, {"modulated": motion_metrics(pour, log)}, shown)
    figure.canvas.draw()
    assert {"demonstrated", "learnt"} <= set(words(figure).splitlines())
