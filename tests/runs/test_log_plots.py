"""The figure of a logged run."""

from collections.abc import Callable

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure

from drake_oa.common.messages import EllipsoidSet
from drake_oa.runs.log_plots import Pause, draw_run, outline, pauses
from drake_oa.runs.motion_log import MotionLog, pack_ellipsoids
from drake_oa.runs.report import motion_metrics
from drake_oa.scenario.loading import load_scenario

FREE = load_scenario("free_space")


def drawn(**logs: MotionLog) -> Figure:
    figure = Figure(figsize=(14.0, 10.0), layout="constrained")
    metrics = {name: motion_metrics(FREE, log) for name, log in logs.items()}
    draw_run(figure, "title", FREE, logs, metrics)
    figure.canvas.draw()
    return figure


@given(
    center=st.tuples(*[st.floats(-1, 1)] * 3),
    axes=st.tuples(*[st.floats(0.01, 1)] * 3),
    turn=st.integers(0, 1000),
)
def test_an_outline_encloses_the_surface_and_touches_it(
    center: tuple[float, ...], axes: tuple[float, ...], turn: int
) -> None:
    rng = np.random.default_rng(turn)
    R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    P = np.linalg.qr(rng.normal(size=(3, 3)))[0][:2]
    rim = outline(np.array(center), R, np.array(axes), P)
    np.testing.assert_allclose(rim[0], rim[-1], atol=1e-12)
    for n in (np.array([1.0, 0.0]), np.array([0.6, -0.8])):
        # The support of the ellipsoid along a direction of the picture.
        support = n @ P @ center + np.linalg.norm(np.array(axes) * (R.T @ P.T @ n))
        reach = (rim @ n).max()
        assert reach <= support + 1e-12
        assert reach >= support - 0.005 * max(axes)


def test_pauses_are_those_of_the_supervisor_and_of_the_policy_once(
    straight_log: Callable[..., MotionLog],
) -> None:
    log = straight_log(
        supervision_time=np.array([1.0, 2.0, 3.0]),
        supervision_action=("slow", "hold", "run"),
        supervision_reason=("near", "camera stopped", ""),
        event_time=np.array([0.2, 0.5, 1.99, 2.01, 2.3, 3.4, 4.0]),
        event=("blocked", "", "unseen", "supervisor: camera stopped", "goal", "", "blocked"),
        event_hold=(
            *(["obstacles", "none", "obstacles", "supervisor", "obstacles", "none", "obstacles"]),
        ),
    )
    assert pauses(log) == [
        Pause(0.2, 0.5, "held", "blocked"),
        Pause(1.0, 2.0, "slow", "near"),
        Pause(2.0, 3.0, "hold", "camera stopped"),
        Pause(2.3, 3.4, "held", "goal"),
        Pause(4.0, 5.0, "held", "blocked"),
    ]
    assert pauses(straight_log()) == []


def texts(figure: Figure) -> str:
    return "\n".join(t.get_text() for part in figure.subfigs for t in part.findobj(match=has_text))


def has_text(artist: object) -> bool:
    return hasattr(artist, "get_text")


def test_what_is_drawn_has_units_and_says_why_it_paused(
    straight_log: Callable[..., MotionLog],
) -> None:
    log = straight_log(
        supervision_time=np.array([1.0, 2.0]),
        supervision_action=("hold", "stop"),
        supervision_reason=("camera stopped", "obstacle over the goal"),
    )
    figure = drawn(preplanned=straight_log(), modulated=log)
    shown = texts(figure)
    for expected in (
        "clearance [m]",
        "time [s]",
        "Δ = 0.15 m",
        "x [m]",
        "1.00 s, hold: camera stopped",
        "2.00 s, stop: obstacle over the goal",
    ):
        assert expected in shown
    for ax in (ax for part in figure.subfigs for ax in part.axes):
        assert "[" in ax.get_ylabel()


def test_a_log_of_one_instant_can_be_drawn(straight_log: Callable[..., MotionLog]) -> None:
    drawn(preplanned=straight_log(1))


def test_an_obstacle_that_moved_is_drawn_where_it_was_too(
    straight_log: Callable[..., MotionLog],
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
    log = straight_log(observation_time=0.1 * np.arange(20), **pack_ellipsoids(frames))
    above = drawn(modulated=log).subfigs[1].axes[0]
    assert len(above.patches) == 5 + 1
