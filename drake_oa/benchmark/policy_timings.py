"""Wall times of the policy and of the layers it asks, for `drake_oa.benchmark.benchmark`."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from pydrake.systems.analysis import Simulator

from drake_oa.benchmark.timings import DESIRED, JUST_AFTER, WARM_UP, port_timer, timed
from drake_oa.common.schema_check import ScenarioError
from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.policy.action import Segment
from drake_oa.policy.policy_inputs import Surroundings
from drake_oa.scenario.scenario import EllipsoidConfig, GivenEllipsoids, Regressor, Scenario
from drake_oa.scenario.task import Task

OBSTACLES = 6
"""How many the policy is timed among."""


def six_obstacles(scenario: Scenario) -> Scenario:
    """The scenario's policy among six ellipsoids on a baseline of 1 m, no robot.

    The baseline runs into all of them, and the coupling is the paper's: each takes part in
    regressor chain, route and coupling. (Of verified motions at most one term acts.)
    """
    angles = np.arange(OBSTACLES) * (2.0 * np.pi / OBSTACLES)
    ellipsoids = [
        EllipsoidConfig(
            center=[0.2 + 0.1 * i, 0.02 * float(np.cos(a)), 0.02 * float(np.sin(a))],
            semi_axes=[0.03, 0.05, 0.04],
            rpy=[0.1 * i, 0.0, float(a)],
        )
        for i, a in enumerate(angles)
    ]
    return replace(
        scenario,
        robot=None,
        table_height=None,
        directives=[],
        cameras=[],
        task=Task(start=[0.0, 0.0, 0.0], goal=[1.0, 0.0, 0.0], clearance=0.1),
        perception=GivenEllipsoids(ellipsoids),
        regulation=Regressor(),
    )


class _PolicyRun:
    """The policy among six obstacles, stepped by hand.

    Drake updates when it leaves a time and publishes when it arrives: from an instant of
    the policy to just after it there is one step of the policy and no log.
    """

    def __init__(self, scenario: Scenario) -> None:
        among = six_obstacles(scenario)
        self.simulator = Simulator(build_avoidance(among))
        self.simulator.Initialize()
        self._layers = [
            self.context(name)
            for name in ("cost_ring_selector", "regressor_chain", "dmp_integrator")
        ]
        self._period = scenario.policy.period
        self._step = WARM_UP
        self.simulator.AdvanceTo(self._step * self._period)

    def system(self, name: str) -> Any:
        """A subsystem."""
        diagram: Any = self.simulator.get_system()
        return diagram.GetSubsystemByName(name)

    def context(self, name: str) -> Any:
        """The context of a subsystem."""
        return self.system(name).GetMyContextFromRoot(self.simulator.get_context())

    def forget(self) -> None:
        """Makes every layer answer anew: while the obstacles stay they need not."""
        for context in self._layers:
            context.SetAllCacheEntriesOutOfDate()

    def time_step(self) -> float:
        """Wall time of a policy step [us]; the run stands just after it."""
        end = self._step * self._period + JUST_AFTER
        return 1e6 * timed(self.simulator.AdvanceTo, end)[0]

    def time_rest(self) -> float:
        """Wall time from just after a step to just before the next one [us]."""
        end = (self._step + 1) * self._period - JUST_AFTER
        return 1e6 * timed(self.simulator.AdvanceTo, end)[0]

    def go_on(self) -> None:
        """Advances to the next step."""
        self._step += 1
        self.simulator.AdvanceTo(self._step * self._period)

    def timer(self, system: str, *ports: str) -> Callable[[], float]:
        """What times the evaluation of output ports [us]."""
        return port_timer(self.simulator, system, *ports)

    def check(self) -> None:
        """Raises ScenarioError if what was timed was no motion."""
        diagram: Any = self.simulator.get_system()
        state = diagram.GetOutputPort("policy_state").Eval(self.simulator.get_context())
        if state.note:
            raise ScenarioError(f"policy: it is held among the benchmark's obstacles: {state.note}")


def time_policy(scenario: Scenario, steps: int) -> tuple[list[float], list[float]]:
    """Wall times of policy steps, Simulator included, logs not [us].

    Returns:
        Of steps in which every layer answers anew, as after each observation; and of
        steps as they come in a run. In most of those the policy alone has something to
        do; those just after a route decision cost as much as the first kind, so that
        the mean is well above the median.
    """
    complete: list[float] = []
    running: list[float] = []
    run = _PolicyRun(scenario)
    # One kind after the other, as most steps of a run follow one in which the policy alone
    # had something to do: just after one in which every layer had, it is slower.
    for times in (running, complete):
        for _ in range(steps):
            if times is complete:
                run.forget()
            times.append(run.time_step())
            run.go_on()
        run.check()
    return complete, running


def time_kernel(scenario: Scenario, samples: int, steps: int = 100) -> list[float]:
    """Wall times of the compiled policy step among six obstacles [us].

    Each is the mean over as many steps as one call of the kernel takes, so that nothing of
    Python is left in it.

    Args:
        scenario: whose policy it is.
        samples: how many times.
        steps: how many steps each is the mean of.

    Raises:
        ScenarioError: if the motion is held, so that there is less to do.
    """
    run = _PolicyRun(scenario)
    policy, context = run.system("dmp_integrator"), run.context("dmp_integrator")
    read = {
        name: policy.GetInputPort(name).Eval(context)
        for name in ("goal", "ellipsoids_W", "coupling_parameters", "route")
    }
    around = Surroundings.of(read["ellipsoids_W"], read["coupling_parameters"], read["route"])
    before = Segment.resting(policy.GetOutputPort("policy_state").Eval(context))

    def sample() -> float:
        elapsed, after = timed(
            policy.level.step,
            before,
            read["goal"],
            around,
            before.end.stamp,
            scenario.policy.period,
            steps,
        )
        if after.note:
            raise ScenarioError(f"policy: it is held among the obstacles: {after.note}")
        return 1e6 * elapsed / steps

    sample()
    return [sample() for _ in range(samples)]


def time_layers(scenario: Scenario, steps: int) -> dict[str, float]:
    """Median wall times [us] of the layers of a policy step, and of what surrounds it.

    Keys: "route" and "regressor chain", when they answer anew; "coupling and DMP" (with
    the Simulator) of each policy step; "desired motion", interpolated for each step of the
    controller; "route decision", at its own period, absent where it always coincides with
    a policy step.
    """
    run = _PolicyRun(scenario)
    route = run.timer("cost_ring_selector", "decision")
    chain = run.timer("regressor_chain", "coupling_parameters")
    desired = run.timer("dmp_integrator", *DESIRED)
    selector = run.context("cost_ring_selector")
    times: dict[str, list[float]] = {}

    def keep(name: str, elapsed: float) -> None:
        times.setdefault(name, []).append(elapsed)

    for i in range(
        max(2 * steps, int(2.0 * scenario.policy.route_period / scenario.policy.period))
    ):
        if i % 2 == 0:
            run.forget()
            keep("route", route())
            keep("regressor chain", chain())
            run.time_step()
        else:
            # The other two's answers are in the cache: the rest of the step remains.
            keep("coupling and DMP", run.time_step())
        keep("desired motion", desired())
        # Its only state is the decision: another object once it has been taken anew.
        before = selector.get_abstract_state(0).get_value()
        rest = run.time_rest()
        if selector.get_abstract_state(0).get_value() is not before:
            keep("route decision", rest)
        run.go_on()
    run.check()
    return {name: statistics.median(values) for name, values in times.items()}
