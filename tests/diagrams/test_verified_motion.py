"""The verified motion, in the whole diagram: it is the one that was rolled out."""

import logging
import math
import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, LeafSystem, State

from drake_oa.common.messages import DECIDING, EllipsoidSet, FloatArray, PolicyState
from drake_oa.diagrams.avoidance import Layers, build_avoidance
from drake_oa.diagrams.policy import make_dmp
from drake_oa.geometry.ellipsoid import signed_distance
from drake_oa.regulation.regressor_chain import RegressorChain
from drake_oa.regulation.regulation import Regulation
from drake_oa.regulation.rollout import SpatialScenes, spatial_rollouts
from drake_oa.runs.motion_log import MotionLog
from drake_oa.runs.report import motion_report
from drake_oa.runs.simulation import LATEST_END, simulate
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.perception import GivenEllipsoids
from drake_oa.scenario.sources import given_ellipsoids
from tests.builders import balls

FRAME = 1.0 / 15.0
CLEARANCE = 0.15


class Observed(LeafSystem):
    """Ellipsoids as they are seen 15 times a second: a function of the frame's number."""

    def __init__(self, script: Callable[[int], EllipsoidSet]) -> None:
        super().__init__()
        self._script = script
        self._seen = self.DeclareAbstractState(Value(EllipsoidSet()))
        self.DeclareStateOutputPort("ellipsoids_W", self._seen)
        self.DeclareInitializationUnrestrictedUpdateEvent(self._look)
        self.DeclarePeriodicUnrestrictedUpdateEvent(FRAME, 0.0, self._look)

    def _look(self, context: Context, state: State) -> None:
        time = context.get_time()
        seen = replace(self._script(round(time / FRAME)), stamp=time)
        value: AbstractValue = state.get_mutable_abstract_state(self._seen)
        value.set_value(seen)


@pytest.fixture
def observed_motion() -> Callable[..., MotionLog]:
    """Runs `free_space`, from x = 0 to x = 1 m in 5 s, on what is seen."""

    def run(script: Callable[[int], EllipsoidSet], *overrides: str) -> MotionLog:
        seen = replace(Layers(), perception=lambda w, *_: w.add("perception", Observed(script)))
        return simulate(load_scenario("free_space", list(overrides)), layers=seen)

    return run


def kept(p_WE: FloatArray, true: EllipsoidSet) -> float:
    return float(signed_distance(p_WE[:, None], true.p_WO, true.R_WO, true.semi_axes).min())


def test_the_executed_motion_is_the_one_that_was_rolled_out() -> None:
    # Thinking would let the first motion begin later.
    scenario = load_scenario("free_space", ["thinking=null"])
    diagram = build_avoidance(scenario)
    simulator = Simulator(diagram)
    simulator.AdvanceTo(0.005)
    chain = diagram.GetSubsystemByName("regressor_chain")
    state = chain.GetMyContextFromRoot(simulator.get_context()).get_abstract_state()
    chosen: Regulation = state.get_value(0).get_value().regulation
    assert chosen.row >= 0
    assert isinstance(scenario.perception, GivenEllipsoids)
    true = given_ellipsoids(scenario.perception)
    dmp = make_dmp(scenario)
    # At rest at the origin, goal on the x axis.
    scene = SpatialScenes(
        p_WE=np.zeros((1, 3)),
        z_W=np.zeros((1, 3)),
        p_WG=np.array([scenario.task.goal]),
        R_WL=np.eye(3)[None],
        baseline=np.ones(1),
        p_WO=true.p_WO[None],
        R_WO=true.R_WO[None],
        semi_axes=true.semi_axes[None],
        v_WO=true.v_WO[None],
        asked_clearance=np.full((1, len(true)), CLEARANCE),
    )
    steps = 625
    found = spatial_rollouts(
        scene,
        [0],
        chosen.term[None],
        dmp=dmp,
        steps=steps,
        horizon=2.0,
        fade=scenario.policy.fade,
        tolerance=4e-4,
        keep_path=True,
    )
    assert found.kept_clearance[0] > CLEARANCE - 1e-3

    port = diagram.GetOutputPort("policy_state")
    states: list[PolicyState] = [port.Eval(simulator.get_context())]
    while -math.log(states[-1].phase) / dmp.alpha_k < found.steps[0] / steps:
        simulator.AdvanceTo(simulator.get_context().get_time() + scenario.policy.period)
        states.append(port.Eval(simulator.get_context()))
    s = np.array([-math.log(state.phase) / dmp.alpha_k for state in states[:-1]])
    known = np.arange(found.steps[0] + 1) / steps
    path = found.path[0, : len(known)]
    expected = np.column_stack([np.interp(s, known, path[:, i]) for i in range(3)])
    executed = np.array([state.p_WE for state in states[:-1]])
    np.testing.assert_allclose(executed, expected, atol=1e-3)
    assert kept(executed, true) == pytest.approx(found.kept_clearance[0], abs=1e-3)


