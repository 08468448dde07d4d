"""Command `drake-oa perceive`: finds the table, clusters and their ellipsoids in recorded depth
images and clouds.

C is the frame of the camera, or of the points of a cloud; W is the world frame of the camera pose
X_WC. The tool is described in the orientation of W; all results are in C.
"""

from __future__ import annotations

import statistics
import time
import timeit
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from drake_oa.common.console import BAD_INPUT, FAILED, Column, TextTable, complain, show
from drake_oa.common.files import check_outputs, replace_json

# NumPy, Drake and the kernels are imported where they are used: `--help` answers at once.
if TYPE_CHECKING:
    from drake_oa.common.messages import FloatArray
    from drake_oa.perception.config import SegmentationConfig
    from drake_oa.perception.recordings import RecordedFrame

_ENCLOSED_TOLERANCE = 1e-9
"""Tolerance within which a point outside an ellipsoid still counts as enclosed [-].

It is the distance from the point to the surface along the line to the center, relative to the
distance from the center to the surface on this line."""
_REPEATS = 5
"""Number of repetitions of the computation for a file, whose median processor time is reported."""


def perceive(
    files: list[Path],
    /,
    *,
    json: Path | None = None,
    intrinsics: tuple[float, float, float, float] | None = None,
    depth_scale: float | None = None,
    pose: tuple[float, float, float, float, float, float] | None = None,
    tool: Literal["panda", "none"] = "panda",
) -> int:
    """Find the table, clusters and their ellipsoids in depth images and clouds.

    The table (or floor) is the support plane. For each cluster of points above it, the ellipsoid
    has the minimum volume around the points dilated by the tool. Files, or folders of them:

      .npz        depth (H, W) [m] and K = [fx, fy, cx, cy], or points (N, 3) [m];
                  optionally X_WC (4, 4); empty arrays are invalid
      .pcd .ply   a cloud [m] in the frame of its camera, or in the world frame with
                  --pose 0 0 0 0 0 0
      .png        16-bit depth, 0 where missing; with --intrinsics, or a file in the same folder
                  (NAME.json, NAME.yaml, intrinsics.json, camera_info.yaml, ...) with
                  fx, fy, cx, cy or K, camera_matrix (ROS), and optionally depth_scale

    C is the frame of the camera (x right, y down, z forward), or of the points of a cloud. W is the
    world frame of the camera pose X_WC. If X_WC is unknown, the table defines W: z along the normal
    of the table, the origin at its intersection with the optical axis, x along the camera's x axis.

    The table has a row for each cluster, and these columns:

      file                   name of the file
      plane rms [mm]         RMS distance of the points of the table to its plane
      cluster                number of the cluster; none: no cluster was found. If a cloud without
                             a camera pose has none, a line below the table names its file
      points                 number of pixels or points of the cluster
      largest semi-axis [m]  largest semi-axis of the ellipsoid
      inside                 all: the ellipsoid contains all dilated points; else NOT ALL
      CPU time [ms]          processor time of the file, see milliseconds below

    JSON: {"tool", "tool_W", "versions", "files": [...]}. tool_W are the corners of the tool [m]
    about its reference point, in the orientation of W. For each file, in meters and in frame C:

      file          path of the file
      error         reason for which the file cannot be used; it then has no other keys
      size, K       [rows, columns] and [fx, fy, cx, cy] of an image; null for a cloud
      count, valid  number of pixels or points, and of those with a measurement
      X_WC          4 x 4 pose of C in W, from the input or the table; null without a table
      plane         normal (toward the free side), offset (normal . p = offset), rms (of the
                    distances of its points); null without a table
      clusters      clusters in the order of decreasing size (number of voxels), each with
        points      number of pixels or points
        mask        [[start, length], ...]: runs of pixels by row-major index (row * columns +
                    column), or of points by their row in the file
        ellipsoid   center, R (its columns are the principal axes), semi_axes (along these, in
                    decreasing order) of the ellipsoid around the cluster dilated by the tool
        enclosed    whether the ellipsoid contains every observed point dilated by every corner
                    of the tool, up to 1e-9 of the distance from center to surface
      milliseconds  processor time from the depth array to the ellipsoids, without reading the
                    file; median of five
      note          reason for which there is no plane, or empty

    Exit status: 0 if each file has a table, 1 if one has none, 2 for invalid input; the other files
    are processed in any case.

    For example:

        drake-oa perceive scans/*.npz --json scans.json
        drake-oa perceive depth.png --intrinsics 525 525 319.5 239.5 --depth-scale 0.001
        drake-oa perceive clouds/ --pose 0 0 0 0 0 0 --tool none

    Args:
        files: files or folders.
        json: write the results to this file.
        intrinsics: fx, fy, cx, cy of .png images [pixel].
        depth_scale: depth of one unit of .png images [m] (default: 0.001).
        pose: pose X_WC of files without one: x, y, z [m], roll, pitch, yaw [rad]; all zero: clouds
            in the world frame, z up.
        tool: panda: the Panda's hand, pointing down; none: a point.
    """
    import numpy as np
    from pydrake.math import RigidTransform, RollPitchYaw

    from drake_oa.common.files import software_versions
    from drake_oa.perception.config import SegmentationConfig
    from drake_oa.perception.recordings import SUFFIXES, checked_intrinsics, frame_files, read_frame
    from drake_oa.robot.config import Robot
    from drake_oa.robot.plant import tool_link_corners

    tool_W = np.zeros((1, 3)) if tool == "none" else np.concatenate(tool_link_corners(Robot()))
    K = None if intrinsics is None else checked_intrinsics(intrinsics, "--intrinsics")
    X_WC = None
    if pose is not None:
        X_WC = RigidTransform(RollPitchYaw(pose[3:]), pose[:3]).GetAsMatrix4()
    paths: dict[Path, None] = {}
    for file in files:
        members = frame_files(file) if file.is_dir() else []
        frames = [path for path in members if path.suffix.lower() in SUFFIXES]
        if file.is_dir() and not frames:
            raise ValueError(f"folder '{file}' contains no {', '.join(SUFFIXES)} file")
        paths |= dict.fromkeys(frames or [file])
    check_outputs(json, read=paths)
    status = 0
    results: list[dict[str, Any]] = []
    unposed: list[str] = []
    for path in paths:
        try:
            frame = read_frame(path, K=K, depth_scale=depth_scale)
            results.append(perceive_frame(frame, tool_W, SegmentationConfig(), X_WC=X_WC))
            is_posed = pose or frame.depth is not None or frame.X_WC is not None
            if not (is_posed or results[-1]["clusters"]):
                unposed.append(path.name)
        except (ValueError, OSError) as error:
            complain(str(error))
            results.append({"file": str(path), "error": str(error)})
            status = BAD_INPUT
            continue
        if results[-1]["plane"] is None:
            complain(f"'{path}': {results[-1]['note']}")
            status = status or FAILED
    show(_table(results))
    if unposed:
        names = ", ".join(unposed)
        print(f"{names}: read in the frame of a camera; in the world frame: --pose 0 0 0 0 0 0")
    header = {"tool": tool, "tool_W": tool_W.tolist(), "versions": software_versions()}
    replace_json(json, header | {"files": results})
    return status


