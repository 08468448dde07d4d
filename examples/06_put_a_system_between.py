"""Your own system between two layers, in this example one that enlarges the perceived obstacles."""

from dataclasses import replace

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import LeafSystem

from drake_oa.common.messages import ObstacleClouds
from drake_oa.runs.report import motion_metrics
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario


class EnlargedObstacles(LeafSystem):
    """System that moves copies of each cloud by a margin [m] along and against each axis."""

    def __init__(self, margin: float) -> None:
        super().__init__()
        self._offsets = margin * np.vstack([np.zeros(3), np.eye(3), -np.eye(3)])
        self.DeclareAbstractInputPort("obstacles_W", Value(ObstacleClouds()))
        self.DeclareAbstractOutputPort("obstacles_W", lambda: Value(ObstacleClouds()), self._calc)

    def _calc(self, context, output) -> None:
        obstacles = self.GetInputPort("obstacles_W").Eval(context)
        clouds_W = [
            (cloud_W[:, None] + self._offsets).reshape(-1, 3) for cloud_W in obstacles.clouds_W
        ]
        output.set_value(replace(obstacles, clouds_W=tuple(clouds_W)))


def with_margin(signals) -> None:
    """Inserts the system between perception and all readers of its clouds."""
    signals.interpose("obstacles_W", "enlarged_obstacles", EnlargedObstacles(0.02))


def main(duration: float | None = None) -> None:
    """Prints the true minimum clearance of tabletop_box without and with the system."""
    scenario = load_scenario("tabletop_box")
    for label, change in {"perceived obstacles": None, "enlarged by 2 cm": with_margin}.items():
        log = simulate(scenario, duration=duration, customize=change)
        clearance = motion_metrics(scenario, log).tool_clearance.min()
        print(f"{label:>19}: minimum clearance {clearance:.3f} m, {log.stop_reason}")


if __name__ == "__main__":
    main()
