"""The system that regulates the coupling terms by motions that were rolled out."""

import logging
from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from drake_oa.common.messages import (
    CouplingParameters,
    EllipsoidSet,
    FloatArray,
    PolicyState,
    Route,
    TablePlane,
)
from drake_oa.geometry.annulus import Annulus
from drake_oa.geometry.ellipsoid import signed_distance
from drake_oa.policy.config import Policy
from drake_oa.policy.dmp import Dmp, imitate, local_frame, minimum_jerk
from drake_oa.policy.dmp_integrator import DmpIntegrator
from drake_oa.regulation.config import SearchParameters
from drake_oa.regulation.regressor import ChainWeights, load_chain
from drake_oa.regulation.verified_regressor_chain import VerifiedRegressorChain
from drake_oa.route.cost_ring_selector import TakenRoute
from drake_oa.scenario.loading import package_file

START, GOAL = np.array([0.0, 0.0, 0.3]), np.array([1.0, 0.0, 0.3])
AT_START = PolicyState(p_WE=START, p_WS=START, p_WG=GOAL, R_WL=local_frame(START, GOAL), speed=0.2)
CLEARANCE = 0.15
QUICK = SearchParameters(candidates=32, rounds=12, polish=0, steps=250)
BALL = ((0.5, 0.05, 0.3), (0.1, 0.1, 0.1))
WALL = ((0.5, 0.0, 0.3), (0.05, 3.0, 3.0))
SLAB = ((0.5, 0.0, 0.3), (0.05, 0.6, 0.6))
Item = tuple[tuple[float, float, float], tuple[float, float, float]]


@pytest.fixture(scope="module")
def weights() -> ChainWeights:
    return load_chain(package_file("package://drake_oa/weights/regressor_chain.safetensors"))


@pytest.fixture(scope="module")
def dmp() -> Dmp:
    return imitate(*minimum_jerk(START, GOAL, duration=5.0))


def seen(*items: Item, ids: list[int] | None = None, **changes: object) -> EllipsoidSet:
    count = len(items)
    found = EllipsoidSet(
        stamp=0.0,
        p_WO=np.array([item[0] for item in items], dtype=float).reshape(count, 3),
        R_WO=np.tile(np.eye(3), (count, 1, 1)),
        semi_axes=np.array([item[1] for item in items], dtype=float).reshape(count, 3),
        v_WO=np.zeros((count, 3)),
        ids=np.arange(count) if ids is None else np.array(ids),
    )
    return replace(found, **changes)  # type: ignore[arg-type]


class Bench:
    """The system alone, its inputs fixed."""

    def __init__(self, system: VerifiedRegressorChain, goal: FloatArray = GOAL) -> None:
        self.system = system
        self.simulator = Simulator(system)
        system.GetInputPort("goal").FixValue(self.context, goal)
        self.fix(ellipsoids_W=EllipsoidSet(), policy_state=AT_START)

    @property
    def context(self) -> Context:
        return self.simulator.get_mutable_context()

    def fix(self, **inputs: object) -> None:
        for name, value in inputs.items():
            self.system.GetInputPort(name).FixValue(self.context, Value(value))

    def parameters(self, context: Context | None = None) -> CouplingParameters:
        port = self.system.GetOutputPort("coupling_parameters")
        return port.Eval(self.context if context is None else context)

    def number(self, name: str) -> float:
        return float(self.system.GetOutputPort(name).Eval(self.context)[0])


@pytest.fixture
def bench(weights: ChainWeights, dmp: Dmp) -> Bench:
    return Bench(VerifiedRegressorChain(weights, dmp, CLEARANCE, period=0.1, parameters=QUICK))


def test_one_term_bends_the_motion_and_the_clearance_is_kept(bench: Bench) -> None:
    far = ((0.5, 2.0, 0.3), (0.1, 0.1, 0.1))
    bench.fix(ellipsoids_W=seen(far, BALL))
    bench.simulator.Initialize()
    found = bench.parameters()
    assert found.alpha[0] == 0.0
    assert found.alpha[1] > 0.0
    assert found.in_range.dtype == np.bool_
    # About a point of the baseline, in a plane with the baseline in it.
    np.testing.assert_allclose(found.center_W[1, 1:], START[1:], atol=1e-12)
    assert found.normal_W[1, 0] == pytest.approx(0.0, abs=1e-12)
    assert np.linalg.norm(found.normal_W[1]) == pytest.approx(1.0)
    assert not found.normal_W[0].any()
    assert 1.0 < found.tau < 1.5
    assert found.note == ""
    assert bench.number("shortfall") == 0.0
    assert bench.number("short_of") == -1.0


