"""The command `drake-oa perceive`."""

from __future__ import annotations

import json as json_text
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from drake_oa.common.console import BAD_INPUT, FAILED, TextTable, complain, show, write_all
from drake_oa.common.files import check_outputs, replace_text

# NumPy, Drake and the kernels are imported where they are used: `--help` answers at once.
if TYPE_CHECKING:
    from drake_oa.app.perceive_frame import PerceivedFrame
    from drake_oa.common.messages import FloatArray
    from drake_oa.perception.config import SegmentationConfig
    from drake_oa.perception.recordings import DepthCoding


def perceive(
    files: list[Path],
    /,
    *,
    json: Path | None = None,
    plot: Path | None = None,
    intrinsics: tuple[float, float, float, float] | None = None,
    depth_scale: float | None = None,
    pose: tuple[float, float, float, float, float, float] | None = None,
    tool: str = "panda",
    near: float | None = None,
    far: float | None = None,
    background: bool = False,
    repeats: int = 5,
) -> int:
    """Find table, clusters and ellipsoids in depth images and clouds.

    Finds the table (or floor), the clusters of points that stand on it, and for each cluster the
    ellipsoid of least volume round its points dilated by the tool. Files, or folders of them:

      .npz        depth (H, W) [m] and K = [fx, fy, cx, cy], or points (N, 3) [m];
                  optionally X_WC (4, 4)
      .pcd .ply   a cloud [m]; an organised .pcd (HEIGHT above 1) in the camera's frame is
                  read as the depth image it is
      .png        16-bit depth, 0 where missing; with --intrinsics, or a file beside it:
                  NAME.json, NAME.yaml, intrinsics.json, camera_info.yaml, ... that holds
                  fx, fy, cx, cy or K, camera_matrix (ROS), and optionally depth_scale

    Frames: C is the camera's (x right, y down, z forward) or that of the cloud's points, W
    the world of X_WC. Where X_WC is not known the table defines W: z along its normal, the
    origin where the optical axis meets it, x along the camera's.

    JSON: {"tool", "tool_W", "versions", "files": [...]}: tool_W holds the tool's corners [m]
    about its reference point in the orientation of W. For each file, in metres and in frame C:

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
                    these, largest first), round the cluster dilated by the tool
        enclosed    whether every observed point, dilated by every corner of the tool, was
                    found to be inside, up to 1e-9
      background    how many more clusters were left out: beyond 1.5 m and cut by the
                    border of what the camera saw (--background keeps them)
      milliseconds  processor time from the depth array to the ellipsoids, median of
                    --repeats; reading the file is not in it
      note          empty, or why there is no plane

    Exit status: 0 when each file showed a table, 1 when one did not, 2 for bad input: then
    the other files are processed all the same.

    For example:

        drake-oa perceive scans/*.npz --json scans.json --plot pictures
        drake-oa perceive depth.png --intrinsics 525 525 319.5 239.5 --depth-scale 0.001
        drake-oa perceive clouds/ --pose 0 0 0 0 0 0 --tool none

    Args:
        files: files or folders.
        json: write the figures.
        plot: write a picture of each file to this folder.
        intrinsics: of .png images [pixel].
        depth_scale: metres a unit of .png images (default 0.001).
        pose: X_WC of files that hold none, x, y, z [m], roll, pitch, yaw [rad]; all zero: clouds
            in the world frame, z up.
        tool: panda: the hand, pointing down; none: a point; LX,LY,LZ: a box [m] in the
            orientation of W.
        near: least depth [m] (default 0.3).
        far: largest depth [m] (default 2.5).
        background: keep what is far and cut by the border.
        repeats: times a file is timed.
    """
    from drake_oa.app.perceive_frame import as_json, plot_frame
    from drake_oa.app.perceive_frame import perceive as perceive_frame
    from drake_oa.common.files import software_versions
    from drake_oa.perception.recordings import read_frame

    tool_W = _tool(tool)
    coding, config = _coding(intrinsics, depth_scale), _config(near, far)
    X_WC = None if pose is None else _pose(pose)
    if repeats < 1:
        raise ValueError(f"--repeats must be at least 1, not {repeats}")
    paths, status = _expanded(files)
    pictures = {} if plot is None else _pictures(plot, paths)
    check_outputs(json, *pictures.values(), read=paths)

    def look(path: Path) -> PerceivedFrame:
        frame = read_frame(path, coding=coding)
        return perceive_frame(
            frame, tool_W, X_WC=X_WC, config=config, background=background, repeats=repeats
        )

    found = {path: _perceived(path, look) for path in paths}
    seen = [frame for frame in found.values() if not isinstance(frame, str)]
    if seen:
        show(_table(seen))
    writes = [
        partial(plot_frame, frame, pictures[path])
        for path, frame in found.items()
        if path in pictures and not isinstance(frame, str)
    ]
    if json is not None:
        figures = {
            "tool": tool,
            "tool_W": tool_W.tolist(),
            "versions": list(software_versions()),
            "files": [
                {"file": str(path), "error": frame} if isinstance(frame, str) else as_json(frame)
                for path, frame in found.items()
            ],
        }
        text = json_text.dumps(figures, indent=1, allow_nan=False) + "\n"
        writes.append(partial(replace_text, json, text))
    written = write_all(*writes)
    if status or len(seen) < len(found):
        return BAD_INPUT
    usable = all(frame.segmentation.usable for frame in seen)
    return 0 if usable and written else FAILED


