"""The command `drake-oa perceive`.

Frames: C is the frame of the camera, or of the points of a cloud; W the world of X_WC. The tool is
given in the orientation of W; all results are in C.
"""

from __future__ import annotations

import statistics
import time
import timeit
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from drake_oa.common.console import BAD_INPUT, FAILED, Column, TextTable, complain, show, write_all
from drake_oa.common.files import check_outputs, replace_json, saved_figure

# NumPy, Drake and the kernels are imported where they are used: `--help` answers at once.
if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from drake_oa.common.messages import FloatArray, IntArray
    from drake_oa.geometry.ellipsoid import Ellipsoid
    from drake_oa.perception.config import SegmentationConfig
    from drake_oa.perception.recordings import RecordedFrame
    from drake_oa.perception.segmentation import Segmentation

_ENCLOSED_TOLERANCE = 1e-9
"""Excess of the gauge of a dilated point over 1 up to which the point counts as enclosed."""


def perceive(
    files: list[Path],
    /,
    *,
    json: Path | None = None,
    plot: Path | None = None,
    intrinsics: tuple[float, float, float, float] | None = None,
    depth_scale: float | None = None,
    pose: tuple[float, float, float, float, float, float] | None = None,
    tool: Literal["panda", "none"] = "panda",
) -> int:
    """Find table, clusters and ellipsoids in depth images and clouds.

    Finds the table (or floor), the clusters of points that stand on it, and for each cluster the
    ellipsoid of least volume around its points dilated by the tool. Files, or folders of them:

      .npz        depth (H, W) [m] and K = [fx, fy, cx, cy], or points (N, 3) [m];
                  optionally X_WC (4, 4)
      .pcd .ply   a cloud [m]; an organized .pcd (HEIGHT above 1) in the camera's frame is
                  read as the depth image it is
      .png        16-bit depth, 0 where missing; with --intrinsics, or a file beside it:
                  NAME.json, NAME.yaml, intrinsics.json, camera_info.yaml, ... that holds
                  fx, fy, cx, cy or K, camera_matrix (ROS), and optionally depth_scale

    Frames: C is the camera's (x right, y down, z forward) or that of the cloud's points, W
    the world of X_WC. Where X_WC is not known the table defines W: z along its normal, the
    origin where the optical axis meets it, x along the camera's.

    JSON: {"tool", "tool_W", "versions", "files": [...]}: tool_W holds the tool's corners [m]
    about its reference point in the orientation of W. For each file, in meters and in frame C:

      file          its path
      error         only if it cannot be used: why; then there is nothing else
      size, K       [rows, columns] and [fx, fy, cx, cy] of an image; null for a cloud
      count, valid  number of pixels or points, and of those that hold a measurement
      X_WC          4 x 4 pose of C in W, given or from the table; null without a table
      plane         normal (towards the free side), offset (normal . p = offset), rms (of
                    the distances of its points); null when no table was found
      clusters      the one that shows the largest surface first, each with
        points      number of its pixels or points
        mask        [[start, length], ...]: runs of its pixels by row-major index (row *
                    columns + column), or of its points by their place in the file
        ellipsoid   center, R (its columns are the principal axes), semi_axes (along
                    these, largest first), around the cluster dilated by the tool
        enclosed    whether every observed point, dilated by every corner of the tool, was
                    found to be inside, up to 1e-9
      milliseconds  processor time from the depth array to the ellipsoids, median of
                    five; reading the file is not in it
      note          empty, or why there is no plane

    Exit status: 0 when each file showed a table, 1 when one did not, 2 for bad input: then
    the other files are processed all the same.

    For example:

        drake-oa perceive scans/*.npz --json scans.json --plot pictures
        drake-oa perceive depth.png --intrinsics 525 525 319.5 239.5 --depth-scale 0.001
        drake-oa perceive clouds/ --pose 0 0 0 0 0 0 --tool none

    Args:
        files: files or folders.
        json: write the results.
        plot: write a picture of each file to this folder.
        intrinsics: of .png images [pixel].
        depth_scale: meters a unit of .png images (default 0.001).
        pose: X_WC of files that hold none, x, y, z [m], roll, pitch, yaw [rad]; all zero: clouds
            in the world frame, z up.
        tool: panda: the hand, pointing down; none: a point.
    """
    from pydrake.math import RigidTransform, RollPitchYaw

    from drake_oa.common.files import software_versions
    from drake_oa.perception.config import SegmentationConfig
    from drake_oa.perception.recordings import checked_intrinsics, read_frame

    tool_W, config = _tool_corners(tool), SegmentationConfig()
    K = None if intrinsics is None else checked_intrinsics(intrinsics, "--intrinsics")
    X_WC = None
    if pose is not None:
        X_WC = RigidTransform(RollPitchYaw(pose[3:]), pose[:3]).GetAsMatrix4()
    paths = _expand_folders(files)
    pictures = _picture_files(plot, paths) if plot is not None else {}
    check_outputs(json, *pictures.values(), read=paths)
    status = 0
    results: list[dict[str, Any]] = []
    writes: list[Callable[[], object]] = []
    for path in paths:
        try:
            frame = read_frame(path, K=K, depth_scale=depth_scale)
            perceived = perceive_frame(frame, tool_W, config, X_WC=X_WC)
        except (ValueError, OSError) as error:
            complain(str(error))
            results.append({"file": str(path), "error": str(error)})
            status = BAD_INPUT
            continue
        results.append(perceived.as_json())
        if path in pictures:
            writes.append(partial(plot_frame, perceived, pictures[path]))
        if not perceived.segmentation.usable:
            complain(f"'{path}': {perceived.segmentation.note}")
            status = status or FAILED
    show(_table(results))
    if json is not None:
        made = {"tool": tool, "tool_W": tool_W.tolist(), "versions": list(software_versions())}
        writes.append(partial(replace_json, json, made | {"files": results}))
    return status if write_all(*writes) else status or FAILED


