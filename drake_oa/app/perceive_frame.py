"""One recorded frame to clusters, ellipsoids, figures and a picture, for `drake-oa perceive`.

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

from drake_oa.common.files import save_figure
from drake_oa.common.messages import FloatArray, IntArray
from drake_oa.geometry.ellipsoid import Ellipsoid, enclosing_ellipsoid, shape_matrix
from drake_oa.geometry.ellipsoid_kernels import farthest_pair
from drake_oa.perception.config import SegmentationConfig
from drake_oa.perception.depth_image import back_projected, row_hulls
from drake_oa.perception.recordings import RecordedFrame
from drake_oa.perception.segmentation import Segmentation, segment_depth, segment_points

_BACKGROUND = 1.5  # [m]
_BORDER = 5  # [pixel]
_LEAST_SHARE = 0.1  # of a row or column that shows something

_ANGLES = np.linspace(0.0, 2.0 * np.pi, 121)
_SHOWN = 20_000  # points of the view from above

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


# The picture ---------------------------------------------------------------------------


def plot_frame(perceived: PerceivedFrame, path: Path) -> None:
    """Writes the picture of a frame.

    Left the depth image (of a cloud: its points as seen along the optical axis) with the
    clusters in colour and the outlines of their ellipsoids; right both seen along the
    table's normal.

    Args:
        perceived: from `perceive`.
        path: the .png file.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.0, 5.2), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, width_ratios=[1.25, 1.0])
    if perceived.frame.depth is not None:
        _draw_image(left, perceived)
    else:
        _draw_cloud(left, perceived)
    _draw_from_above(right, perceived)
    figure.suptitle(_title(perceived), fontsize=10)
    save_figure(path, figure, dpi=110)


def outline(
    center: FloatArray, R: FloatArray, semi_axes: FloatArray, K: FloatArray
) -> FloatArray | None:
    """The outline (121, 2) of an ellipsoid in the image: columns and rows [pixel].

    The rays that touch the ellipsoid are a cone; its section by the image plane is the
    conic whose dual is P (B - c c^T) P^T, with the shape matrix B and the projection P
    (Hartley and Zisserman, Multiple View Geometry, section 8.3).

    Args:
        center: (3,) centre in the camera frame [m].
        R: (3, 3) its principal axes there.
        semi_axes: (3,) [m].
        K: (4,) fx, fy, cx, cy [pixel].

    Returns:
        The outline, or None when the camera's plane cuts the ellipsoid.
    """
    dual = shape_matrix(R, semi_axes) - np.outer(center, center)
    if center[2] <= 0.0 or dual[2, 2] >= 0.0:
        return None
    dual = dual / -dual[2, 2]
    middle = -dual[:2, 2]
    spread, axes = np.linalg.eigh(dual[:2, :2] + np.outer(middle, middle))
    around = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)])
    tangent = middle[:, None] + axes @ (np.sqrt(np.maximum(spread, 0.0))[:, None] * around)
    return np.asarray((tangent * K[:2, None] + K[2:, None]).T)


def _title(perceived: PerceivedFrame) -> str:
    found = perceived.segmentation
    if found.table is None:
        return f"{perceived.path.name}: {found.note}"
    n = perceived.normal
    return (
        f"{perceived.path.name}: table normal_C ({n[0]:.3f}, {n[1]:.3f}, {n[2]:.3f}), "
        f"offset {perceived.offset:.3f} m, "
        f"rms {1e3 * found.plane_rms:.2f} mm; "
        f"{len(perceived.clusters)} clusters, {perceived.milliseconds:.1f} ms"
    )


def _color(number: int) -> tuple[float, float, float]:
    from matplotlib import colormaps

    red, green, blue, _ = colormaps["tab10"](number % 10)
    return red, green, blue