def test_nothing_in_the_way_couples_nothing(bench: Bench) -> None:
    bench.fix(ellipsoids_W=seen(((0.5, 1.0, 0.3), (0.1, 0.1, 0.1))))
    bench.simulator.Initialize()
    assert bench.parameters().alpha.tolist() == [0.0]
    assert bench.parameters().tau == pytest.approx(1.0, abs=1e-3)
    bench.fix(ellipsoids_W=seen())
    bench.simulator.AdvanceTo(0.15)
    assert len(bench.parameters()) == 0
    assert bench.parameters().tau == 1.0


def test_before_an_observation_or_a_motion_there_is_no_term(
    bench: Bench, weights: ChainWeights, dmp: Dmp
) -> None:
    bench.simulator.Initialize()
    assert bench.parameters().tau == 0.0
    bench.fix(ellipsoids_W=seen(BALL))
    assert bench.parameters().alpha.tolist() == [0.0]
    bench.simulator.AdvanceTo(0.05)
    assert bench.parameters().alpha[0] > 0.0
    still = Bench(VerifiedRegressorChain(weights, dmp, CLEARANCE, parameters=QUICK), START)
    still.fix(ellipsoids_W=seen(BALL))
    still.simulator.Initialize()
    assert still.parameters().alpha.tolist() == [0.0]
    assert still.parameters().tau == 0.0


def test_the_term_follows_the_name_of_its_obstacle(bench: Bench) -> None:
    far = ((0.5, 2.0, 0.3), (0.1, 0.1, 0.1))
    bench.fix(ellipsoids_W=seen(BALL, far, ids=[7, 9]))
    bench.simulator.Initialize()
    term = bench.parameters().as_array()[0]
    bench.fix(ellipsoids_W=seen(far, BALL, BALL, ids=[9, 7, 3]))
    np.testing.assert_array_equal(bench.parameters().as_array()[1], term)
    assert bench.parameters().alpha[[0, 2]].tolist() == [0.0, 0.0]
    # Who is not known has to wait for the next choice.
    bench.fix(ellipsoids_W=seen(BALL, ids=[8]))
    assert bench.parameters().alpha.tolist() == [0.0]
    bench.simulator.AdvanceTo(0.05)
    assert bench.parameters().alpha[0] > 0.0


def test_the_choice_stands_while_nothing_changes(bench: Bench) -> None:
    bench.fix(ellipsoids_W=seen(BALL))
    bench.simulator.Initialize()
    before = bench.parameters()
    # Seen again, in the same place.
    bench.fix(ellipsoids_W=seen(BALL, stamp=0.1))
    bench.simulator.AdvanceTo(0.25)
    np.testing.assert_array_equal(bench.parameters().as_array(), before.as_array())
    assert bench.parameters().tau == before.tau


def test_the_side_is_kept_while_the_obstacle_trembles(bench: Bench) -> None:
    rng = np.random.default_rng(0)
    head_on = ((0.5, 0.0, 0.3), (0.1, 0.1, 0.1))
    bench.fix(ellipsoids_W=seen(head_on))
    bench.simulator.Initialize()
    first = bench.parameters().normal_W[0]
    for frame in range(12):
        noisy = seen(head_on)
        bench.fix(
            ellipsoids_W=replace(
                noisy,
                stamp=0.1 * frame,
                p_WO=noisy.p_WO + 0.003 * rng.standard_normal((1, 3)),
                semi_axes=noisy.semi_axes + 0.003 * rng.standard_normal((1, 3)),
            )
        )
        bench.simulator.AdvanceTo(0.1 * frame + 0.05)
        found = bench.parameters()
        assert found.alpha[0] > 0.0
        assert found.normal_W[0] @ first > 0.9


def test_the_side_is_kept_when_the_obstacle_comes_back(
    bench: Bench, weights: ChainWeights, dmp: Dmp
) -> None:
    bench.fix(ellipsoids_W=seen(((0.5, 0.0, 0.3), (0.1, 0.1, 0.1))))
    bench.simulator.Initialize()
    first = bench.parameters().normal_W[0]
    bench.fix(ellipsoids_W=seen(stamp=0.1))
    bench.simulator.AdvanceTo(0.15)
    # It leaves less room on that side than on the other one.
    omega = np.cross(first, [1.0, 0.0, 0.0])
    center = tuple(np.array([0.5, 0.0, 0.3]) + 0.01 * omega)
    back = seen((center, (0.1, 0.1, 0.1)), stamp=0.2)
    bench.fix(ellipsoids_W=back)
    bench.simulator.AdvanceTo(0.25)
    assert bench.parameters().normal_W[0] @ first > 0.5
    fresh = Bench(VerifiedRegressorChain(weights, dmp, CLEARANCE, parameters=QUICK))
    fresh.fix(ellipsoids_W=back)
    fresh.simulator.Initialize()
    assert fresh.parameters().normal_W[0] @ first < 0.0


