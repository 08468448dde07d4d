"""Your own cost ring in the default diagram, which verifies motions by roll-outs."""

import numpy as np

from drake_oa.common.messages import FloatArray
from drake_oa.diagrams.motion import make_cost_ring_selector
from drake_oa.planning.search import SOURCES
from drake_oa.route.cost_rings import RingScene
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario

SCENARIO = load_scenario("tabletop_box", ["perception=!GroundTruth {}"])


def never_above(scene: RingScene) -> FloatArray:
    """Returns cost 1 for directions above the obstacle, where hands of people may be, else 0."""
    above = scene.directions_W[:, 2] > 0.5
    return np.broadcast_to(above, scene.detour.shape).astype(float)


def with_ring(signals) -> None:
    """Replaces the cost ring selector by one with an additional ring."""
    rings = {"people": never_above}
    signals.replace("cost_ring_selector", make_cost_ring_selector(SCENARIO, rings))


def main(duration: float | None = None) -> None:
    """Prints the largest detour from the baseline, which is parallel to y, and motion sources."""
    for label, change in {"shipped": None, "ring": with_ring}.items():
        log = simulate(SCENARIO, duration=duration, customize=change)
        sources = [SOURCES[int(code)] for code in np.unique(log.motion_source) if code >= 0]
        detours = log.p_WE - SCENARIO.task.start
        x, _, z = detours[np.linalg.norm(detours[:, [0, 2]], axis=1).argmax()]
        print(f"{label:>7}: x {x:+.2f} m, z {z:+.2f} m, {log.stop_reason}, {sources}")


if __name__ == "__main__":
    main()