def _perceived(path: Path, look: Callable[[Path], PerceivedFrame]) -> PerceivedFrame | str:
    """What a file shows, or why it cannot be used."""
    try:
        found = look(path)
    except (ValueError, OSError) as error:
        complain(str(error))
        return str(error)
    if not found.segmentation.usable:
        complain(f"'{path}': {found.segmentation.note}")
    return found


def _table(seen: Sequence[PerceivedFrame]) -> TextTable:
    """A row for each cluster; those of a file follow its name."""
    header = [
        "file",
        "plane rms [mm]",
        "cluster",
        "points",
        "largest semi-axis [m]",
        "inside",
        "ms",
    ]
    rows = []
    for frame in seen:
        rms = frame.segmentation.plane_rms
        head = [frame.path.name, "-" if math.isnan(rms) else f"{1e3 * rms:.2f}"]
        time = f"{frame.milliseconds:.1f}"
        if not frame.clusters:
            rows.append([*head, "none", "", "", "", time])
        for number, cluster in enumerate(frame.clusters, start=1):
            rows.append(
                [
                    *(head if number == 1 else ["", ""]),
                    str(number),
                    str(len(cluster.pixels)),
                    f"{cluster.ellipsoid.semi_axes[0]:.3f}",
                    "all" if cluster.enclosed else "NOT ALL",
                    time if number == 1 else "",
                ]
            )
    return TextTable(header, rows, "lrrrrrr")


def _expanded(files: Sequence[Path]) -> tuple[list[Path], int]:
    """The files, folders being replaced by what they hold; and the exit status so far."""
    from drake_oa.perception.recordings import SUFFIXES, frame_files

    paths: list[Path] = []
    status = 0
    for file in files:
        if not file.is_dir():
            if file.exists():
                paths.append(file)
                continue
            complain(f"there is no file '{file}'")
            status = BAD_INPUT
            continue
        found = [path for path in frame_files(file) if path.suffix.lower() in SUFFIXES]
        if not found:
            complain(f"the folder '{file}' holds no file to read; valid are {', '.join(SUFFIXES)}")
            status = BAD_INPUT
        paths.extend(found)
    return list(dict.fromkeys(paths)), status


def _pictures(folder: Path, paths: Sequence[Path]) -> dict[Path, Path]:
    """Where each file's picture goes; files of one name do not overwrite each other."""
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"--plot: '{folder}' is a file; it must be a folder")
    pictures: dict[Path, Path] = {}
    taken: set[str] = set()
    for path in paths:
        name, number = path.stem, 2
        while name in taken:
            name, number = f"{path.stem}_{number}", number + 1
        taken.add(name)
        pictures[path] = folder / f"{name}.png"
    return pictures


def _tool(text: str) -> FloatArray:
    """Corners of the tool (K, 3) in W orientation [m]."""
    import numpy as np

    from drake_oa.app.perceive_frame import box_corners

    if text == "none":
        return np.zeros((1, 3))
    if text == "panda":
        from drake_oa.robot.config import Robot
        from drake_oa.robot.plant import tool_corners

        return tool_corners(Robot())
    try:
        size = np.array([float(word) for word in text.split(",")])
    except ValueError:
        size = np.zeros(0)
    if size.shape != (3,) or not np.isfinite(size).all() or (size < 0.0).any():
        raise ValueError(f"--tool must be panda, none or LX,LY,LZ [m], not '{text}'")
    return box_corners(size)


def _coding(intrinsics: Sequence[float] | None, scale: float | None) -> DepthCoding:
    from drake_oa.perception.recordings import DepthCoding, checked_intrinsics

    if scale is not None and not 0.0 < scale < math.inf:
        raise ValueError(f"--depth-scale must be positive [m a unit], not {scale}")
    if intrinsics is None:
        return DepthCoding(None, scale)
    return DepthCoding(checked_intrinsics(intrinsics, "--intrinsics"), scale)


def _config(near: float | None, far: float | None) -> SegmentationConfig:
    from drake_oa.common.config import check_values
    from drake_oa.perception.config import SegmentationConfig

    default = SegmentationConfig()
    config = replace(
        default,
        near=default.near if near is None else near,
        far=default.far if far is None else far,
    )
    try:
        check_values(config)
    except ValueError as error:
        raise ValueError(f"--near, --far: {error}") from None
    return config


def _pose(values: Sequence[float]) -> FloatArray:
    """X_WC (4, 4) from x, y, z [m], roll, pitch, yaw [rad]."""
    import numpy as np
    from pydrake.math import RigidTransform, RollPitchYaw

    if not np.isfinite(values).all():
        raise ValueError(f"--pose must be six finite numbers, not {list(values)}")
    return np.array(RigidTransform(RollPitchYaw(values[3:]), values[:3]).GetAsMatrix4())
