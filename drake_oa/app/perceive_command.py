"""The command `drake-oa perceive`."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drake_oa.app.command_line import add_verbose
from drake_oa.common.console import BAD_INPUT, FAILED, complain
from drake_oa.common.files import check_outputs, replace_text
from drake_oa.common.messages import FloatArray
from drake_oa.common.text_tables import aligned

if TYPE_CHECKING:
    from drake_oa.app.perceive import PerceivedFrame
    from drake_oa.perception.config import SegmentationConfig
    from drake_oa.perception.recordings import DepthCoding

_DESCRIPTION = """\
Finds the table (or floor) in depth images and clouds, the clusters of points that stand
on it, and for each cluster the ellipsoid of least volume round its points dilated by the
tool. Files, or folders of them:

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
"""

_EPILOG = """\
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

The mask in NumPy: mask = np.zeros(rows * columns, bool); for s, n in runs: mask[s:s+n] = True

Exit status: 0 when each file showed a table, 1 when one did not, 2 for bad input: then
the other files are processed all the same.

examples:
  drake-oa perceive scans/*.npz --json scans.json --plot pictures
  drake-oa perceive depth.png --intrinsics 525 525 319.5 239.5 --depth-scale 0.001
  drake-oa perceive clouds/ --pose 0 0 0 0 0 0 --tool none
"""


def add_parser(commands: Any) -> None:
    """Adds the subcommand to those of `drake-oa`."""
    parser = commands.add_parser(
        "perceive",
        help="find table, clusters and ellipsoids in depth images and clouds",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE", help="file or folder")
    parser.add_argument("--json", type=Path, metavar="F", help="write the figures")
    parser.add_argument(
        "--plot", type=Path, metavar="DIR", help="write a picture of each file to this folder"
    )
    parser.add_argument(
        "--intrinsics",
        nargs=4,
        type=float,
        metavar=("FX", "FY", "CX", "CY"),
        help="of .png images [pixel]",
    )
    parser.add_argument(
        "--depth-scale",
        type=float,
        metavar="S",
        help="metres a unit of .png images (default 0.001)",
    )
    parser.add_argument(
        "--pose",
        nargs=6,
        type=float,
        metavar=("X", "Y", "Z", "ROLL", "PITCH", "YAW"),
        help="X_WC of files that hold none [m, rad]; all zero: clouds in the world frame, z up",
    )
    parser.add_argument(
        "--tool",
        default="panda",
        metavar="T",
        help="panda: the hand, pointing down (default); none: a point; LX,LY,LZ: a box [m] in "
        "the orientation of W",
    )
    parser.add_argument("--near", type=float, metavar="M", help="least depth [m] (default 0.3)")
    parser.add_argument("--far", type=float, metavar="M", help="largest depth [m] (default 2.5)")
    parser.add_argument(
        "--background", action="store_true", help="keep what is far and cut by the border"
    )
    parser.add_argument(
        "--repeats", type=int, default=5, metavar="N", help="times a file is timed (default 5)"
    )
    add_verbose(parser)
    parser.set_defaults(action=_run)


def _run(options: argparse.Namespace) -> int:
    from drake_oa.app.perceive import as_json, perceive
    from drake_oa.common.provenance import software_versions
    from drake_oa.perception.recordings import read_frame

    tool_W = _tool(options.tool)
    coding, config, X_WC = _coding(options), _config(options), _pose(options.pose)
    if options.repeats < 1:
        raise ValueError(f"--repeats must be at least 1, not {options.repeats}")
    pictures = {}
    paths, status = _expanded(options.files)
    check_outputs(options.json)
    if options.plot is not None:
        pictures = _pictures(options.plot, paths)
    figures: dict[str, Any] = {
        "tool": options.tool,
        "tool_W": tool_W.tolist(),
        "versions": list(software_versions()),
        "files": [],
    }
    seen: list[PerceivedFrame] = []
    for path in paths:
        try:
            found = perceive(
                read_frame(path, coding=coding),
                tool_W,
                X_WC=X_WC,
                config=config,
                background=options.background,
                repeats=options.repeats,
            )
        except (ValueError, OSError) as error:
            complain(str(error))
            figures["files"].append({"file": str(path), "error": str(error)})
            status = BAD_INPUT
            continue
        seen.append(found)
        figures["files"].append(as_json(found))
        if found.segmentation.note:
            complain(f"'{path}': {found.segmentation.note}")
            status = max(status, FAILED)
        if options.plot is not None:
            from drake_oa.app.perceive_plot import plot_frame

            plot_frame(found, pictures[path])
    if seen:
        print(_table(seen))
    if options.json is not None:
        replace_text(options.json, json.dumps(figures, indent=1, allow_nan=False) + "\n")
    return status


def _table(seen: Sequence[PerceivedFrame]) -> str:
    """A row for each cluster; those of a file follow its name."""
    rows = [
        ["file", "plane rms [mm]", "cluster", "points", "largest semi-axis [m]", "inside", "ms"]
    ]
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
    return aligned(rows, "lrrrrrr")


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
        if pictures[path].resolve() == path.resolve():
            raise ValueError(f"--plot: the picture of '{path}' would replace it")
    check_outputs(*pictures.values())
    return pictures


def _tool(text: str) -> FloatArray:
    """Corners of the tool (K, 3) in W orientation [m]."""
    from drake_oa.app.perceive import box_corners

    if text == "none":
        return np.zeros((1, 3))
    if text == "panda":
        from drake_oa.robot.config import Robot
        from drake_oa.robot.plant import make_robot_plant, tool_corners

        robot = Robot()
        return tool_corners(make_robot_plant(robot), robot)
    try:
        size = np.array([float(word) for word in text.split(",")])
    except ValueError:
        size = np.zeros(0)
    if size.shape != (3,) or not np.isfinite(size).all() or (size < 0.0).any():
        raise ValueError(f"--tool must be panda, none or LX,LY,LZ [m], not '{text}'")
    return box_corners(size)


def _coding(options: argparse.Namespace) -> DepthCoding:
    from drake_oa.perception.recordings import DepthCoding, checked_intrinsics

    scale = options.depth_scale
    if scale is not None and not 0.0 < scale < math.inf:
        raise ValueError(f"--depth-scale must be positive [m a unit], not {scale}")
    if options.intrinsics is None:
        return DepthCoding(None, scale)
    return DepthCoding(checked_intrinsics(options.intrinsics, "--intrinsics"), scale)


def _config(options: argparse.Namespace) -> SegmentationConfig:
    from drake_oa.common.schema_check import check_values
    from drake_oa.perception.config import SegmentationConfig

    given = {"near": options.near, "far": options.far}
    config = SegmentationConfig(**{k: v for k, v in given.items() if v is not None})
    try:
        check_values(config)
    except ValueError as error:
        raise ValueError(f"--near, --far: {error}") from None
    return config


def _pose(values: Sequence[float] | None) -> FloatArray | None:
    """X_WC (4, 4) from x, y, z [m], roll, pitch, yaw [rad]."""
    if values is None:
        return None
    if not np.isfinite(values).all():
        raise ValueError(f"--pose must be six finite numbers, not {values}")
    from pydrake.math import RigidTransform, RollPitchYaw

    return np.array(RigidTransform(RollPitchYaw(values[3:]), values[:3]).GetAsMatrix4())
