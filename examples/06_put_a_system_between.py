"""Your own system between two layers, in this example one that enlarges the obstacles."""

from dataclasses import replace

from pydrake.common.value import Value
from pydrake.systems.framework import LeafSystem

from drake_oa.common.messages import EllipsoidSet
from drake_oa.runs.report import report_table, run_report
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario


class EnlargedEllipsoids(LeafSystem):
    """System that adds a margin [m] to each semi-axis of the ellipsoids."""

    def __init__(self, margin: float) -> None:
        super().__init__()
        self._margin = margin
        self.DeclareAbstractInputPort("ellipsoids_W", Value(EllipsoidSet()))
        self.DeclareAbstractOutputPort("ellipsoids_W", lambda: Value(EllipsoidSet()), self._calc)

    def _calc(self, context, output) -> None:
        ellipsoids = self.GetInputPort("ellipsoids_W").Eval(context)
        output.set_value(replace(ellipsoids, semi_axes=ellipsoids.semi_axes + self._margin))


def main(duration: float | None = None) -> None:
    """Runs tabletop_box with enlarged ellipsoids for all systems that read them."""
    scenario = load_scenario("tabletop_box")
    log = simulate(
        scenario,
        duration=duration,
        customize=lambda signals: signals.interpose(
            "ellipsoids_W", "larger", EnlargedEllipsoids(0.02)
        ),
    )
    print(report_table(run_report("larger obstacles", scenario, {"avoiding": log})))


if __name__ == "__main__":
    main()