def test_the_table_and_the_workspace_shut_sides(weights: ChainWeights, dmp: Dmp) -> None:
    # Under it is the shorter way.
    high = ((0.5, 0.0, 0.36), (0.1, 0.4, 0.1))

    def up(**options: object) -> float:
        inputs = options.pop("inputs", {})
        system = VerifiedRegressorChain(weights, dmp, CLEARANCE, parameters=QUICK, **options)
        bench = Bench(system)
        bench.fix(**{"ellipsoids_W": seen(high, table=TablePlane(offset=-1.0))} | inputs)
        bench.simulator.Initialize()
        # x_L x omega = -y_W for a side that is up.
        assert bench.parameters().note == ""
        return float(-bench.parameters().normal_W[0, 1])

    assert up() < -0.5
    assert up(inputs={"ellipsoids_W": seen(high, table=TablePlane(offset=0.2))}) > -0.3
    # The port goes before the table that was seen.
    assert up(inputs={"table": TablePlane(offset=0.2)}) > -0.3
    shut = Annulus(np.array([[0.2, 1.0], [0.0, 0.0], [2.0, 2.0]]))
    assert up(annulus=shut) > -0.3


def test_what_cannot_be_kept_is_on_a_port_and_logged_once(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    bench.fix(ellipsoids_W=seen(SLAB, ids=[4]))
    with caplog.at_level(logging.WARNING, "drake_oa"):
        bench.simulator.Initialize()
        short = bench.number("shortfall")
        assert 0.001 < short < CLEARANCE
        assert bench.number("short_of") == 4.0
        assert bench.parameters().note == ""
        bench.fix(ellipsoids_W=seen(((0.5, 0.001, 0.3), SLAB[1]), ids=[4]))
        bench.simulator.AdvanceTo(0.05)
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == 1
    assert f"{1e3 * short:.1f} mm of the clearance to obstacle 4 cannot be kept" in said[0]


def test_where_no_way_is_found_the_motion_is_to_be_held(bench: Bench) -> None:
    bench.fix(ellipsoids_W=seen(WALL, ids=[2]))
    bench.simulator.Initialize()
    assert bench.parameters().note == "no motion that clears obstacle 2 found"
    bench.fix(ellipsoids_W=seen(BALL))
    bench.simulator.AdvanceTo(0.05)
    assert bench.parameters().note == ""


def test_the_note_is_not_about_what_holds_the_start(bench: Bench) -> None:
    around_start = ((0.0, 0.0, 0.3), (0.1, 0.1, 0.1))
    bench.fix(ellipsoids_W=seen(around_start, BALL))
    bench.simulator.Initialize()
    assert bench.parameters().note == ""
    bench.fix(ellipsoids_W=seen(around_start, WALL, ids=[0, 2]))
    bench.simulator.AdvanceTo(0.05)
    assert bench.parameters().note == "no motion that clears obstacle 2 found"


def test_the_choice_is_in_the_context_and_comes_out_the_same_again(
    bench: Bench, weights: ChainWeights, dmp: Dmp
) -> None:
    bench.fix(ellipsoids_W=seen(BALL))
    bench.simulator.Initialize()
    before = bench.parameters()
    clone = bench.context.Clone()
    bench.fix(ellipsoids_W=seen(((0.5, -0.04, 0.3), (0.1, 0.1, 0.1))))
    bench.simulator.AdvanceTo(0.05)
    after = bench.parameters()
    assert (after.as_array() != before.as_array()).any()
    np.testing.assert_array_equal(bench.parameters(clone).as_array(), before.as_array())
    # The clone comes to the same choice when it sees the same.
    other = Simulator(bench.system, clone)
    port = bench.system.GetInputPort("ellipsoids_W")
    port.FixValue(clone, Value(seen(((0.5, -0.04, 0.3), (0.1, 0.1, 0.1)))))
    other.AdvanceTo(0.05)
    np.testing.assert_array_equal(bench.parameters(clone).as_array(), after.as_array())
    assert bench.parameters(clone).tau == after.tau


@pytest.mark.parametrize("port", ["ellipsoids_W", "policy_state", "table"])
def test_a_wrong_type_on_a_port_is_refused_by_its_name(bench: Bench, port: str) -> None:
    bench.fix(ellipsoids_W=seen(BALL))
    bench.fix(**{port: Route()})
    with pytest.raises(TypeError, match=rf"'{port}' holds a Route; it must be a "):
        bench.simulator.Initialize()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"asked_clearance": 0.0}, "asked_clearance must be finite and positive"),
        ({"asked_clearance": np.nan}, "asked_clearance must be finite and positive"),
        ({"period": -1.0}, "period must be positive"),
        ({"annulus": Annulus(np.zeros((2, 4)))}, r"annulus.radii must be \(3, n\) .* not \(2, 4\)"),
        ({"annulus": Annulus(np.zeros((3, 1)))}, r"annulus.radii must be \(3, n\) .* not \(3, 1\)"),
        ({"annulus": Annulus(np.zeros((3, 2)))}, "heights increasing"),
        ({"annulus": Annulus(np.full((3, 2), np.nan))}, "annulus must be finite"),
        ({"table_height": np.nan}, "table_height must be finite"),
        ({"dmp": imitate(*minimum_jerk((0.0, 0.0), (1.0, 0.0)))}, "dmp must have 3 dimensions"),
    ],
)
def test_bad_construction_is_refused(
    changes: dict[str, object], said: str, weights: ChainWeights, dmp: Dmp
) -> None:
    arguments = {"weights": weights, "dmp": dmp, "asked_clearance": CLEARANCE, **changes}
    with pytest.raises(ValueError, match=said):
        VerifiedRegressorChain(**arguments)