@dataclass(frozen=True, eq=False)
class PerceivedFrame:
    """Table, clusters and ellipsoids of one frame.

    Attributes:
        frame: content of the file.
        points: (N, 3) all its points in C [m]; not finite, or zero, where there is none.
        segmentation: table and clusters; its X_WC is set also when the table defines W.
        ellipsoids: of least volume around the points of each cluster dilated by the tool, in C.
        milliseconds: processor time from the depth array to the ellipsoids, median of the
            repetitions.
    """

    frame: RecordedFrame
    points: FloatArray
    segmentation: Segmentation
    ellipsoids: list[Ellipsoid]
    milliseconds: float

    def as_json(self) -> dict[str, Any]:
        """Returns the results of the file in the form of `drake-oa perceive --help`."""
        import numpy as np

        depth, K, found = self.frame.depth, self.frame.K, self.segmentation
        plane, X_WC = None, found.X_WC
        if found.table is not None:
            plane = {
                "normal": (X_WC[:3, :3].T @ found.table.normal_W).tolist(),
                "offset": float(found.table.offset - found.table.normal_W @ X_WC[:3, 3]),
                "rms": found.plane_rms,
            }
        measured = np.isfinite(self.points).all(axis=1) & self.points.any(axis=1)
        return {
            "file": str(self.frame.path),
            "size": None if depth is None else list(depth.shape),
            "K": None if K is None else K.tolist(),
            "count": len(self.points),
            "valid": int(np.count_nonzero(measured)),
            "X_WC": X_WC.tolist() if plane else None,
            "plane": plane,
            "clusters": [
                {
                    "points": len(pixels),
                    "ellipsoid": {
                        name: getattr(ellipsoid, name).tolist()
                        for name in ("center", "R", "semi_axes")
                    },
                    "enclosed": ellipsoid.gauge <= 1.0 + _ENCLOSED_TOLERANCE,
                    "mask": run_lengths(pixels),
                }
                for pixels, ellipsoid in zip(found.pixels, self.ellipsoids, strict=True)
            ],
            "milliseconds": self.milliseconds,
            "note": found.note,
        }


