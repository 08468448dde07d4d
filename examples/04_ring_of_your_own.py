"""Route selection with a ring of one's own: never pass over people's hands."""

from functools import partial

import numpy as np

from drake_oa.common.messages import EllipsoidSet, FloatArray, TablePlane
from drake_oa.policy.dmp import local_frame
from drake_oa.route.cost_rings import RingScene, length_ring, ring_scene, table_ring
from drake_oa.route.side_choice import select_directions


def never_above(scene: RingScene) -> FloatArray:
    """1 for directions that lead over the obstacle."""
    above = scene.directions_W[:, 2] > 0.5
    return np.broadcast_to(above, scene.detour.shape).astype(float)


def main() -> None:
    """Prints the side chosen with and without that ring."""
    start, goal = np.array([0.45, -0.4, 0.3]), np.array([0.45, 0.4, 0.3])
    box = EllipsoidSet(
        stamp=0.0,
        p_WO=np.array([[0.45, 0.0, 0.15]]),
        R_WO=np.eye(3)[None],
        semi_axes=np.array([[0.12, 0.1, 0.2]]),
        v_WO=np.zeros((1, 3)),
        ids=np.array([0]),
    )
    R_WL = local_frame(start, goal)
    scene = ring_scene(start, goal, R_WL, box, TablePlane(), asked_clearance=0.1)
    rings = {"table": partial(table_ring, height=0.05), "length": length_ring}
    for label, extra in (("without", {}), ("with", {"people": never_above})):
        selection = select_directions(scene, rings | extra)
        direction = scene.directions_W[selection.index[0]]
        print(f"{label:>7} the ring: omega_d = {direction.round(2)} in the world frame")


if __name__ == "__main__":
    main()
