"""Your own perception: as a system instead of the layer, and as a block of scenario files."""

import dataclasses as dc

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.primitives import ConstantValueSource

from drake_oa.common.messages import ObstacleClouds
from drake_oa.diagrams.avoidance import Layers
from drake_oa.diagrams.perception import register_source
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario


def make_ball(radius: float) -> ObstacleClouds:
    """Returns points on a ball halfway between start and goal of tabletop_box."""
    n = np.random.default_rng(0).normal(size=(400, 3))
    points = [0.5, 0.0, 0.3] + radius * n / np.linalg.norm(n, axis=1, keepdims=True)
    return ObstacleClouds(
        stamp=np.inf, clouds_W=(points,), ids=np.array([7]), v_WO=np.zeros((1, 3))
    )


# Instead of the layer: a function that adds a system with the output signal obstacles_W.
def my_source(signals, scenario, station):
    """Adds the system; `drake_oa.diagrams.avoidance.Layers` lists other signals of the layer."""
    source = ConstantValueSource(Value(make_ball(0.05)))
    signals.add("perception", source, outputs={"y0": "obstacles_W"})


# As `perception: !KnownBall {radius: 0.05}` in a scenario file: a block, and a function for it.
@dc.dataclass
class KnownBall:
    """Block of a known ball: its radius [m], and the time between observations [s]."""

    radius: float = 0.05
    period: float = 0.1


def add_known_ball(signals, block, scenario, station):
    """Adds the system of a block."""
    source = ConstantValueSource(Value(make_ball(block.radius)))
    signals.add("perception", source, outputs={"y0": "obstacles_W"})


def main(duration: float | None = None) -> None:
    """Runs tabletop_box with both kinds of perception."""
    layers = dc.replace(Layers(), perception=my_source)
    log = simulate(load_scenario("tabletop_box"), duration=duration, layers=layers)
    print(f"your own layer: {log.stop_reason}")

    register_source(KnownBall, add_known_ball)
    scenario = load_scenario("tabletop_box", ["perception=!KnownBall {radius: 0.08}"])
    print(f"your own block: {simulate(scenario, duration=duration).stop_reason}")


if __name__ == "__main__":
    main()
