"""A cost ring and proposals of your own in the default diagram, which verifies both."""

import numpy as np

from drake_oa.common.messages import CouplingParameters, FloatArray
from drake_oa.diagrams.motion import make_cost_ring_selector, make_regressor_chain
from drake_oa.planning.search import SOURCES
from drake_oa.policy.rollout import Scene
from drake_oa.regulation.proposals import side_rows
from drake_oa.route.cost_rings import RingScene
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario

SCENARIO = load_scenario("tabletop_box", ["perception=!GroundTruth {}"])


def never_above(scene: RingScene) -> FloatArray:
    """1 for directions that lead over the obstacle, where people's hands may be."""
    above = scene.directions_W[:, 2] > 0.5
    return np.broadcast_to(above, scene.detour.shape).astype(float)


def with_ring(wires) -> None:
    """Replaces the selector by one with a ring more."""
    rings = {"people": never_above}
    wires.replace("cost_ring_selector", make_cost_ring_selector(SCENARIO, rings))


class FourSides:
    """Proposals of a moderate term on four sides, without a network."""

    def rows(self, scene: Scene, duration: float) -> CouplingParameters:
        """Rows of angle, place and distance of the term's point, ln of kappa, psi, alpha, tau."""
        genes = np.tile([0.0, 0.5, -0.05, 1.0, 0.3, 4.0, 0.0], (4, 1))
        genes[:, 0] = [0.0, 0.5 * np.pi, np.pi, 1.5 * np.pi]
        return side_rows(scene, genes, length=np.full(4, 1.2), likely=np.full(4, 0.5))


def with_proposals(wires) -> None:
    """Replaces the proposal network."""
    wires.replace("regressor_chain", make_regressor_chain(SCENARIO, FourSides()))


def main(duration: float | None = None) -> None:
    """Prints how high the tool passes, and the sources of the motion."""
    for label, change in {"shipped": None, "ring": with_ring, "proposals": with_proposals}.items():
        log = simulate(SCENARIO, duration=duration, customize=change)
        sources = [SOURCES[int(code)] for code in np.unique(log.motion_source) if code >= 0]
        print(f"{label:>9}: highest {log.p_WE[:, 2].max():.3f} m, {log.stop_reason}, {sources}")


if __name__ == "__main__":
    main()
