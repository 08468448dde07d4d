"""Computing times and errors of perception with a narrow and a wide crop of the same images.

    python -m tests.regression.crop --scenes 6 --seed 0 --place 0 35
    python -m tests.regression.crop --scenes 6 --seed 0 --place 90 20 --place -90 20
    python -m tests.regression.crop --scenes 6 --seed 0

simulates `verified` in scenes of a suite with cameras at given positions (azimuth and elevation in
degrees; none: the camera at the table). The crop is the part of the space that perception uses. One
crop is that of the run; each frame is also segmented and tracked with the other crop. Columns of
the table, with a row for each scene and crop:

- ms: mean and 95th percentile of the time of segmentation and tracking, the update of
  DepthPerception without waiting for images;
- false: number of perceived obstacles more than 5 cm from all true ones, summed over frames, and
  number of those within 1 m of the robot's base;
- velocities: number of perceived resting obstacles with a nonzero velocity, of all perceived ones;
- missed: number of true obstacles within 0.4 m of the robot without a perceived point within 3 cm,
  of all true obstacles within 0.4 m.
"""

from __future__ import annotations

import argparse
import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any
from unittest.mock import patch

import numpy as np

from drake_oa.common.files import source_digest
from drake_oa.common.messages import ObstacleClouds
from drake_oa.evaluation.cameras import MAX_DEPTH, TABLE_MARGIN, with_workspace_cameras
from drake_oa.evaluation.panda.scene_arm import base_scenario
from drake_oa.evaluation.panda.scene_parts import bounding_ball
from drake_oa.evaluation.panda.scenes import draw_panda_scene
from drake_oa.geometry.collision_scene import (
    CollisionGeometries,
    geometries_of,
    least_distances,
    shape_geometries,
)
from drake_oa.geometry.shapes import pose
from drake_oa.perception import depth_perception
from drake_oa.perception.config import SegmentationConfig
from drake_oa.perception.segmentation import segment_views
from drake_oa.perception.tracking import TrackerState, update_tracks
from drake_oa.runs.report import motion_metrics
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.scenario import Scenario

CROPS = {
    "narrow": {"far": 2.5, "table_margin": 0.02},
    "wide": {"far": MAX_DEPTH, "table_margin": TABLE_MARGIN},
}
"""Crop -> maximum depth and table margin of the segmentation [m]."""
_FALSE = 0.05
"""Minimum distance of a false obstacle from all true ones [m]."""
_MISSED = 0.03
"""Minimum distance of a missed obstacle from all perceived points [m]."""
_NEAR = 0.4
"""Maximum distance of an obstacle from the robot to count as missed [m]."""
_COMPILED = 5
"""Number of initial frames that are not timed, as kernels may be compiled."""


@dataclass
class CropStatistics:
    """Tracker state of one crop, with times of all frames [s] and numbers of errors."""

    tracks: TrackerState = field(default_factory=TrackerState)
    seconds: list[float] = field(default_factory=list)
    counts: np.ndarray = field(default_factory=lambda: np.zeros(6, dtype=int))
    """Numbers of false obstacles, of these near the base, of resting obstacles with velocity, of
    all resting ones, of missed ones, and of obstacles near the robot, summed over frames."""


class CropComparison:
    """Replacement of segmentation and tracking in DepthPerception that runs both crops."""

    def __init__(self, scenario: Scenario, other: str) -> None:
        self._scenario, self._other = scenario, CROPS[other]
        self.chains = (CropStatistics(), CropStatistics())

    def segment_views(self, views: Any, config: SegmentationConfig, robot: Any) -> Any:
        begin = time.perf_counter()
        frame = segment_views(views, config, robot)
        self._segmentation_time, self._views = time.perf_counter() - begin, views
        return frame

    def update_tracks(
        self, previous: Any, frame: Any, stamp: float, config: Any, robot: Any, *, complete: bool
    ) -> TrackerState:
        begin = time.perf_counter()
        tracks = update_tracks(previous, frame, stamp, config, robot, complete=complete)
        own, other = self.chains
        own.tracks = tracks
        own.seconds.append(self._segmentation_time + time.perf_counter() - begin)
        config = replace(config, **self._other)
        begin = time.perf_counter()
        frame = segment_views(self._views, config, robot)
        other.tracks = update_tracks(other.tracks, frame, stamp, config, robot, complete=complete)
        other.seconds.append(time.perf_counter() - begin)
        for chain in self.chains:
            chain.counts += self._counts(chain.tracks.obstacles, stamp, robot)
        return tracks

    def _counts(self, seen: ObstacleClouds, stamp: float, robot: CollisionGeometries) -> np.ndarray:
        counts, clouds = np.zeros(6, dtype=int), [c for c in seen.clouds_W if len(c)]
        truths, rests, near = [], [], []
        for item in self._scenario.obstacles:
            X_WO, offset = pose(item).GetAsMatrix4(), item.offset_at(stamp)
            X_WO[:3, 3] += offset
            truths.append(geometries_of(shape_geometries(item.shapes, X_WO)))
            rests.append(np.allclose(item.offset_at(stamp - 0.1), item.offset_at(stamp + 0.02)))
            center, radius = bounding_ball(item)
            apart = _distance(robot, (center + offset)[None]) - radius
            near.append(apart < _NEAR)
        apart = np.array([[_distance(truth, cloud) for truth in truths] for cloud in clouds])
        apart = apart.reshape(len(clouds), len(truths))
        for cloud, v_WO, row in zip(clouds, seen.v_WO, apart, strict=True):
            nearest = int(row.argmin())
            if row[nearest] > _FALSE:
                counts[:2] += 1, np.hypot(*cloud.mean(axis=0)[:2]) < 1.0
            elif rests[nearest]:
                counts[2:4] += bool(v_WO.any()), 1
        counts[4] = np.sum((apart.min(axis=0, initial=9.0) > _MISSED) & near)
        counts[5] = np.sum(near)
        return counts


