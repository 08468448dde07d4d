"""Teach a motion from recordings, three of an arc and one in a CSV, and go it elsewhere."""

import numpy as np

from drake_oa.policy.averaging import average_orientations, average_paths
from drake_oa.policy.dmp import (
    goal_vector,
    imitate,
    imitate_orientation,
    orientation_along,
    trajectory,
)
from drake_oa.scenario.demonstration import read_demonstration

FOLDER = "package://drake_oa/demonstrations"
START, GOAL = np.array([0.5, -0.3, 0.4]), np.array([0.3, 0.4, 0.4])


def main() -> None:
    """Prints where the learnt motions go, and how far the tool turns."""
    shown = [read_demonstration(f"{FOLDER}/arc_{number}.npz") for number in (1, 2, 3)]
    # Arrays of your own do as well: positions (T, 3) [m] and their stamps (T,) [s].
    path, t = average_paths([one.path for one in shown], [one.t for one in shown])
    motion = trajectory(imitate(path, t), START, GOAL)
    way = (GOAL - START) / np.linalg.norm(GOAL - START)
    aside = np.linalg.norm(np.cross(motion.p - START, way), axis=1).max()
    print(
        f"{len(shown)} arcs in {t[-1]:.2f} s on average; elsewhere {aside:.3f} m beside the line,"
    )
    print(f"  from {motion.p[0].round(3)} to {motion.p[-1].round(3)} m")

    pour = read_demonstration(f"{FOLDER}/pour.csv")
    R_WE, t = average_orientations([pour.orientations], [pour.t])
    turn = imitate_orientation(R_WE, t)
    s = np.linspace(0.0, 1.0, 5)
    for share, R in zip(s, orientation_along(turn, turn.first, turn.last, s), strict=True):
        angle = np.degrees(np.linalg.norm(goal_vector(turn.first, R)))
        print(f"pouring, at {share:.2f} of the time: turned by {angle:4.1f} degrees")


if __name__ == "__main__":
    main()
