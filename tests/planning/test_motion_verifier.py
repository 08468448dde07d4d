"""The system that chooses the motion of the whole arm, its inputs fixed."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator

from drake_oa.common.files import package_file
from drake_oa.common.messages import (
    BoolArray,
    CouplingParameters,
    EllipsoidSet,
    FloatArray,
    HoldCause,
    IntArray,
    PlannedMotion,
    PolicyState,
)
from drake_oa.geometry.solids import Solid, SolidScene, solids_of
from drake_oa.planning import search
from drake_oa.planning.arm_world import group_distances
from drake_oa.planning.motion_search import MotionSearch, SelectedMotion, Sight
from drake_oa.planning.motion_verifier import MotionVerifier
from drake_oa.policy.config import Policy
from drake_oa.policy.coupling import ALPHA, NORMAL
from drake_oa.policy.dmp import Demonstration, Dmp, imitate, local_frame, minimum_jerk
from drake_oa.policy.rollout import ToolRollouts
from drake_oa.regulation.config import Verified
from drake_oa.regulation.proposals import ALPHA as LOG_ALPHA
from drake_oa.regulation.proposals import ANGLE, ProposalNetwork
from drake_oa.regulation.regressor import ChainWeights, load_chain
from drake_oa.regulation.regressor_chain import RegressorChain
from drake_oa.robot.arm import tool_poses
from drake_oa.route.cost_ring_selector import CostRingSelector
from drake_oa.route.cost_rings import Ring
from tests.builders import balls
from tests.planning.arms import ArmAlone, box_at

CLEARANCE = 0.1
PAPER_CHAIN = "package://drake_oa/weights/paper_chain_running.safetensors"
QUICK = Verified(
    candidates=48, rounds=8, polish=4, configurations=20_000, last_configurations=20_000
)
GOAL = np.array([0.45, 0.4, 0.3])
TABLE = box_at([1.2, 2.0, 0.1], [0.8, 0.0, -0.1], "table")
BOX = box_at([0.12, 0.12, 0.3], [0.45, 0.02, 0.1], "box")


class Bench:
    """The system alone at the start of a motion across the arm's front."""

    def __init__(
        self,
        arm: ArmAlone,
        proposer: ProposalNetwork,
        *solids: Solid,
        rings: Mapping[str, Ring] | None = None,
        weights: ChainWeights | None = None,
    ) -> None:
        self.arm, self.start = arm, arm.X_WE[9:].copy()
        self.dmp: Dmp = imitate(*minimum_jerk(self.start, GOAL, duration=5.0))
        R_WE = arm.X_WE[:9].reshape(3, 3)
        self.search = MotionSearch(
            self.dmp,
            CLEARANCE,
            arm.chain,
            arm.covered.arrays,
            parameters=QUICK,
            policy=Policy(period=5.0 / 250, fade=0.1),
            orientation=lambda s: np.tile(R_WE, (len(s), 1, 1)),
            posture=lambda s: np.tile(arm.q, (len(s), 1)),
            overshoot=arm.covered.overshoot,
        )
        m = len(arm.q_full)
        self.system = MotionVerifier(
            self.search, tuple(arm.chain.q_index.tolist()), 2 * m, period=0.1
        )
        self.layers = (
            RegressorChain(weights, CLEARANCE, proposals=proposer, dmp=self.dmp),
            CostRingSelector(CLEARANCE, extra_rings=rings),
        )
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        for name, value in (
            ("goal", GOAL),
            ("robot_state", np.concatenate([arm.q_full, np.zeros(m)])),
        ):
            self.system.GetInputPort(name).FixValue(self.context, value)
        self.policy = PolicyState(
            p_WE=self.start, p_WS=self.start, p_WG=GOAL, R_WL=local_frame(self.start, GOAL)
        )
        self.fix(policy_state=self.policy, ellipsoids_W=EllipsoidSet())
        self.see(*solids)

    def fix(self, **inputs: object) -> None:
        for name, value in inputs.items():
            self.system.GetInputPort(name).FixValue(self.context, Value(value))

    def see(self, *solids: Solid, stamp: float = 0.0) -> None:
        labels = tuple(solid.label for solid in solids)
        self.scene = SolidScene(stamp, solids_of(list(solids)), labels)
        self.fix(solids_W=self.scene)

    def given(self, name: str) -> Any:
        """Value of an input port."""
        return self.system.GetInputPort(name).Eval(self.context)

    def propose(self) -> None:
        """Evaluates the layers before: their outputs are the system's inputs."""
        for system, output in zip(self.layers, ("coupling_parameters", "decision"), strict=True):
            context = system.CreateDefaultContext()
            for name in ("policy_state", "ellipsoids_W", "coupling_parameters", "goal"):
                if system.HasInputPort(name):
                    port = self.system.GetInputPort(name)
                    if port.HasValue(self.context):
                        value = port.Eval(self.context)
                        given = GOAL if name == "goal" else Value(value)
                        system.GetInputPort(name).FixValue(context, given)
            if output == "decision":
                Simulator(system, context).Initialize()
                self.fix(route=system.GetOutputPort(output).Eval(context))
            else:
                self.fix(coupling_parameters=system.GetOutputPort(output).Eval(context))

    def chosen(self, time: float = 0.0) -> CouplingParameters:
        """The command in force after the decision at a time."""
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

    def kept(self, q: FloatArray) -> FloatArray:
        """(2,) least distances of tool and moving links to all solids along joints (T, n) [m]."""
        spheres, least = self.arm.covered.arrays, np.full(2, np.inf)
        is_tool = spheres.of_tool[spheres.first[:-1]]
        for row in q:
            d = group_distances(
                self.arm.chain, spheres, self.scene.solids, np.array(row)[None], 0.0, np.inf
            )
            for k, which in enumerate((is_tool, ~is_tool & (spheres.group_joint >= 0))):
                least[k] = min(least[k], d[which].min(initial=np.inf))
        return least


