"""One recorded frame to clusters, ellipsoids and figures: what `drake-oa perceive` reports.

Frames: C is the camera's, or that of the cloud's points; W the world of X_WC. Where
X_WC is not known the table defines W (see `drake_oa.perception.segmentation.segment_depth`). The
tool is given in W orientation, and all that is reported is in C.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_oa.common.messages import FloatArray, IntArray
from drake_oa.geometry.ellipsoid import Ellipsoid, enclosing_ellipsoid
from drake_oa.geometry.ellipsoid_kernels import farthest_pair
from drake_oa.perception.config import SegmentationConfig
from drake_oa.perception.depth_image import back_projected, row_hulls
from drake_oa.perception.recordings import RecordedFrame
from drake_oa.perception.segmentation import Segmentation, segment_depth, segment_points

_BACKGROUND = 1.5  # [m]
_BORDER = 5  # [pixel]
_LEAST_SHARE = 0.1  # of a row or column that shows something

ENCLOSED_TOLERANCE = 1e-9
"""By how much a dilated point's gauge may exceed 1 and the point still count as inside."""


@dataclass(frozen=True, eq=False)
class PerceivedCluster:
    """One cluster and its ellipsoid, in the frame C of the points.

    Attributes:
        pixels: (N,) ascending flat indices (row-major) of its pixels, or of its points
            in the file's order when the frame is a cloud.
        p_CQ: (N, 3) its observed points [m].
        ellipsoid: of least volume round these points dilated by the tool.
        gauge: largest gauge of any point dilated by any corner of the tool, computed
            anew in C.
    """

    pixels: IntArray
    p_CQ: FloatArray
    ellipsoid: Ellipsoid
    gauge: float

    @property
    def enclosed(self) -> bool:
        """Whether every observed point dilated by the tool is inside the ellipsoid."""
        return self.gauge <= 1.0 + ENCLOSED_TOLERANCE


@dataclass(frozen=True, eq=False)
class PerceivedFrame:
    """What is seen in one frame.

    Attributes:
        path: the file.
        frame: what it holds.
        segmentation: its table and clusters; X_WC is there, also when the table
            defines W.
        normal: (3,) unit normal of the table in C, towards its free side; NaN without.
        offset: ``normal . p_CQ`` of the table's points [m]; NaN without.
        clusters: the one that shows the largest surface first.
        background: how many more were left out as background.
        valid: number of finite pixels (depth > 0) or points.
        milliseconds: processor time from the depth array to the ellipsoids, the median
            of the repetitions.
    """

    path: Path
    frame: RecordedFrame
    segmentation: Segmentation
    normal: FloatArray
    offset: float
    clusters: tuple[PerceivedCluster, ...]
    background: int
    valid: int
    milliseconds: float


def perceive(
    frame: RecordedFrame,
    tool_W: FloatArray,
    *,
    X_WC: FloatArray | None = None,
    config: SegmentationConfig | None = None,
    background: bool = False,
    repeats: int = 5,
) -> PerceivedFrame:
    """Segments a frame, encloses its clusters, checks the ellipsoids and takes the time.

    Args:
        frame: a depth image with K, or points.
        tool_W: (K, 3) corners of the tool about its reference point, in W orientation
            [m]; [[0, 0, 0]] for a point.
        X_WC: (4, 4) pose of the camera for a frame that does not hold one; None: unknown.
        config: how frames are segmented; None for the defaults.
        background: whether to keep clusters that are far away and cut by the border of
            what the camera saw.
        repeats: how often the work is timed, once more being run before.

    Returns:
        What is seen, in C.

    Raises:
        ValueError: for malformed arrays.
    """
    pose = frame.X_WC if frame.X_WC is not None else X_WC
    segmentation, found = _processed(frame, pose, tool_W, config, background)
    elapsed = []
    for _ in range(repeats):
        # Processor time: one thread works, and others may be busy beside it.
        started = time.process_time()
        _processed(frame, pose, tool_W, config, background)
        elapsed.append(time.process_time() - started)
    X = segmentation.X_WC
    tool_C = np.ascontiguousarray(tool_W @ X[:3, :3])
    normal, offset = np.full(3, np.nan), np.nan
    if segmentation.table is not None:
        normal = X[:3, :3].T @ segmentation.table.normal_W
        offset = float(segmentation.table.offset - segmentation.table.normal_W @ X[:3, 3])
    clusters = []
    for pixels, ellipsoid in found:
        points = _observed(frame, pixels)
        in_C = Ellipsoid(
            X[:3, :3].T @ (ellipsoid.center - X[:3, 3]),
            X[:3, :3].T @ ellipsoid.R,
            ellipsoid.semi_axes,
            ellipsoid.gauge,
        )
        clusters.append(PerceivedCluster(pixels, points, in_C, _gauge(points, tool_C, in_C)))
    return PerceivedFrame(
        frame.path,
        frame,
        segmentation,
        normal,
        offset,
        tuple(clusters),
        len(segmentation.pixels) - len(clusters),
        _count_valid(frame),
        1e3 * statistics.median(elapsed) if elapsed else float("nan"),
    )


