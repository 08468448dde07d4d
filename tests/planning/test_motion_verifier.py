"""Tests of the system that selects the whole-arm motion, with fixed inputs."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import LeafSystem

from drake_oa.common.files import package_file
from drake_oa.common.messages import (
    BoolArray,
    CouplingParameters,
    EllipsoidSet,
    FloatArray,
    HoldReason,
    PlannedMotion,
    PolicyState,
)
from drake_oa.geometry.collision_scene import CollisionGeometry, CollisionScene, geometries_of
from drake_oa.inference.config import Verified
from drake_oa.inference.regressor import ChainWeights, load_chain
from drake_oa.inference.regressor_chain import RegressorChain
from drake_oa.planning import motion_search, search
from drake_oa.planning.collision_model import group_distances
from drake_oa.planning.motion_verifier import MotionVerifier
from drake_oa.policy.config import Policy
from drake_oa.policy.dmp import Demonstration, Dmp, imitate, local_frame, minimum_jerk
from drake_oa.robot.arm import tool_poses
from drake_oa.route.cost_ring_selector import CostRingSelector
from drake_oa.route.cost_rings import Ring
from tests.builders import balls, fix
from tests.planning.arms import ArmAlone, box_at

CLEARANCE = 0.1
PAPER_CHAIN = "package://drake_oa/weights/paper_chain_running.safetensors"
QUICK = Verified(
    candidates=48,
    generations=8,
    refinement_generations=4,
    configurations=20_000,
    last_configurations=20_000,
)
GOAL = np.array([0.45, 0.4, 0.3])
TABLE = box_at([1.2, 2.0, 0.1], [0.8, 0.0, -0.1], "table")
BOX = box_at([0.12, 0.12, 0.3], [0.45, 0.02, 0.1], "box")


class Bench:
    """`MotionVerifier` alone, at the start of a motion in front of the arm."""

    def __init__(
        self,
        arm: ArmAlone,
        *geometries: CollisionGeometry,
        rings: Mapping[str, Ring] | None = None,
        weights: ChainWeights | None = None,
        parameters: Verified = QUICK,
    ) -> None:
        self.arm, self.start = arm, arm.X_WE[9:].copy()
        self.dmp: Dmp = imitate(*minimum_jerk(self.start, GOAL, duration=5.0))
        R_WE = arm.X_WE[:9].reshape(3, 3)
        self.search = motion_search.MotionSearch(
            self.dmp,
            CLEARANCE,
            arm.chain,
            arm.arm_spheres.arrays,
            parameters=parameters,
            policy=Policy(period=5.0 / 250, fade=0.1),
            orientation=lambda s: np.tile(R_WE, (len(s), 1, 1)),
            posture=lambda s: np.tile(arm.q, (len(s), 1)),
            protrusion=arm.arm_spheres.protrusion,
        )
        m = len(arm.q_full)
        self.system = MotionVerifier(
            self.search, tuple(arm.chain.q_index.tolist()), 2 * m, period=0.1
        )
        self.layers: dict[str, LeafSystem] = {
            "decision": CostRingSelector(CLEARANCE, extra_rings=rings)
        }
        if weights is not None:
            self.layers["coupling_parameters"] = RegressorChain(weights, CLEARANCE)
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.policy = PolicyState(
            p_WE=self.start, p_WS=self.start, p_WG=GOAL, R_WL=local_frame(self.start, GOAL)
        )
        self.fix = partial(fix, self.system, self.context)
        self.fix(goal=GOAL, robot_state=np.concatenate([arm.q_full, np.zeros(m)]))
        self.fix(policy_state=self.policy, ellipsoids_W=EllipsoidSet())
        self.see(*geometries)

    def see(self, *geometries: CollisionGeometry, stamp: float = 0.0) -> None:
        labels = tuple(geometry.label for geometry in geometries)
        self.scene = CollisionScene(stamp, geometries_of(list(geometries)), labels)
        self.fix(collision_scene_W=self.scene)

    def propose(self) -> None:
        """Evaluates the preceding systems, whose outputs are inputs of the verifier."""
        for output, system in self.layers.items():
            context = system.CreateDefaultContext()
            for name in ("policy_state", "ellipsoids_W", "goal"):
                port = self.system.GetInputPort(name)
                fix(system, context, **{name: port.Eval(self.context)})
            Simulator(system, context).Initialize()
            name = "route" if output == "decision" else output
            self.fix(**{name: system.GetOutputPort(output).Eval(context)})

    def decide(self, time: float = 0.0) -> CouplingParameters:
        """Returns the active command after a decision at a time [s]."""
        self.propose()
        if time == 0.0:
            self.simulator.Initialize()
        else:
            self.fix(policy_state=replace(self.policy, stamp=time))
            self.simulator.AdvanceTo(time + 0.002)
        return self.output("coupling_parameters")

    def output(self, name: str) -> object:
        return self.system.GetOutputPort(name).Eval(self.context)

    def number(self, name: str) -> float:
        return float(self.output(name)[0])

    @property
    def motion(self) -> PlannedMotion:
        return self.output("motion")

    def min_distances(self, q: FloatArray) -> FloatArray:
        """Computes minimum distances (2,) of tool and moving links along q (T, n) [m]."""
        spheres, geometries = self.arm.arm_spheres.arrays, self.scene.geometries
        is_tool, moves = spheres.of_tool[spheres.first[:-1]], spheres.group_joint >= 0
        d = group_distances(self.arm.chain, spheres, geometries, np.array(q), 0.0, np.inf)
        return np.array([d[of].min(initial=np.inf) for of in (is_tool, ~is_tool & moves)])


Make = Callable[..., Bench]


@pytest.fixture
def make(panda_arm: ArmAlone) -> Make:
    """Returns a function that makes a `Bench` of the Panda among collision geometries."""
    return partial(Bench, panda_arm)


def test_without_obstacles_the_nominal_motion_is_selected(make: Make) -> None:
    # The table is part of the environment.
    bench = make(replace(TABLE, name=-1))
    found, motion = bench.decide(), bench.motion
    assert (len(found.alpha), found.note, found.hold) == (0, "", HoldReason.NONE)
    assert found.tau == pytest.approx(1.0, abs=2e-3)
    assert bench.number("shortfall") == bench.number("clearance_reduction") == 0.0
    np.testing.assert_allclose(motion.p_WE[[0, -1]], [bench.start, GOAL], atol=2e-3)
    # The tool moves on a straight line, and the arm follows.
    assert np.ptp(motion.p_WE[:, [0, 2]], axis=0).max() < 1e-3
    tool_pose = tool_poses(bench.arm.chain, np.array(motion.q))[:, 9:]
    np.testing.assert_allclose(tool_pose, motion.p_WE, atol=2e-3)


def _ring(forbidden: Callable[[FloatArray], BoolArray], cost: float = 1.0) -> Ring:
    """Returns a cost ring with a cost for the directions (K, 3) in W that are forbidden."""
    return lambda scene: np.tile(
        np.where(forbidden(scene.directions_W), cost, 0.0), (len(scene.ellipsoids), 1)
    )


ELLIPSOIDS = balls([0.45, 0.02, 0.1], radius=[0.1, 0.1, 0.25])


def test_user_supplied_rings_affect_the_selected_side(make: Make) -> None:
    directions = []
    for rings in ({}, {"not_up": _ring(lambda omega: omega[:, 2] > 0.3)}):
        bench = make(BOX, rings=rings)
        bench.fix(ellipsoids_W=ELLIPSOIDS)
        assert bench.decide().note == ""
        assert bench.number("shortfall") == 0.0
        assert bench.output("candidates")[search.SEARCH] > 0
        sides = bench.output("sides")
        directions.append(sides.direction_W[0, 2])
        # The displayed side is that of the selected motion.
        normal = bench.output("coupling_parameters").normal_W[0]
        np.testing.assert_allclose(np.cross(sides.normal_W[0], normal), 0.0, atol=1e-12)
        assert set(sides.costs) == {"length", "table", *rings}
    up, sideways = directions
    assert sideways <= 0.3 < up


def test_the_rows_of_the_chain_are_one_candidate(make: Make) -> None:
    bench = make(BOX, weights=load_chain(package_file(PAPER_CHAIN)))
    bench.fix(ellipsoids_W=ELLIPSOIDS)
    bench.decide()
    assert bench.output("candidates")[search.CHAIN] == 1


def test_a_box_on_the_path_is_passed_at_the_requested_clearance(make: Make) -> None:
    bench = make()
    bench.fix(collision_scene_W=CollisionScene())
    # Nothing is selected before the first observation.
    assert bench.decide().tau == 0.0
    bench.see(TABLE, BOX)
    found = bench.decide(0.1)
    assert (len(found.alpha), found.note) == (1, "")
    assert found.tau > 1.0
    assert bench.number("shortfall") == 0.0
    np.testing.assert_allclose(bench.motion.p_WE[-1], GOAL, atol=2e-3)
    # Start and goal reduce the clearance of the table: check that of the box alone.
    bench.see(BOX)
    tool, links = bench.min_distances(bench.motion.q)
    assert CLEARANCE - 0.01 <= tool <= CLEARANCE + 0.02
    assert links >= QUICK.link_clearance - 0.01
    # The motion is unchanged while the scene is.
    bench.see(TABLE, BOX, stamp=0.1)
    again = bench.decide(0.2)
    for name in ("alpha", "psi", "kappa", "center_W", "normal_W"):
        np.testing.assert_array_equal(getattr(found, name), getattr(again, name))
    bench.see(TABLE, stamp=0.2)
    assert len(bench.decide(0.3).alpha) == 0


WALLS = [
    box_at([0.9, 0.04, 0.62], [0.75, 0.0, 0.21], "sill"),
    box_at([0.9, 0.04, 0.5], [0.75, 0.0, 1.25], "lintel"),
    box_at([0.04, 0.5, 1.5], [0.95, 0.0, 0.65], "side"),
]
"""Wall with a window through which the arm can reach in suitable configurations."""


def test_a_joint_space_path_is_imitated_without_a_feasible_term(
    make: Make, caplog: pytest.LogCaptureFixture
) -> None:
    bench = make(TABLE, *WALLS, parameters=replace(QUICK, generations=0))
    with caplog.at_level(logging.INFO, "drake_oa"):
        found = bench.decide()
    assert found.restart
    assert found.note == ""
    assert "motion restarts and imitates a joint-space path" in caplog.text
    demo: Demonstration = bench.output("demonstration")
    np.testing.assert_allclose(demo.q[0], bench.arm.q, atol=1e-9)
    tool_pose = tool_poses(bench.arm.chain, demo.q[-1:])[0]
    np.testing.assert_allclose(tool_pose, np.append(bench.arm.X_WE[:9], GOAL), atol=2e-3)
    bench.see(*WALLS)
    assert bench.min_distances(bench.motion.q).min() > 0.0


def test_a_note_explains_the_hold_without_a_feasible_motion(make: Make) -> None:
    # The goal is free, but enclosed by walls and a lid.
    sides = np.vstack([0.2 * np.eye(3)[:2], -0.2 * np.eye(3)[:2], [0.0, 0.0, 0.3]])
    around = [box_at(np.where(at, 0.02, 0.5), GOAL + at, "wall") for at in sides]
    bench = make(TABLE, *around)
    found = bench.decide()
    assert found.hold == HoldReason.OBSTACLES
    assert re.match("(no motion that clears|at its goal the arm would touch) wall", found.note)
    assert bench.number("shortfall") > 0.0
    # The motion continues without the walls.
    bench.see(TABLE, stamp=1.0)
    found = bench.decide(1.0)
    assert found.note == ""
    assert found.hold == HoldReason.NONE


def test_the_note_of_a_missed_goal_names_goal_and_obstacle(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    # With this tolerance every motion misses its goal.
    monkeypatch.setattr(motion_search, "MAX_GOAL_ERROR", -1.0)
    note = "no motion to the goal [0.45, 0.4, 0.3] m found: one ends 0 mm away"
    assert make().decide().note == note
    assert re.fullmatch(rf"{re.escape(note)}, \d+ mm from box", make(BOX).decide().note)


def test_a_tool_in_contact_may_retreat(make: Make, caplog: pytest.LogCaptureFixture) -> None:
    bench = make()
    # The motion starts 1 cm inside a plate behind the hand.
    hand = bench.start + [0.0, -0.115, 0.05]
    bench.see(box_at([0.3, 0.02, 0.1], hand + [0.0, 0.01, 0.0], "plate"))
    deep = bench.min_distances(bench.arm.q[None]).min()
    assert deep < -bench.arm.protrusion
    with caplog.at_level(logging.WARNING, "drake_oa"):
        found = bench.decide()
    assert "t=0.000 s: arm in contact with plate; only retreating motions allowed" in caplog.text
    assert found.note == ""
    assert bench.min_distances(bench.motion.q).min() >= deep - 1e-3
    assert bench.min_distances(bench.motion.q[-1:]).min() > CLEARANCE
    # Inside a block, every motion remains in contact.
    bench.see(box_at([0.3, 0.3, 0.3], bench.start, "block"), stamp=0.1)
    assert bench.decide(0.1).note == "no motion that clears block found"