def _draw_image(axes: Any, perceived: PerceivedFrame) -> None:
    depth, K = perceived.frame.depth, perceived.frame.K
    if depth is None or K is None:
        return
    axes.set_title("depth [m], clusters, outlines of the ellipsoids", fontsize=9)
    shown = np.where(np.isfinite(depth) & (depth > 0.0), depth, np.nan)
    image = axes.imshow(shown, cmap="gray_r", interpolation="nearest")
    axes.figure.colorbar(image, ax=axes, shrink=0.8)
    layer = np.zeros((depth.size, 4))
    for number, cluster in enumerate(perceived.clusters):
        color = _color(number)
        layer[cluster.pixels] = (*color, 0.6)
        e = cluster.ellipsoid
        edge = outline(e.center, e.R, e.semi_axes, K)
        if edge is not None:
            axes.plot(edge[:, 0], edge[:, 1], color=color, linewidth=1.2)
        row, column = np.divmod(cluster.pixels, depth.shape[1])
        _label(axes, number, float(np.median(column)), float(np.median(row)))
    axes.imshow(layer.reshape(*depth.shape, 4), interpolation="nearest")
    axes.set_xlim(-0.5, depth.shape[1] - 0.5)
    axes.set_ylim(depth.shape[0] - 0.5, -0.5)
    axes.set_xlabel("column [pixel]")
    axes.set_ylabel("row [pixel]")


def _draw_cloud(axes: Any, perceived: PerceivedFrame) -> None:
    points = np.asarray(perceived.frame.points)
    axes.set_title("points along the third axis of their frame [m]", fontsize=9)
    _scatter(axes, points[:, :2], "0.75")
    for number, cluster in enumerate(perceived.clusters):
        _scatter(axes, cluster.p_CQ[:, :2], _color(number))
        _label(axes, number, *np.median(cluster.p_CQ[:, :2], axis=0))
        e = cluster.ellipsoid
        edge = _shadow(e.center[:2], shape_matrix(e.R, e.semi_axes)[:2, :2])
        axes.plot(edge[:, 0], edge[:, 1], color=_color(number), linewidth=1.2)
    axes.set_aspect("equal")
    axes.invert_yaxis()


def _draw_from_above(axes: Any, perceived: PerceivedFrame) -> None:
    axes.set_title("from above: x, y of the world frame W [m]", fontsize=9)
    X_WC = perceived.segmentation.X_WC
    for number, cluster in enumerate(perceived.clusters):
        p_WQ = cluster.p_CQ @ X_WC[:3, :3].T + X_WC[:3, 3]
        _scatter(axes, p_WQ[:, :2], _color(number))
        e = cluster.ellipsoid
        center = X_WC[:3, :3] @ e.center + X_WC[:3, 3]
        shape = shape_matrix(X_WC[:3, :3] @ e.R, e.semi_axes)
        edge = _shadow(center[:2], shape[:2, :2])
        axes.plot(edge[:, 0], edge[:, 1], color=_color(number), linewidth=1.2)
        high = float(p_WQ[:, 2].max())
        if perceived.segmentation.table is not None:
            table = perceived.segmentation.table
            high = float((p_WQ @ table.normal_W).max() - table.offset)
        text = f"{number + 1}: {len(p_WQ)} points, {1e3 * high:.0f} mm high"
        axes.plot([], [], color=_color(number), label=text)
    if perceived.clusters:
        axes.legend(fontsize=7, loc="best")
    axes.set_aspect("equal")
    axes.grid(alpha=0.3)


def _shadow(center: FloatArray, shape: FloatArray) -> FloatArray:
    """Boundary (121, 2) of the shadow of an ellipsoid with that part of its shape matrix."""
    spread, axes = np.linalg.eigh(shape)
    around = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)])
    return np.asarray((center[:, None] + axes @ (np.sqrt(spread)[:, None] * around)).T)


def _scatter(axes: Any, points: NDArray[np.floating], color: object) -> None:
    some = points[:: 1 + len(points) // _SHOWN]
    axes.scatter(some[:, 0], some[:, 1], s=1.0, color=color, linewidths=0)


def _label(axes: Any, number: int, x: float, y: float) -> None:
    box = {"boxstyle": "round,pad=0.15", "facecolor": "white", "alpha": 0.8, "linewidth": 0}
    axes.text(x, y, str(number + 1), ha="center", va="center", fontsize=9, bbox=box, zorder=5)
