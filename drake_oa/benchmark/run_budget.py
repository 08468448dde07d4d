"""Where the time of a run goes, layer by layer, for `drake_oa.benchmark.benchmark`.

A run is made whose systems tell a stopwatch when they work: while its diagram is built,
each callback that a Python system declares is put into a section of that system's name.
What a callback asks of other Python systems is theirs, so that nothing counts twice. Two
parts of Drake are told apart besides: the camera renders when its image is pulled, which
is done in a section of its own, and a step of the plant is timed by itself at instants of
the run. What is left is the Simulator, its logs and the calls from C++ to Python.
"""

from __future__ import annotations

import inspect
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, EventStatus, LeafSystem

from drake_oa.benchmark.run_timings import camera_rate
from drake_oa.benchmark.stopwatch import REST, Spent, Stopwatch
from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.perception import depth_perception
from drake_oa.runs.simulation import MotionWatcher
from drake_oa.scenario.scenario import Scenario

RENDERING, TRACKING, PLANT, WATCHER = "rendering", "tracking and fusion", "plant", "run's record"
LAYERS = {
    "depth_noise": "noise",
    "perception": "segmentation",
    "ellipsoid_descriptor": "descriptor",
    "regressor_chain": "decision",
    "cost_ring_selector": "route decision",
    "dmp_integrator": "policy",
    "controller": "controller",
    "supervisor": "supervisor",
}
"""Subsystem -> name of its row; others have the subsystem's own."""
FRAMEWORK = "Simulator and logs"
_ORDER = (RENDERING, "noise", "segmentation", TRACKING, "descriptor", "decision")
_PIECES = 40
"""Stretches of a run; the plant's step is timed between them."""


@dataclass(frozen=True)
class LayerTime:
    """What one layer takes of a run.

    Attributes:
        layer: which one.
        every: what it works at, "frame" or the like; "" where that is not one thing.
        rate: how often that is [1/s]; None with it.
        wall: wall time a simulated second [ms/s].
        processor: processor time of all threads, likewise [ms/s].
        share: of the whole run's wall time.
    """

    layer: str
    every: str
    rate: float | None
    wall: float
    processor: float
    share: float


def time_run(scenario: Scenario, seconds: float) -> list[LayerTime]:
    """Runs a scenario for some simulated time and shares the time out to its layers.

    Args:
        scenario: with a robot and a depth camera.
        seconds: simulated [s]; it begins after the first frame, the one that loads the
            renderer, and ends early where the motion does.

    Returns:
        Of each layer; all together they take the whole run's time.

    Raises:
        ScenarioError: if it has no robot or no depth camera.
    """
    lead = 1.5 / camera_rate(scenario)
    watch = Stopwatch()
    with _watched_systems(watch):
        diagram = build_avoidance(scenario)
        simulator = Simulator(diagram)
        simulator.Initialize()
        watcher = MotionWatcher(diagram, scenario, lead + seconds, None)

        def monitor(root: Context) -> EventStatus:
            with watch.section(WATCHER):
                return watcher(root)

        simulator.set_monitor(monitor)
        simulator.AdvanceTo(lead)
        step = _PlantStep(diagram, simulator)
        steps: list[Spent] = []
        spent: dict[str, Spent] = {}
        for i in range(_PIECES):
            watch.reset()
            simulator.AdvanceTo(lead + seconds * (i + 1) / _PIECES)
            watch.stop()
            for name, one in watch.spent.items():
                of_layer = spent.setdefault(name, Spent())
                of_layer.wall += one.wall
                of_layer.processor += one.processor
            steps.append(step.time())
            if watcher.stop_reason:
                break
    covered = simulator.get_context().get_time() - lead
    count = covered / scenario.plant_step
    rest = spent.pop(REST)
    plant = Spent(
        count * statistics.median(one.wall for one in steps),
        count * statistics.median(one.processor for one in steps),
    )
    spent[PLANT] = plant
    spent[FRAMEWORK] = Spent(rest.wall - plant.wall, rest.processor - plant.processor)
    whole = sum(one.wall for one in spent.values())
    return [
        LayerTime(
            layer,
            *_rate(scenario, layer),
            wall=1e3 * spent[layer].wall / covered,
            processor=1e3 * spent[layer].processor / covered,
            share=spent[layer].wall / whole,
        )
        for layer in sorted(spent, key=_place)
    ]


