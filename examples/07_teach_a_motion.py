"""Motions from demonstrations: three recordings of an arc, and one of pouring, in a CSV file."""

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
    """Prints the extent of the imitated motions, and the rotation of the tool."""
    arcs = [read_demonstration(f"{FOLDER}/arc_{number}.npz") for number in (1, 2, 3)]
    # Your own arrays are also valid: positions (T, 3) [m] and their times (T,) [s].
    path, t = average_paths([one.path for one in arcs], [one.t for one in arcs])
    motion = trajectory(imitate(path, t), START, GOAL)
    direction = (GOAL - START) / np.linalg.norm(GOAL - START)
    max_offset = np.linalg.norm(np.cross(motion.p - START, direction), axis=1).max()
    print(f"average of {len(arcs)} arcs, {t[-1]:.2f} s, imitated between other positions:")
    print(f"  from {motion.p[0].round(3)} to {motion.p[-1].round(3)} m, offset {max_offset:.3f} m")

    pour = read_demonstration(f"{FOLDER}/pour.csv")
    R_WE, t = average_orientations([pour.orientations], [pour.t])
    turn = imitate_orientation(R_WE, t)
    s = np.linspace(0.0, 1.0, 5)
    for share, R in zip(s, orientation_along(turn, turn.first, turn.last, s), strict=True):
        angle = np.degrees(np.linalg.norm(goal_vector(turn.first, R)))
        print(f"pouring, at normalized time {share:.2f}: rotated by {angle:4.1f} degrees")


if __name__ == "__main__":
    main()