def test_an_empty_world_leaves_the_motion_as_it_is(
    panda_arm: ArmAlone, proposer: ProposalNetwork
) -> None:
    bench = Bench(panda_arm, proposer)
    found = bench.chosen()
    assert len(found.alpha) == 0
    assert found.note == ""
    assert found.hold == HoldCause.NONE
    assert not found.anew
    assert found.tau == pytest.approx(1.0, abs=2e-3)
    assert bench.number("shortfall") == bench.number("lowered") == 0.0
    assert bench.output("demonstration").position is None
    motion = bench.motion
    np.testing.assert_allclose(motion.p_WE[[0, -1]], [bench.start, GOAL], atol=2e-3)
    # A straight line, and the arm on it.
    assert np.ptp(motion.p_WE[:, [0, 2]], axis=0).max() < 1e-3
    reached = tool_poses(panda_arm.chain, np.array(motion.q))[:, 9:]
    np.testing.assert_allclose(reached, motion.p_WE, atol=2e-3)


def _ring(forbidden: Callable[[FloatArray], BoolArray], cost: float = 1.0) -> Ring:
    """Costs the sides whose directions in W, (K, 3), are told."""
    return lambda scene: np.tile(
        np.where(forbidden(scene.directions_W), cost, 0.0), (len(scene.ellipsoids), 1)
    )


def test_rings_of_ones_own_count_in_the_choice_of_a_side(
    panda_arm: ArmAlone, proposer: ProposalNetwork
) -> None:
    seen = balls([0.45, 0.02, 0.1], radius=[0.1, 0.1, 0.25])
    taken = []
    for rings in ({}, {"not_up": _ring(lambda omega: omega[:, 2] > 0.3)}):
        bench = Bench(panda_arm, proposer, BOX, rings=rings)
        bench.fix(ellipsoids_W=seen)
        assert bench.chosen().note == ""
        assert bench.number("shortfall") == 0.0
        sides = bench.output("sides")
        taken.append(sides.direction_W[0])
        # What is drawn is what chose.
        normal = bench.output("coupling_parameters").normal_W[0]
        np.testing.assert_allclose(np.cross(sides.normal_W[0], normal), 0.0, atol=1e-12)
        assert sides.ids.tolist() == [0]
        assert set(sides.costs) == {"length", "table", *rings}
        for cost in sides.costs.values():
            assert cost.shape == (1, 36)
            assert ((cost >= 0.0) & (cost <= 1.0)).all()
    up, beside = taken
    assert up[2] > 0.3
    assert beside[2] <= 0.3