def perceive_frame(
    frame: RecordedFrame,
    tool_W: FloatArray,
    config: SegmentationConfig,
    *,
    X_WC: FloatArray | None = None,
) -> dict[str, Any]:
    """Segments a recorded frame, computes the ellipsoids of its clusters dilated by the tool, and
    measures the processor time.

    Args:
        frame: depth image with the intrinsics K = [fx, fy, cx, cy], or points.
        tool_W: (M, 3) corners of the tool about its reference point, in the orientation of the
            world frame W [m]; [[0, 0, 0]] for a point.
        config: parameters of the segmentation, which finds the table and clusters of points.
        X_WC: (4, 4) pose of the camera in W for a frame without one; None: unknown.

    Returns:
        Results for the file of the frame, with the keys that `drake-oa perceive --help` lists.

    Raises:
        ValueError: if an array has a wrong shape.
    """
    import numpy as np

    from drake_oa.geometry.ellipsoid import enclosing_ellipsoid
    from drake_oa.geometry.pinhole import pixel_rays
    from drake_oa.perception.recorded_perception import segment_frame

    def work() -> tuple[Any, ...]:
        segmentation = segment_frame(frame, X_WC, config)
        points = np.asarray(frame.points, dtype=float)
        if frame.depth is not None and frame.K is not None:
            rays = pixel_rays(frame.depth.shape, *frame.K.tolist())
            points = (rays * frame.depth.reshape(-1, 1)).astype(float)
        tool_C = tool_W @ segmentation.X_WC[:3, :3]
        ellipsoids = [enclosing_ellipsoid(points[i], tool=tool_C) for i in segmentation.pixels]
        return points, segmentation, ellipsoids

    points, segmentation, ellipsoids = work()
    # The computation has one thread, and its processor time does not depend on other processes.
    times = timeit.repeat(work, timer=time.process_time, number=1, repeat=_REPEATS)
    plane, X_WC = None, segmentation.X_WC
    if segmentation.table is not None:
        plane = {
            "normal": (X_WC[:3, :3].T @ segmentation.table.normal_W).tolist(),
            "offset": float(segmentation.table.offset - segmentation.table.normal_W @ X_WC[:3, 3]),
            "rms": segmentation.plane_rms,
        }
    clusters = []
    for pixels, ellipsoid in zip(segmentation.pixels, ellipsoids, strict=True):
        runs = np.split(pixels, np.flatnonzero(np.diff(pixels) != 1) + 1)
        shape = {name: getattr(ellipsoid, name).tolist() for name in ("center", "R", "semi_axes")}
        clusters.append(
            {
                "points": len(pixels),
                "ellipsoid": shape,
                "enclosed": ellipsoid.gauge <= 1.0 + _ENCLOSED_TOLERANCE,
                "mask": [[int(run[0]), len(run)] for run in runs],
            }
        )
    return {
        "file": str(frame.path),
        "size": None if frame.depth is None else list(frame.depth.shape),
        "K": None if frame.K is None else frame.K.tolist(),
        "count": len(points),
        "valid": int((np.isfinite(points).all(axis=1) & points.any(axis=1)).sum()),
        "X_WC": X_WC.tolist() if plane else None,
        "plane": plane,
        "clusters": clusters,
        "milliseconds": 1e3 * statistics.median(times),
        "note": segmentation.note,
    }


