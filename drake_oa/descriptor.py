"""From obstacle clouds to descriptors: one ellipsoid an obstacle, the tool included."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from drake_oa.ellipsoid import Ellipsoid, checked_points, dilate, enclosing_ellipsoid, right_handed
from drake_oa.superquadric import fit_superquadric
from drake_oa.values import EllipsoidSet, FloatArray, ObstacleClouds

Method = Literal["enclosing", "least_squares"]


def check_descriptor_arguments(tool_W: ArrayLike, method: str) -> FloatArray:
    """The tool's vertices as an array of their own.

    Raises:
        ValueError: if the tool is empty, not (K, 3) or not finite, or the method unknown.
    """
    if method not in get_args(Method):
        raise ValueError(f"method '{method}'; it must be one of {', '.join(get_args(Method))}")
    return np.array(checked_points(tool_W, "tool_W"))


def least_squares_ellipsoid(
    points: ArrayLike, *, tool: ArrayLike, minimum_semi_axis: float = 1e-3
) -> Ellipsoid:
    """The paper's descriptor: eq. sq_min, squared, with lambda_4 = lambda_5 = 1.

    Fitted to the support points of the dilated cloud. It runs through the cloud, not
    round it: parts of the obstacle stay outside, and `gauge` is left unchecked (inf).

    Args:
        points: (N, 3) points in W [m].
        tool: (K, 3) vertices of the tool, as in `ellipsoid.dilate` [m].
        minimum_semi_axis: least semi-axis [m].

    Raises:
        ValueError: if points or tool are empty, not (., 3) or not finite.
    """
    fit = fit_superquadric(dilate(points, tool), minimum_semi_axis=minimum_semi_axis).shape
    order = np.argsort(-fit.semi_axes, kind="stable")
    return Ellipsoid(fit.center, right_handed(fit.R[:, order]), fit.semi_axes[order], np.inf)


def describe(
    obstacles: ObstacleClouds,
    tool_W: ArrayLike,
    *,
    method: Method = "enclosing",
    minimum_semi_axis: float = 1e-3,
) -> EllipsoidSet:
    """The unified system-obstacle descriptors of all clouds.

    Points that are not finite are left out and noted; an obstacle without any
    other point is dropped and noted. Velocities are zero: one frame shows none.

    Args:
        obstacles: M clouds in W [m], their names, stamp, table and note.
        tool_W: (K, 3) vertices of the tool's convex geometry from the TCP, in W
            orientation [m].
        method: "enclosing" (`ellipsoid.enclosing_ellipsoid`) or "least_squares".
        minimum_semi_axis: least semi-axis [m].

    Raises:
        ValueError: for a bad tool or method, clouds that are not (N, 3), or another number of
            ids than of clouds.
    """
    tool = check_descriptor_arguments(tool_W, method)
    if len(obstacles.ids) != len(obstacles.clouds_W):
        raise ValueError(
            f"obstacles_W holds {len(obstacles.clouds_W)} clouds but {len(obstacles.ids)} ids"
        )
    fit = enclosing_ellipsoid if method == "enclosing" else least_squares_ellipsoid
    found: list[Ellipsoid] = []
    ids: list[int] = []
    notes = [obstacles.note] if obstacles.note else []
    for name, cloud in zip(obstacles.ids.tolist(), obstacles.clouds_W, strict=True):
        points = np.asarray(cloud, dtype=float)
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"cloud of obstacle {name} must be (N, 3), not {points.shape}")
        finite = np.isfinite(points).all(axis=1)
        if not finite.any():
            notes.append(f"obstacle {name} dropped: none of its {len(points)} points is finite")
            continue
        if not finite.all():
            lost = len(points) - int(finite.sum())
            notes.append(f"obstacle {name}: {lost} of {len(points)} points are not finite")
            points = points[finite]
        found.append(fit(points, tool=tool, minimum_semi_axis=minimum_semi_axis))
        ids.append(name)
    return EllipsoidSet(
        stamp=obstacles.stamp,
        p_WO=np.array([e.center for e in found]).reshape(-1, 3),
        R_WO=np.array([e.R for e in found]).reshape(-1, 3, 3),
        semi_axes=np.array([e.semi_axes for e in found]).reshape(-1, 3),
        v_WO=np.zeros((len(found), 3)),
        ids=np.array(ids, dtype=np.int64),
        table=obstacles.table,
        note="; ".join(notes),
    )
