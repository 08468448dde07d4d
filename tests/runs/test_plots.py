"""Figures of logged runs and of demonstrations."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from drake_oa.common.messages import EllipsoidSet
from drake_oa.runs.motion_log import MotionLog, pack_ellipsoids
from drake_oa.runs.plots import (
    Pause,
    outline,
    pauses,
    place_demonstrations,
    plot_demonstrations,
    plot_run,
)
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.scenario import Scenario

DEMONSTRATIONS = "package://drake_oa/demonstrations"
FREE = load_scenario("free_space")


def demonstrated(files: str) -> Scenario:
    return load_scenario("free_space", [f"task.demonstration={files}"])


def is_image(path: Path) -> bool:
    return path.read_bytes().startswith(b"\x89PNG") and path.stat().st_size > 10_000


def test_an_outline_encloses_the_surface_and_touches_it() -> None:
    rng = np.random.default_rng(0)
    R, Q = (np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(2))
    center, axes, P = np.array([0.3, -0.2, 0.5]), np.array([0.1, 0.4, 0.02]), Q[:2]
    rim = outline(center, R, axes, P)
    for n in (np.array([1.0, 0.0]), np.array([0.6, -0.8])):
        # The support of the ellipsoid along a direction of the picture.
        support = n @ P @ center + np.linalg.norm(axes * (R.T @ P.T @ n))
        assert support - 0.005 * max(axes) <= (rim @ n).max() <= support + 1e-12


def test_pauses_are_those_of_the_supervisor_and_of_the_policy_once(
    straight_log: Callable[..., MotionLog],
) -> None:
    log = straight_log(
        supervision_time=np.array([1.0, 2.0, 3.0]),
        supervision_action=("slow", "hold", "run"),
        supervision_reason=("near", "camera stopped", ""),
        event_time=np.array([0.2, 0.5, 2.01, 2.3, 3.4, 4.0]),
        event=("blocked", "", "supervisor: camera stopped", "goal", "", "blocked"),
        event_hold=("obstacles", "none", "supervisor", "obstacles", "none", "obstacles"),
    )
    assert pauses(log) == [
        Pause(0.2, 0.5, "held", "blocked"),
        Pause(1.0, 2.0, "slow", "near"),
        Pause(2.0, 3.0, "hold", "camera stopped"),
        Pause(2.3, 3.4, "held", "goal"),
        Pause(4.0, 5.0, "held", "blocked"),
    ]
    assert pauses(straight_log()) == []


def test_demonstrations_are_placed_between_start_and_goal() -> None:
    arcs = demonstrated("[" + ", ".join(f"{DEMONSTRATIONS}/arc_{n}.npz" for n in (1, 2, 3)) + "]")
    shown = place_demonstrations(arcs)
    assert shown is not None
    assert [p.shape for p in shown.samples] == [(517, 3), (491, 3), (528, 3)]
    for p in shown.samples:
        np.testing.assert_allclose(p[[0, -1]], [arcs.task.start, arcs.task.goal], atol=1e-9)
    np.testing.assert_allclose(shown.motion[-1], arcs.task.goal, atol=1e-3)
    # Repetitions differ by 2 cm and more; no tremor accounts for that.
    assert 5e-3 < max(shown.errors) < 4e-2
    assert place_demonstrations(FREE) is None


def test_demonstrations_are_drawn_alone_and_beside_a_run(
    straight_log: Callable[..., MotionLog], tmp_path: Path
) -> None:
    pour = demonstrated(f"{DEMONSTRATIONS}/pour.csv")
    shown, log = place_demonstrations(pour), straight_log()
    assert shown is not None
    assert shown.errors[0] < 2e-3
    assert np.linalg.norm(shown.motion[-1, 3:] - shown.samples[0][-1, 3:]) < 1.5
    plot_demonstrations(tmp_path / "alone.png", "title", pour, shown)
    plot_run(tmp_path / "run.png", "t", pour, {"modulated": log}, shown)
    assert all(is_image(tmp_path / name) for name in ("alone.png", "run.png"))


@pytest.mark.parametrize("instants", [1, 51])
def test_a_run_is_drawn_with_pauses_and_moved_obstacles(
    straight_log: Callable[..., MotionLog], instants: int, tmp_path: Path
) -> None:
    frames = [
        EllipsoidSet(
            stamp=0.1 * k,
            p_WO=np.array([[0.5, 0.02 * k, 0.0], [0.2, 0.3, 0.0]]),
            R_WO=np.tile(np.eye(3), (2, 1, 1)),
            semi_axes=np.full((2, 3), 0.1),
            v_WO=np.zeros((2, 3)),
            ids=np.array([4, 9]),
        )
        for k in range(20)
    ]
    log = straight_log(
        instants,
        supervision_time=np.array([1.0, 2.0]),
        supervision_action=("hold", "stop"),
        supervision_reason=("camera stopped", "obstacle over the goal"),
        observation_time=0.1 * np.arange(20),
        **pack_ellipsoids(frames),
    )
    logs = {"preplanned": straight_log(instants), "modulated": log}
    plot_run(tmp_path / "run.png", "title", FREE, logs)
    assert is_image(tmp_path / "run.png")