def sides_rolled_out(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Records the angles of the sides in the order in which they are rolled out [rad]."""
    angles: list[float] = []
    evaluate = search.ArmSearch.evaluate

    def recorded(
        self: search.ArmSearch, genes: FloatArray, source: IntArray, *more: Any, **others: Any
    ) -> search.Ranked:
        new = genes[np.asarray(source) == search.SIDES, ANGLE].tolist()
        angles.extend(angle for angle in new if angle not in angles)
        return evaluate(self, genes, source, *more, **others)

    monkeypatch.setattr(search.ArmSearch, "evaluate", recorded)
    return angles


def test_sides_are_rolled_out_in_the_order_of_the_ranking(
    panda_arm: ArmAlone, proposer: ProposalNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    orders = []
    for reverse in (False, True):
        bench = Bench(panda_arm, proposer, BOX)
        bench.fix(ellipsoids_W=balls([0.45, 0.02, 0.1], radius=[0.1, 0.1, 0.25]))
        bench.propose()
        route = bench.given("route")
        assert len(route.ranking) == 16
        if reverse:
            bench.fix(route=replace(route, ranking=route.ranking[::-1]))
        angles = sides_rolled_out(monkeypatch)
        bench.simulator.Initialize()
        monkeypatch.undo()
        coupling = bench.given("coupling_parameters")
        normals = coupling.normal_W[route.ranking[::-1] if reverse else route.ranking]
        R_WL = bench.policy.R_WL
        ranked = np.arctan2(-normals @ R_WL[:, 1], normals @ R_WL[:, 2])[: len(angles)]
        np.testing.assert_allclose(angles, ranked, atol=1e-9)
        orders.append(angles)
    assert orders[0][0] != orders[1][0]


def test_a_ring_that_forbids_a_side_removes_its_candidates(
    panda_arm: ArmAlone, proposer: ProposalNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = np.array([0.0, 0.0, 1.0]) @ local_frame(panda_arm.X_WE[9:], GOAL)[:, 1:]
    rings = {"not_up": _ring(lambda omega: omega[:, 2] > 0.3)}
    bench = Bench(panda_arm, proposer, BOX, rings=rings)
    bench.fix(ellipsoids_W=balls([0.45, 0.02, 0.1], radius=[0.1, 0.1, 0.25]))
    angles = sides_rolled_out(monkeypatch)
    bench.chosen()
    assert angles
    up = [math.cos(angle) * left[0] + math.sin(angle) * left[1] for angle in angles]
    assert max(up) <= 0.3 + math.pi / 16


def test_without_networks_neither_chain_nor_sides_are_rolled_out(
    panda_arm: ArmAlone, proposer: ProposalNetwork
) -> None:
    bench = Bench(panda_arm, proposer, BOX)
    bench.simulator.Initialize()
    candidates = bench.output("candidates")
    assert candidates[search.CHAIN] == candidates[search.SIDES] == 0
    assert candidates[search.SEARCH] > 0
    assert bench.number("source") == search.SEARCH
    assert bench.number("shortfall") == 0.0


def test_the_rows_of_the_chain_are_one_candidate(
    panda_arm: ArmAlone, proposer: ProposalNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench(panda_arm, proposer, BOX, weights=load_chain(package_file(PAPER_CHAIN)))
    bench.fix(ellipsoids_W=balls([0.45, 0.02, 0.1], radius=[0.1, 0.1, 0.25]))
    bench.chosen()
    assert bench.output("candidates")[search.CHAIN] == 1
    # Where it is the only one that is feasible, it is executed.
    cost = search.ArmSearch.tool_cost

    def dear(self: search.ArmSearch, genes: FloatArray, tool: ToolRollouts) -> FloatArray:
        return cost(self, genes, tool) + 0.5 * np.isfinite(genes[:, LOG_ALPHA])

    monkeypatch.setattr(search.ArmSearch, "tool_cost", dear)
    bench = Bench(panda_arm, proposer, BOX, weights=load_chain(package_file(PAPER_CHAIN)))
    bench.fix(ellipsoids_W=balls([0.45, 0.02, 0.1], radius=[0.1, 0.1, 0.25]))
    found = bench.chosen()
    assert bench.number("source") == search.CHAIN
    assert len(found) == len(found.ellipsoids) == len(bench.output("route").ids) == 1
    assert bench.kept(bench.motion.q).min() > 0.0


def test_where_rings_forbid_every_side_the_motion_holds_and_says_so(
    panda_arm: ArmAlone, proposer: ProposalNetwork
) -> None:
    bench = Bench(panda_arm, proposer, BOX, rings={"never": _ring(lambda w: w[:, 0] < 2.0)})
    bench.fix(ellipsoids_W=balls([0.45, 0.02, 0.1], radius=[0.1, 0.1, 0.25]))
    found = bench.chosen()
    assert found.note == "every side is forbidden by the rings never"
    assert found.hold == HoldCause.OBSTACLES
    # Where nothing is in the way no side is asked for.
    bench.see()
    assert bench.chosen(0.1).note == ""


def test_before_anything_is_seen_nothing_is_chosen(
    panda_arm: ArmAlone, proposer: ProposalNetwork
) -> None:
    bench = Bench(panda_arm, proposer)
    bench.fix(solids_W=SolidScene())
    found = bench.chosen()
    assert found.tau == 0.0
    assert len(bench.motion) == 0


def test_a_box_in_the_way_is_passed_as_near_as_asked(
    panda_arm: ArmAlone, proposer: ProposalNetwork
) -> None:
    for seen in (None, balls([0.45, 0.02, 0.1], radius=[0.1, 0.1, 0.25])):
        bench = Bench(panda_arm, proposer, TABLE, BOX)
        if seen is not None:
            bench.fix(ellipsoids_W=seen)
        found = bench.chosen()
        assert len(found.alpha) == 1
        assert found.alpha[0] > 0.0
        assert found.note == ""
        assert found.tau > 1.0
        assert bench.number("shortfall") == 0.0
        # The first that will do, and then a better one.
        first = np.linalg.norm(np.diff(bench.motion.p_WE, axis=0), axis=1).sum()
        bench.chosen(0.1)
        assert np.linalg.norm(np.diff(bench.motion.p_WE, axis=0), axis=1).sum() <= first
        # Of the table start and goal may leave less: of the box alone then.
        bench.see(BOX)
        tool, links = bench.kept(bench.motion.q)
        assert CLEARANCE - 0.01 <= tool <= CLEARANCE + 0.02
        assert links >= QUICK.link_clearance - 0.01
        np.testing.assert_allclose(bench.motion.p_WE[-1], GOAL, atol=2e-3)
        assert (bench.motion.p_WS == bench.start).all()


def test_a_motion_in_use_stays_while_nothing_changes(
    panda_arm: ArmAlone, proposer: ProposalNetwork
) -> None:
    bench = Bench(panda_arm, proposer, TABLE, BOX)
    bench.chosen()
    # The first that would do has been made better once.
    first = bench.chosen(0.1)
    bench.see(TABLE, BOX, stamp=0.1)
    again = bench.chosen(0.2)
    for name in ("alpha", "psi", "kappa", "center_W", "normal_W"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    # What goes, is not gone round any more.
    bench.see(TABLE, stamp=0.2)
    assert len(bench.chosen(0.3).alpha) == 0


def walls() -> list[Solid]:
    """A wall with a window, which the arm must reach through with turns of its links."""
    low = box_at([0.9, 0.04, 0.62], [0.75, 0.0, 0.21], "sill")
    high = box_at([0.9, 0.04, 0.5], [0.75, 0.0, 1.25], "lintel")
    side = box_at([0.04, 0.5, 1.5], [0.95, 0.0, 0.65], "side")
    return [low, high, side]


def test_where_no_term_passes_a_path_in_the_joints_is_imitated(
    panda_arm: ArmAlone, proposer: ProposalNetwork, caplog: pytest.LogCaptureFixture
) -> None:
    bench = Bench(panda_arm, proposer, TABLE, *walls())
    with caplog.at_level(logging.INFO, "drake_oa"):
        found = bench.chosen()
    assert found.anew
    assert found.note == ""
    assert "a path of the whole arm is imitated" in caplog.text
    shown: Demonstration = bench.output("demonstration")
    assert shown.position is not None
    assert shown.orientation is not None
    np.testing.assert_allclose(shown.q[0], panda_arm.q, atol=1e-9)
    reached = tool_poses(panda_arm.chain, shown.q[-1:])[0]
    np.testing.assert_allclose(reached, np.append(panda_arm.X_WE[:9], GOAL), atol=2e-3)
    bench.see(*walls())
    assert bench.kept(bench.motion.q).min() > 0.0
    # Once it has begun anew with it, it is that which goes on.
    bench.see(TABLE, *walls(), stamp=0.1)
    bench.policy = replace(bench.policy, R_WL=np.eye(3))
    begun = bench.chosen(0.1)
    assert begun.note == ""
    assert bench.output("demonstration") is shown


def test_where_nothing_is_possible_it_holds_and_says_why(
    panda_arm: ArmAlone, proposer: ProposalNetwork
) -> None:
    # Walls all round, and a lid: there is room at the goal, and no way to it.
    x, y, z = GOAL
    around = [
        box_at([0.42, 0.02, 0.6], [x, y + side * 0.2, z], f"wall {k}")
        for k, side in enumerate((-1, 1))
    ]
    around += [box_at([0.02, 0.42, 0.6], [x + side * 0.2, y, z], "wall") for side in (-1, 1)]
    around.append(box_at([0.42, 0.42, 0.02], [x, y, z + 0.3], "lid"))
    bench = Bench(panda_arm, proposer, TABLE, *around)
    found = bench.chosen()
    assert found.hold == HoldCause.OBSTACLES
    assert re.fullmatch("(no motion that clears|at its goal the arm would touch) .*", found.note)
    assert any(word in found.note for word in ("wall", "lid"))
    assert bench.number("shortfall") > 0.0
    # It goes on when that leaves.
    bench.see(TABLE, stamp=1.0)
    found = bench.chosen(1.0)
    assert found.note == ""
    assert found.hold == HoldCause.NONE


def test_a_goal_in_contact_is_held_and_the_nearest_free_place_is_told(
    panda_arm: ArmAlone, proposer: ProposalNetwork
) -> None:
    # The tool point is in a crate's top by 2 cm.
    crate = box_at([0.2, 0.2, 0.3], GOAL + [0.0, 0.0, 0.02 - 0.15], "crate")
    bench = Bench(panda_arm, proposer, TABLE, crate)
    found = bench.chosen()
    assert found.hold == HoldCause.OBSTACLES
    told = re.fullmatch(
        r"at its goal the arm would touch crate; the tool's nearest free place is \[(.*)\] m",
        found.note,
    )
    assert told is not None
    place = np.array([float(value) for value in told[1].split(",")])
    # Straight above, by no more than the search is fine.
    np.testing.assert_allclose(place[:2], GOAL[:2], atol=1e-3)
    assert 0.02 - bench.arm.overshoot <= place[2] - GOAL[2] <= 0.03 + 1e-9
    # That stays so, and is told the same way, while nothing changes.
    bench.see(TABLE, crate, stamp=0.1)
    assert bench.chosen(0.1).note == found.note
    # One that leaves no room round about.
    bench.see(TABLE, box_at([0.8, 0.8, 0.8], GOAL + [0.0, 0.0, 0.1], "block"), stamp=1.0)
    note = bench.chosen(1.0).note
    assert note == "at its goal the arm would touch block; the tool has no free place within 0.3 m"


def test_a_motion_holds_from_where_it_leads_and_not_from_elsewhere(
    panda_arm: ArmAlone, proposer: ProposalNetwork
) -> None:
    bench = Bench(panda_arm, proposer, TABLE, BOX)
    at_start = Sight(bench.policy, GOAL, panda_arm.q, bench.scene)
    made = bench.search.decide(SelectedMotion(), at_start)
    assert made.prediction.shortfall == 0.0
    (term,) = made.command.terms
    assert term[ALPHA] > 0.0
    motion, row = made.prediction.motion, 8
    led = replace(
        bench.policy,
        p_WE=motion.p_WE[row],
        z_W=(motion.p_WE[row + 1] - motion.p_WE[row - 1]) / (motion.s[row + 1] - motion.s[row - 1]),
        phase=math.exp(-bench.dmp.alpha_k * motion.s[row]),
        speed=0.2,
    )
    there = replace(at_start, policy=led, q=motion.q[row])
    assert bench.search.still_holds(made, there)
    # Mirrored at the plane of the baseline and the term's normal it turns to the other side.
    omega = np.cross(term[NORMAL : NORMAL + 3], bench.policy.R_WL[:, 0])
    mirror = np.eye(3) - 2.0 * np.outer(omega, omega)
    away = replace(led, z_W=mirror @ led.z_W)
    assert not bench.search.still_holds(made, replace(there, policy=away))


def test_a_tool_in_a_solid_is_held(panda_arm: ArmAlone, proposer: ProposalNetwork) -> None:
    bench = Bench(panda_arm, proposer, box_at([0.3, 0.3, 0.3], panda_arm.X_WE[9:], "block"))
    found = bench.chosen()
    assert found.hold == HoldCause.OBSTACLES
    assert found.note == "no motion that clears block found"
    assert not found.anew


def test_a_tool_in_contact_may_leave_it(
    panda_arm: ArmAlone, proposer: ProposalNetwork, caplog: pytest.LogCaptureFixture
) -> None:
    # It begins 1 cm deep in a plate behind it.
    hand = panda_arm.X_WE[9:] + [0.0, -0.115, 0.05]
    plate = box_at([0.3, 0.02, 0.1], hand + [0.0, 0.01, 0.0], "plate")
    bench = Bench(panda_arm, proposer, plate)
    deep = bench.kept(panda_arm.q[None]).min()
    assert deep < -panda_arm.overshoot
    with caplog.at_level(logging.WARNING, "drake_oa"):
        found = bench.chosen()
    assert "t=0.000 s: the arm touches plate, and may only leave it" in caplog.text
    assert found.note == ""
    assert bench.kept(bench.motion.q).min() >= deep - 1e-3
    assert bench.kept(bench.motion.q[-1:]).min() > CLEARANCE