def _place(layer: str) -> int:
    order = [*_ORDER, *LAYERS.values(), PLANT, WATCHER, FRAMEWORK]
    return order.index(layer) if layer in order else order.index(PLANT)


def _rate(scenario: Scenario, layer: str) -> tuple[str, float | None]:
    if layer in _ORDER:
        return "frame", camera_rate(scenario)
    if layer in ("controller", PLANT):
        return "step of the plant", 1.0 / scenario.plant_step
    if layer == "policy":
        return "step of the policy", 1.0 / scenario.policy.period
    if layer == "route decision":
        return "decision", 1.0 / scenario.policy.route_period
    return "", None


@contextmanager
def _watched_systems(watch: Stopwatch) -> Iterator[None]:
    """Inside, what Python systems declare tells the stopwatch when it is called."""
    names = [
        name
        for name in vars(LeafSystem)
        if name.startswith("Declare") and name.endswith(("OutputPort", "Event"))
    ]
    originals = {name: getattr(LeafSystem, name) for name in names}
    fuse = depth_perception.fuse
    try:
        for name, declare in originals.items():
            setattr(LeafSystem, name, _watching(watch, declare, name.endswith("Event")))
        setattr(depth_perception, "fuse", watch.watched(TRACKING, fuse))  # noqa: B010
        yield
    finally:
        for name, declare in originals.items():
            setattr(LeafSystem, name, declare)
        setattr(depth_perception, "fuse", fuse)  # noqa: B010


def _watching(watch: Stopwatch, declare: Callable[..., Any], is_event: bool) -> Callable[..., Any]:
    def declare_watched(system: Any, *arguments: Any, **named: Any) -> Any:
        def watched(call: Callable[..., Any]) -> Callable[..., Any]:
            def called(*given: Any) -> Any:
                name = system.get_name()
                # What a late camera renders in the background is only waited for.
                own = RENDERING if name.startswith("late_") else name
                with watch.section(LAYERS.get(name, own)):
                    if given and (name == "depth_noise" or (name == "perception" and is_event)):
                        # Pulled here it is in the cache when the system itself asks for it.
                        with watch.section(RENDERING):
                            system.GetInputPort("depth_image").Eval(given[0])
                    return call(*given)

            return called

        return declare(
            system,
            *(watched(item) if inspect.isroutine(item) else item for item in arguments),
            **{
                name: watched(item) if inspect.isroutine(item) else item
                for name, item in named.items()
            },
        )

    return declare_watched


class _PlantStep:
    """Times a step of a run's plant where the run is, and leaves it there."""

    def __init__(self, diagram: Diagram, simulator: Simulator) -> None:
        root = simulator.get_mutable_context()
        self._plant: Any = diagram.GetSubsystemByName("plant")
        self._context = self._plant.GetMyMutableContextFromRoot(root)
        self._values = self._plant.AllocateDiscreteVariables()
        instances = map(ModelInstanceIndex, range(self._plant.num_model_instances()))
        ports = [self._plant.get_actuation_input_port(instance) for instance in instances]
        self._driven = [port for port in ports if port.HasValue(self._context)]

    def time(self) -> Spent:
        """Of one step, without the controller's answer, which it waits for."""
        # As after a step: all that depends on the state is to be computed again.
        self._context.SetDiscreteState(self._context.get_discrete_state_vector().CopyToVector())
        for port in self._driven:
            port.Eval(self._context)
        wall, processor = time.perf_counter(), time.process_time()
        self._plant.CalcForcedDiscreteVariableUpdate(self._context, self._values)
        return Spent(time.perf_counter() - wall, time.process_time() - processor)
