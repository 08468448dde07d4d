"""Perception of one's own, as a system in the layer's place, or as a block of scenario files."""

import dataclasses as dc

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.primitives import ConstantValueSource

from drake_oa.common.messages import ObstacleClouds
from drake_oa.diagrams.avoidance import Layers
from drake_oa.diagrams.perception import register_source
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario


def known_ball(radius: float) -> ObstacleClouds:
    """A ball halfway between start and goal of tabletop_box, as points on its surface."""
    n = np.random.default_rng(0).normal(size=(400, 3))
    points = [0.5, 0.0, 0.3] + radius * n / np.linalg.norm(n, axis=1, keepdims=True)
    return ObstacleClouds(
        stamp=np.inf, clouds_W=(points,), ids=np.array([7]), v_WO=np.zeros((1, 3))
    )


# In the place of the layer: whatever adds a system that offers obstacles_W.
def my_source(signals, scenario, station):
    """Adds the source: see `drake_oa.diagrams.avoidance.Layers` for what else it may offer."""
    source = ConstantValueSource(Value(known_ball(0.05)))
    signals.add("perception", source, outputs={"y0": "obstacles_W"})


# As `perception: !KnownBall {radius: 0.05}` in a scenario file: a block, and what it adds.
@dc.dataclass
class KnownBall:
    """The block's fields; `period` is the time between observations [s]."""

    radius: float = 0.05
    period: float = 0.1


def add_known_ball(signals, block, scenario, station):
    """Adds the source that a block asks for."""
    source = ConstantValueSource(Value(known_ball(block.radius)))
    signals.add("perception", source, outputs={"y0": "obstacles_W"})


def main(duration: float | None = None) -> None:
    """Runs tabletop_box with either."""
    layers = dc.replace(Layers(), perception=my_source)
    log = simulate(load_scenario("tabletop_box"), duration=duration, layers=layers)
    print(f"a layer of one's own: {log.stop_reason}")

    register_source(KnownBall, add_known_ball)
    scenario = load_scenario("tabletop_box", ["perception=!KnownBall {radius: 0.08}"])
    print(f"a block of one's own: {simulate(scenario, duration=duration).stop_reason}")


if __name__ == "__main__":
    main()
