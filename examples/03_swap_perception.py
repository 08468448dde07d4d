"""The same scenario with another perception source: one block changes."""

from drake_oa.runs.report import report_table, run_report
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario


def main(duration: float | None = None) -> None:
    """Runs tabletop_box on SceneGraph's own knowledge instead of rendered depth."""
    scenario = load_scenario("tabletop_box", ["perception=!GroundTruth {}"])
    log = simulate(scenario, duration=duration)
    print(report_table(run_report("tabletop_box", scenario, {"modulated": log})))


if __name__ == "__main__":
    main()