def as_json(perceived: PerceivedFrame) -> dict[str, Any]:
    """The frame's figures as JSON holds them; see `drake-oa perceive --help`."""
    depth, points = perceived.frame.depth, perceived.frame.points
    plane = None
    if perceived.segmentation.table is not None:
        plane = {
            "normal": perceived.normal.tolist(),
            "offset": perceived.offset,
            "rms": perceived.segmentation.plane_rms,
        }
    return {
        "file": str(perceived.path),
        "size": None if depth is None else list(depth.shape),
        "K": None if perceived.frame.K is None else perceived.frame.K.tolist(),
        "count": int(depth.size if depth is not None else len(np.asarray(points))),
        "valid": perceived.valid,
        "X_WC": perceived.segmentation.X_WC.tolist() if plane else None,
        "plane": plane,
        "clusters": [
            {
                "points": len(cluster.pixels),
                "ellipsoid": {
                    "center": cluster.ellipsoid.center.tolist(),
                    "R": cluster.ellipsoid.R.tolist(),
                    "semi_axes": cluster.ellipsoid.semi_axes.tolist(),
                },
                "enclosed": cluster.enclosed,
                "mask": run_lengths(cluster.pixels).tolist(),
            }
            for cluster in perceived.clusters
        ],
        "background": perceived.background,
        "milliseconds": perceived.milliseconds,
        "note": perceived.segmentation.note,
    }


def run_lengths(indices: IntArray) -> IntArray:
    """Runs (R, 2) of [start, length] of ascending integers (N,)."""
    if not len(indices):
        return np.zeros((0, 2), dtype=np.int64)
    breaks = np.flatnonzero(np.diff(indices) != 1) + 1
    first = np.concatenate([[0], breaks])
    length = np.diff(np.append(first, len(indices)))
    return np.column_stack([indices[first], length]).astype(np.int64)


def box_corners(size: FloatArray) -> FloatArray:
    """(8, 3) corners of a box of that size (3,) [m] about its middle."""
    signs = np.stack(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5]), axis=-1).reshape(-1, 3)
    return np.asarray(signs * size)


def _processed(
    frame: RecordedFrame,
    X_WC: FloatArray | None,
    tool_W: FloatArray,
    config: SegmentationConfig | None,
    background: bool,
) -> tuple[Segmentation, list[tuple[IntArray, Ellipsoid]]]:
    """The segmentation; of each cluster that is reported its pixels and ellipsoid in W."""
    z = None
    if frame.depth is not None and frame.K is not None:
        z = np.require(frame.depth, np.float32, ["C", "W"])
        found = segment_depth(z, frame.K, X_WC, config)
    else:
        found = segment_points(np.asarray(frame.points), X_WC, config)
    reported = []
    for pixels in found.pixels:
        if z is not None and not background and _is_background(z, pixels):
            continue
        # What encloses the hull encloses all; `PerceivedCluster.gauge` is over all.
        p_CQ = _observed(frame, pixels if z is None else row_hulls(z, pixels))
        p_WQ = p_CQ @ found.X_WC[:3, :3].T + found.X_WC[:3, 3]
        reported.append((pixels, enclosing_ellipsoid(p_WQ, tool=tool_W)))
    return found, reported


def _is_background(z: NDArray[np.float32], pixels: IntArray) -> bool:
    """Whether pixels show what is far away and cut by the border of what the camera saw."""
    if np.median(z.ravel()[pixels]) < _BACKGROUND:
        return False
    rows, columns = np.divmod(pixels, z.shape[1])
    others = np.isfinite(z) & (z > 0.0)
    others.ravel()[pixels] = False
    for at, axis in ((rows, 1), (columns, 0)):
        # Stray pixels beside what juts out are no border.
        lines = np.flatnonzero(np.mean(others, axis=axis) > _LEAST_SHARE)
        # What juts out beyond all others, over the edge of a table, is not cut.
        if len(lines) and (
            abs(at.min() - lines[0]) <= _BORDER or abs(at.max() - lines[-1]) <= _BORDER
        ):
            return True
    return False


def _observed(frame: RecordedFrame, pixels: IntArray) -> FloatArray:
    """Points (N, 3) in C of pixels, or of points by their index."""
    if frame.depth is not None and frame.K is not None:
        z = np.require(frame.depth, np.float32, ["C", "W"])
        return np.asarray(back_projected(z, pixels, np.require(frame.K, np.float64, ["C", "W"])))
    return np.asarray(np.asarray(frame.points, dtype=float)[pixels])


def _gauge(points: FloatArray, tool: FloatArray, ellipsoid: Ellipsoid) -> float:
    """Largest gauge of points - tool, all (N, 3), (K, 3) and the ellipsoid in one frame."""
    R, semi_axes = ellipsoid.R, ellipsoid.semi_axes
    squared, _, _ = farthest_pair(
        np.ascontiguousarray(((points - ellipsoid.center) @ R) / semi_axes),
        np.ascontiguousarray((tool @ R) / semi_axes),
    )
    return float(np.sqrt(squared))


def _count_valid(frame: RecordedFrame) -> int:
    if frame.depth is not None:
        with np.errstate(invalid="ignore"):
            return int(np.count_nonzero(np.isfinite(frame.depth) & (frame.depth > 0.0)))
    return int(np.count_nonzero(np.isfinite(np.asarray(frame.points)).all(axis=1)))