def test_the_free_point_keeps_the_asked_clearance_and_no_more() -> None:
    scenario = load_scenario("free_space")
    log = simulate(scenario)
    report = motion_report(scenario, log)
    assert report["stop_reason"] == "goal"
    assert report["regulation"] == "Verified"
    assert CLEARANCE - 1e-3 < report["tool_clearance_min"] < CLEARANCE + 5e-3
    assert report["goal_error"] <= 1e-3
    assert report["believed_shortfall"] == 0.0
    planned = motion_report(scenario, simulate(scenario, modulated=False))
    assert planned["collisions"] > 0


def test_noise_on_what_is_seen_neither_flips_the_side_nor_touches(
    observed_motion: Callable[..., MotionLog],
) -> None:
    true = balls((0.5, 0.0, 0.0), radius=0.12)
    rng = np.random.default_rng(1)
    noise = 0.003 * rng.standard_normal((200, 2, 1, 3))

    def trembling(frame: int) -> EllipsoidSet:
        return replace(
            true,
            p_WO=true.p_WO + noise[frame, 0],
            semi_axes=true.semi_axes + noise[frame, 1],
        )

    log = observed_motion(trembling)
    assert log.stop_reason == "goal"
    assert log.event == (DECIDING, "")
    assert kept(log.desired_position, true) > CLEARANCE - 0.012
    # One side all the way: the motion is on one half of the local YZ plane.
    off = log.desired_position[:, 1:]
    side = off[np.linalg.norm(off, axis=1).argmax()]
    assert (off @ side > -1e-3).all()


def test_an_obstacle_that_appears_is_gone_round(
    observed_motion: Callable[..., MotionLog],
) -> None:
    obstacle = balls((0.65, 0.02, 0.0), radius=0.12)
    log = observed_motion(lambda frame: obstacle if frame >= 15 else balls())
    assert log.stop_reason == "goal"
    assert log.event == (DECIDING, "")
    assert log.shortfall.max() == 0.0
    since = log.t >= 15 * FRAME
    assert np.abs(log.desired_position[~since, 1:]).max() < 1e-9
    assert kept(log.desired_position[since], obstacle) > CLEARANCE - 2e-3


def test_what_cannot_be_kept_is_logged(
    observed_motion: Callable[..., MotionLog], caplog: pytest.LogCaptureFixture
) -> None:
    slab = replace(balls((0.5, 0.0, 0.0), radius=0.12), semi_axes=np.array([[0.05, 0.6, 0.6]]))
    with caplog.at_level(logging.WARNING, "drake_oa"):
        log = observed_motion(lambda frame: slab, "regulation.rounds=10")
    assert 1e-3 < log.shortfall.max() < CLEARANCE
    assert log.short_of[log.shortfall.argmax()] == 0
    assert "of the clearance to obstacle 0 cannot be kept" in caplog.text
    # What was told; or more, as a motion that is late is looked at again.
    assert kept(log.desired_position, slab) > CLEARANCE - log.shortfall.max() - 3e-3
    report = motion_report(load_scenario("free_space"), log)
    assert report["believed_shortfall"] == log.shortfall.max()


def test_a_wall_holds_the_motion(
    observed_motion: Callable[..., MotionLog], caplog: pytest.LogCaptureFixture
) -> None:
    wall = replace(balls((0.5, 0.0, 0.0), radius=0.12), semi_axes=np.array([[0.05, 3.0, 3.0]]))
    with caplog.at_level(logging.WARNING, "drake_oa"):
        log = observed_motion(lambda frame: wall, "regulation.rounds=5")
    assert log.stop_reason == "held for 5 s: no motion that clears obstacle 0 found"
    assert caplog.text.count("no motion that clears obstacle 0 found") == 1
    assert not log.desired_velocity[log.t > 0.3].any()


def test_the_chain_alone_is_the_paper_s() -> None:
    scenario = load_scenario("free_space", ["regulation=!Regressor {}"])
    log = simulate(scenario, duration=0.1)
    assert log.regulation == "Regressor"
    assert not log.shortfall.any()
    assert (log.short_of == -1).all()
    chain = build_avoidance(scenario).GetSubsystemByName("regressor_chain")
    assert isinstance(chain, RegressorChain)


def test_a_motion_ends_when_it_has_arrived_not_before() -> None:
    # A stiff spring overcomes a coarse forcing term after s = 1 and a slow phase does not fade.
    empty = "perception=!GivenEllipsoids {}"
    late = simulate(load_scenario("free_space", ["policy.n_basis=5", empty]))
    assert late.stop_reason == "goal"
    assert 1.0 < -math.log(late.phase[late.moving][-1]) / math.log(100.0) < LATEST_END
    assert np.linalg.norm(late.desired_position[-1] - [1.0, 0.0, 0.0]) < 1e-3
    slow = simulate(load_scenario("free_space", ["policy.n_basis=5", "policy.alpha_k=2.0", empty]))
    assert -math.log(slow.phase[slow.moving][-1]) / 2.0 == pytest.approx(LATEST_END, abs=0.02)
    left = slow.desired_position[slow.moving][-1] - [1.0, 0.0, 0.0]
    error = 1e3 * float(np.linalg.norm(left))
    assert error > 1.0
    said = re.fullmatch(r"goal missed by (\d+\.\d) mm at s = 2\.2", slow.stop_reason)
    assert said
    assert float(said[1]) == pytest.approx(error, rel=0.05)