def perceive_frame(
    frame: RecordedFrame,
    tool_W: FloatArray,
    config: SegmentationConfig,
    *,
    X_WC: FloatArray | None = None,
    repeats: int = 5,
) -> PerceivedFrame:
    """Segments a frame, encloses its clusters, and measures the time.

    Args:
        frame: a depth image with K, or points.
        tool_W: (K, 3) corners of the tool about its reference point, in the orientation of W
            [m]; [[0, 0, 0]] for a point.
        config: parameters of the segmentation.
        X_WC: (4, 4) pose of the camera for a frame that does not hold one; None: unknown.
        repeats: number of measurements of the time, after a first call.

    Raises:
        ValueError: for malformed arrays.
    """
    import numpy as np

    from drake_oa.geometry.ellipsoid import enclosing_ellipsoid
    from drake_oa.perception.depth_image import back_projected
    from drake_oa.perception.recorded_perception import segment_frame

    def work() -> tuple[FloatArray, Segmentation, list[Ellipsoid]]:
        found = segment_frame(frame, X_WC, config)
        points = np.asarray(frame.points, dtype=float)
        if frame.depth is not None and frame.K is not None:
            z = np.require(frame.depth, np.float32, ["C", "W"])
            points = back_projected(z, np.arange(z.size), frame.K)
        tool_C = tool_W @ found.X_WC[:3, :3]
        return points, found, [enclosing_ellipsoid(points[i], tool=tool_C) for i in found.pixels]

    result = work()
    # Processor time: one thread works, and other processes may be busy.
    times = timeit.repeat(work, timer=time.process_time, number=1, repeat=repeats)
    return PerceivedFrame(frame, *result, 1e3 * statistics.median(times))


def run_lengths(indices: IntArray) -> list[list[int]]:
    """Returns the runs [start, length] of ascending integers."""
    import numpy as np

    runs = np.split(indices, np.flatnonzero(np.diff(indices) != 1) + 1)
    return [[int(run[0]), len(run)] for run in runs if len(run)]


_COLUMNS = (
    Column("file"),
    Column("rms", "plane rms [mm]", "{:.2f}", 1e3),
    Column("cluster"),
    Column("points"),
    Column("semi_axis", "largest semi-axis [m]", "{:.3f}"),
    Column("inside"),
    Column("milliseconds", "ms", "{:.1f}"),
)


def _table(results: Sequence[dict[str, Any]]) -> TextTable:
    """Returns a table with a row for each cluster; those of one file follow its name."""
    blank = dict.fromkeys((column.key for column in _COLUMNS), "")
    rows: list[dict[str, Any]] = []
    for result in results:
        if "error" in result:
            continue
        clusters = [
            {
                "cluster": number,
                "points": cluster["points"],
                "semi_axis": cluster["ellipsoid"]["semi_axes"][0],
                "inside": "all" if cluster["enclosed"] else "NOT ALL",
            }
            for number, cluster in enumerate(result["clusters"], start=1)
        ] or [{"cluster": "none"}]
        rms = result["plane"] and result["plane"]["rms"]
        clusters[0] |= result | {"file": Path(result["file"]).name, "rms": rms}
        rows += [blank | cluster for cluster in clusters]
    return TextTable(_COLUMNS, rows)


def _expand_folders(files: Sequence[Path]) -> list[Path]:
    """Returns the files, a folder being replaced by the frames in it if there are any."""
    from drake_oa.perception.recordings import SUFFIXES, frame_files

    paths: list[Path] = []
    for file in files:
        inside = frame_files(file) if file.is_dir() else []
        paths += [path for path in inside if path.suffix.lower() in SUFFIXES] or [file]
    return list(dict.fromkeys(paths))


