"""A picture of what was seen in one frame: the image with clusters, and the table from above."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_oa.app.perceive import PerceivedFrame
from drake_oa.common.messages import FloatArray
from drake_oa.geometry.ellipsoid import shape_matrix

_ANGLES = np.linspace(0.0, 2.0 * np.pi, 121)
_SHOWN = 20_000  # points of the view from above


def plot_frame(perceived: PerceivedFrame, path: Path) -> None:
    """Writes the picture of a frame.

    Left the depth image (of a cloud: its points as seen along the optical axis) with the
    clusters in colour and the outlines of their ellipsoids; right both seen along the
    table's normal.

    Args:
        perceived: from `drake_oa.app.perceive.perceive`.
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
    figure.savefig(path, dpi=110)


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