def test_weights_of_another_type_are_refused(dmp: Dmp) -> None:
    with pytest.raises(TypeError, match=r"ChainWeights .* not str"):
        VerifiedRegressorChain("weights.npz", dmp, CLEARANCE)  # type: ignore[arg-type]


def test_the_route_that_is_shown_is_the_one_that_is_taken() -> None:
    route = Route(
        direction_W=np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        normal_W=np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
        remaining_clearance=np.array([0.1, 0.15]),
        ids=np.array([3, 5]),
    )
    coupling = CouplingParameters(
        alpha=np.array([0.0, 9.0]),
        psi=np.ones(2),
        kappa=np.ones(2),
        in_range=np.ones(2, dtype=bool),
        center_W=np.zeros((2, 3)),
        normal_W=np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
    )
    system = TakenRoute()
    context = system.CreateDefaultContext()
    system.GetInputPort("route").FixValue(context, Value(route))
    system.GetInputPort("coupling_parameters").FixValue(context, Value(coupling))
    taken = system.get_output_port().Eval(context)
    np.testing.assert_allclose(taken.direction_W[1], [0.0, -1.0, 0.0], atol=1e-15)
    np.testing.assert_array_equal(taken.normal_W[1], [0.0, 0.0, -1.0])
    assert taken.remaining_clearance.tolist() == [0.0, 0.15]
    system.GetInputPort("coupling_parameters").FixValue(context, Value(CouplingParameters()))
    with pytest.raises(ValueError, match="route has 2 rows, coupling_parameters 0"):
        system.get_output_port().Eval(context)


@pytest.mark.parametrize("speed", [-0.15, 0.15])
def test_a_moving_obstacle_is_met_where_it_will_be(
    speed: float, weights: ChainWeights, dmp: Dmp
) -> None:
    # It crosses the middle of the baseline when the unmodulated motion is there.
    ball = seen(((0.5, -2.5 * speed, 0.3), (0.08, 0.08, 0.08)), v_WO=np.array([[0.0, speed, 0.0]]))
    bench = Bench(VerifiedRegressorChain(weights, dmp, CLEARANCE, parameters=QUICK))
    bench.fix(ellipsoids_W=ball)
    bench.simulator.Initialize()
    found = bench.parameters()
    assert found.note == ""
    assert found.alpha[0] > 0.0 or abs(found.tau - 1.0) > 0.05
    builder = DiagramBuilder()
    policy = builder.AddSystem(DmpIntegrator(dmp, START, config=Policy(period=0.01)))
    goal = builder.AddSystem(ConstantVectorSource(GOAL))
    builder.Connect(goal.get_output_port(), policy.GetInputPort("goal"))
    builder.ExportInput(policy.GetInputPort("ellipsoids_W"), "ellipsoids_W")
    builder.ExportInput(policy.GetInputPort("coupling_parameters"), "coupling_parameters")
    simulator = Simulator(builder.Build())
    root = simulator.get_mutable_context()
    diagram = simulator.get_system()
    diagram.GetInputPort("ellipsoids_W").FixValue(root, Value(replace(ball, stamp=np.inf)))
    diagram.GetInputPort("coupling_parameters").FixValue(root, Value(found))
    least = np.inf
    for time in np.arange(0.0, 6.0, 0.02):
        simulator.AdvanceTo(time)
        p_WE = policy.GetOutputPort("desired_position").Eval(policy.GetMyContextFromRoot(root))
        p_WO = ball.p_WO[0] + time * ball.v_WO[0]
        least = min(least, float(signed_distance(p_WE, p_WO, np.eye(3), ball.semi_axes[0])))
    # The time that the policy takes to come to its speed is not in the roll-out.
    assert least > CLEARANCE - 0.015