def _distance(geometries: CollisionGeometries, points: np.ndarray) -> float:
    points = np.require(points, np.float64, ["C", "W"])
    return float(least_distances(geometries, points, 0.0, 1.0, 1.0).min())


def compare(scenario: Scenario, crop: str, other: str) -> tuple[CropComparison, str]:
    """Runs a scenario with one crop, and the other one on the same frames.

    Returns:
        The statistics of both crops, and the end of the run.
    """
    source = scenario.perception
    config = replace(source.segmentation, **CROPS[crop])
    scenario = replace(scenario, perception=replace(source, segmentation=config))
    both = CropComparison(scenario, other)
    with (
        patch.object(depth_perception, "segment_views", both.segment_views),
        patch.object(depth_perception, "update_tracks", both.update_tracks),
    ):
        log = simulate(scenario)
    touched = motion_metrics(scenario, log).contacts
    return both, f"contact of {', '.join(touched)}" if touched else log.stop_reason


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints a row for each scene and crop, and their sums over scenes."""
    parser = argparse.ArgumentParser(prog="python -m tests.regression.crop")
    parser.add_argument("--suite", default="moving_hard")
    parser.add_argument("--scenes", type=int, default=6)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--place", type=float, nargs=2, action="append", default=[])
    options = parser.parse_args(arguments)
    crop, other = ("wide", "narrow") if options.place else ("narrow", "wide")
    places = {f"camera{row}": tuple(place) for row, place in enumerate(options.place)}
    logging.disable(logging.WARNING)
    print(f"source digest {source_digest()[:12]}, cameras at {options.place or 'the table'}")
    print("| scene | crop | frames | ms | false | velocities | missed | termination |")
    total = {crop: (0, [], np.zeros(6, dtype=int)), other: (0, [], np.zeros(6, dtype=int))}
    for scene in range(options.scenes):
        scenario = draw_panda_scene(options.seed, scene, kind=options.suite)
        table = base_scenario()
        scenario = replace(
            scenario,
            cameras=table.cameras,
            directives=table.directives,
            perception=table.perception,
        )
        if places:
            scenario = with_workspace_cameras(scenario, places)
        both, end = compare(scenario, crop, other)
        for name, chain in zip((crop, other), both.chains, strict=True):
            frames, seconds, counts = total[name]
            timed = chain.seconds[_COMPILED:]
            total[name] = (frames + len(chain.seconds), seconds + timed, counts + chain.counts)
            print(_row(scene, name, len(chain.seconds), timed, chain.counts, end), flush=True)
    for name, (frames, seconds, counts) in total.items():
        print(_row("all", name, frames, seconds, counts, ""))
    ratio = np.mean(total["wide"][1]) / np.mean(total["narrow"][1])
    print(f"time of the wide crop over that of the narrow one: {ratio:.2f}")


def _row(
    scene: object, crop: str, frames: int, seconds: Sequence[float], counts: np.ndarray, end: str
) -> str:
    false, near, velocities, rest, missed, close = counts
    ms = 1e3 * np.array(seconds)
    return (
        f"| {scene} | {crop} | {frames} | {ms.mean():.1f} / {np.percentile(ms, 95):.1f} "
        f"| {false} / {near} | {velocities} of {rest} "
        f"| {missed} of {close} ({missed / max(close, 1):.1%}) | {end} |"
    )


if __name__ == "__main__":
    main()