_COLUMNS = (
    Column("file"),
    Column("rms", "plane rms [mm]", "{:.2f}", 1e3),
    Column("cluster"),
    Column("points"),
    Column("semi_axis", "largest semi-axis [m]", "{:.3f}"),
    Column("inside"),
    Column("milliseconds", "CPU time [ms]", "{:.1f}"),
)
"""Columns (key, heading, format, scale) of the table that `drake-oa perceive --help` explains."""


def _table(results: Sequence[dict[str, Any]]) -> TextTable:
    """Returns the table that `drake-oa perceive` prints: a row for each cluster, or for a file
    without clusters.

    Args:
        results: results of all files, as `perceive_frame` returns them.
    """
    rows: list[dict[str, Any]] = []
    for result in results:
        if "error" in result:
            continue
        name, rms = Path(result["file"]).name, result["plane"] and result["plane"]["rms"]
        of_file = {"file": name, "rms": rms, "milliseconds": result["milliseconds"]}
        for number, cluster in enumerate(result["clusters"], start=1):
            rows.append(
                {
                    **of_file,
                    "cluster": number,
                    "points": cluster["points"],
                    "semi_axis": cluster["ellipsoid"]["semi_axes"][0],
                    "inside": "all" if cluster["enclosed"] else "NOT ALL",
                }
            )
        if not result["clusters"]:
            rows.append({**of_file, "cluster": "none"})
    return TextTable(_COLUMNS, rows)
