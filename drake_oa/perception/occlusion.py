"""What a frame says about remembered points: shown again, shown to be gone, or hidden.

Each point carries evidence. A frame that shows it adds one; a frame whose rays pass
through it takes away all but one, and the next such frame the rest: two frames confirm
a point, two remove it. One that is hidden (by the arm, another obstacle, a missing
pixel, the border of the image) stays as it is. Where the image shows something at the
point's depth but no cluster has a point there (grazing surfaces, the foot of an
obstacle) the evidence only decays.
"""

from __future__ import annotations

import numpy as np

from drake_oa.common.messages import BoolArray, FloatArray, IntArray
from drake_oa.geometry.self_filter import PosedShapes
from drake_oa.perception.obstacle_memory import CERTAIN, CONFIRMED, Points, changed, taken
from drake_oa.perception.sides import View
from drake_oa.perception.tracking_kernels import AT, EMPTY, FREE, HIDDEN, OUT, evidence_after, shown


def shown_at(
    p_WQ: FloatArray,
    missed: BoolArray,
    view: View | None,
    margin: float,
    robot: PosedShapes | None,
    robot_margin: float,
) -> tuple[IntArray, IntArray]:
    """What a frame shows where points (N, 3) should be.

    Args:
        p_WQ: in the world [m].
        missed: (N,) which of them no point of the frame supports.
        view: the image; None: a cloud, which is taken to show every point.
        margin: depth difference that tells "before" and "behind" from "at" [m].
        robot: the robot's primitives, or None: what is in it is hidden.
        robot_margin: points within this of the robot are the robot's [m].

    Returns:
        (N,) HIDDEN, AT, FREE, OUT or EMPTY, and (N,) flat index of the pixel, -1 for none.
    """
    pixel = np.full(len(p_WQ), -1, dtype=np.int64)
    if view is None:
        return np.full(len(p_WQ), AT, dtype=np.int64), pixel
    seen = shown(p_WQ, view.X_WC, view.K, view.z, margin, pixel)
    if robot is not None:
        # Only what seems to be gone needs the robot's excuse.
        asked = np.flatnonzero(missed & ((seen == AT) | (seen == FREE) | (seen == EMPTY)))
        seen[asked[robot.contains(p_WQ[asked], robot_margin)]] = OUT
    return seen, pixel


def hidden_by_itself(
    seen: IntArray, pixel: IntArray, owner: IntArray, surface: list[tuple[int, IntArray]]
) -> BoolArray:
    """Which hidden points (N,) have their own obstacle before them: it moved or turned.

    Args:
        seen: (N,) from `shown_at`.
        pixel: (N,) their pixels.
        owner: (N,) their obstacles.
        surface: obstacle and ascending pixels of each cluster.
    """
    result = np.zeros(len(seen), dtype=bool)
    hidden = np.flatnonzero(seen == HIDDEN)
    if not len(hidden):
        return result
    for row, pixels in surface:
        mine = hidden[owner[hidden] == row]
        if len(mine) and len(pixels):
            place = np.minimum(np.searchsorted(pixels, pixel[mine]), len(pixels) - 1)
            result[mine] |= pixels[place] == pixel[mine]
    return result


def without_background(seen: IntArray, moved: BoolArray) -> IntArray:
    """What a frame shows at points (N,), those decided that have nothing around them.

    Missing pixels hide what rests. What moves on before a background that is too far away to
    be measured leaves nothing else where it was: its points there are gone.

    Args:
        seen: (N,) from `shown_at`.
        moved: (N,) whether they are of an obstacle that moves, and is seen in the frame.

    Returns:
        (N,) HIDDEN, AT, FREE or OUT.
    """
    return np.where(seen == EMPTY, np.where(moved, FREE, OUT), seen)


def weighed(
    points: Points,
    seen: IntArray,
    behind_itself: BoolArray,
    distance: FloatArray,
    found: BoolArray,
    settled: BoolArray,
    support_radius: float,
    same_radius: float,
) -> Points:
    """Remembered points with the evidence of a frame; those without any are left out.

    Args:
        points: N of them.
        seen: (N,) what the frame shows at them.
        behind_itself: (N,) from `hidden_by_itself`.
        distance: (N,) from the frame's nearest point [m].
        found: (M,) obstacles that have a cluster in the frame.
        settled: (M,) those that rest, and are handed on: what is new of them is confirmed by
            a third frame.
        support_radius: a point of the frame this near supports a confirmed one [m].
        same_radius: and this near one that is not confirmed yet [m].
    """
    evidence, confirmed = evidence_after(
        points.owner,
        points.evidence,
        points.confirmed,
        seen,
        behind_itself,
        distance,
        found,
        settled,
        (support_radius, same_radius),
        (CERTAIN, CONFIRMED),
    )
    return taken(changed(points, evidence=evidence, confirmed=confirmed), evidence > 0)