def _picture_files(folder: Path, paths: Sequence[Path]) -> dict[Path, Path]:
    """Returns the file of the picture of each path, numbered where names are equal."""
    count = Counter[str]()
    pictures = {}
    for path in paths:
        count[path.stem] += 1
        number = f"_{count[path.stem]}" if count[path.stem] > 1 else ""
        pictures[path] = folder / f"{path.stem}{number}.png"
    return pictures


def _tool_corners(text: str) -> FloatArray:
    """Returns the corners of the tool (K, 3) in the orientation of W [m]."""
    import numpy as np

    if text == "none":
        return np.zeros((1, 3))
    from drake_oa.robot.config import Robot
    from drake_oa.robot.plant import tool_corners

    return tool_corners(Robot())


def plot_frame(perceived: PerceivedFrame, path: Path) -> None:
    """Writes the picture of a frame.

    Left the depth image, or a cloud along the third axis of its frame, right the view from above
    in W; in both the clusters in color and the outlines of their ellipsoids.

    Args:
        perceived: from `perceive_frame`.
        path: the .png file.
    """
    import numpy as np

    found, depth, K = perceived.segmentation, perceived.frame.depth, perceived.frame.K
    plane = f"table rms {1e3 * found.plane_rms:.2f} mm" if found.table else found.note
    title = (
        f"{perceived.frame.path.name}: {plane}; {len(found.pixels)} clusters, "
        f"{perceived.milliseconds:.1f} ms"
    )
    with saved_figure(path, 13.0, 5.2, title) as figure:
        left, right = figure.subplots(1, 2, width_ratios=[1.25, 1.0])
        if depth is not None and K is not None:
            image = left.imshow(np.where(depth > 0.0, depth, np.nan), cmap="gray_r")
            figure.colorbar(image, ax=left, shrink=0.8, label="depth [m]")
            _draw_clusters(left, perceived, lambda p: p[:, :2] / p[:, 2:] * K[:2] + K[2:])
            left.set(xlabel="column [pixel]", ylabel="row [pixel]")
            left.grid(visible=False)
            left.set(xlim=(-0.5, depth.shape[1] - 0.5), ylim=(depth.shape[0] - 0.5, -0.5))
        else:
            left.plot(perceived.points[:, 0], perceived.points[:, 1], ",", color="0.75")
            _draw_clusters(left, perceived, lambda p: p[:, :2])
            left.set(xlabel="x of C [m]", ylabel="y of C [m]", aspect="equal")
            left.invert_yaxis()
        X_WC = found.X_WC
        _draw_clusters(right, perceived, lambda p: (p @ X_WC[:3, :3].T + X_WC[:3, 3])[:, :2])
        right.set(xlabel="x of W [m]", ylabel="y of W [m]", aspect="equal")


def _draw_clusters(
    axes: Axes, perceived: PerceivedFrame, project: Callable[[FloatArray], FloatArray]
) -> None:
    """Draws clusters and outlines of ellipsoids, their points (N, 3) in C being projected."""
    import numpy as np
    from scipy.spatial import ConvexHull

    from drake_oa.geometry.ellipsoid import unit_directions

    pairs = zip(perceived.segmentation.pixels, perceived.ellipsoids, strict=True)
    for number, (pixels, ellipsoid) in enumerate(pairs):
        color = f"C{number % 10}"
        x, y = project(perceived.points[pixels]).T
        axes.plot(x, y, ",", color=color)
        axes.text(np.median(x), np.median(y), str(number + 1), backgroundcolor="white")
        surface = ellipsoid.center + unit_directions() * ellipsoid.semi_axes @ ellipsoid.R.T
        # A camera inside an ellipsoid, or beside it, sees no closed outline.
        if perceived.frame.depth is None or (surface[:, 2] > 0.0).all():
            outline = project(surface)
            axes.fill(*outline[ConvexHull(outline).vertices].T, fill=False, edgecolor=color)
