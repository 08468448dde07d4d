"""Multi-object tracking of obstacles: a track is one obstacle over time, with an ID and a velocity.

A frame (the images of all cameras at one instant) contains only surfaces that are not occluded,
with noise. A track therefore has remembered points, collected over frames. `update_tracks`
processes a frame in these steps:

1. Prediction: position and velocity of each track are predicted (`velocity`); the remembered points
   of a moving track move with it. A moving track without measurements is predicted by its velocity
   for up to 0.5 s (coasting).
2. Data association: clusters are assigned to tracks (`associate`), first by common points, then by
   the distance of centroids within a gate.
3. Correction: positions are measured at the sides of obstacles, their ends along the world axes
   (`find_sides`); velocities are measured by registration of their surfaces (`velocity`). A Kalman
   filter corrects the tracks.
4. Evidence: each remembered point is supported, occluded or contradicted by the frame.
5. Track management: tracks are split, merged and deleted.
6. Output: clouds that changed by more than noise (`select_output_clouds`). Receivers compare clouds
   with the previous ones, and do not replan because of noise.

Each remembered point has evidence from 1 to 4. A point is confirmed, and output, as soon as its
evidence reaches 2, or 3 if its track rests and was output before. A point in the first frame or in
a large new cluster is confirmed at once. A frame changes the evidence:

    the images observe                                  evidence
    a point of a cluster there                          + 1
    free space there, in at least one image             at most 1 remains; the next time 0: deleted
    a surface there, and the track has no cluster       as free space
    a surface there, but no point of a cluster          - 1
    its own obstacle in front of the point              - 1
    nothing: occluded, no depth, outside the images     unchanged

An unconfirmed point whose evidence decreases is deleted at once. A point is occluded only if it is
occluded in all images. A pixel without depth is unknown, never free. A surface without a point of a
cluster is a grazing surface, or the foot of an obstacle.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from drake_oa.common.messages import (
    BoolArray,
    FloatArray,
    Frozen,
    IntArray,
    ObstacleClouds,
    TablePlane,
    zeros,
)
from drake_oa.geometry.collision_scene import CollisionGeometries, least_distances
from drake_oa.geometry.directions import DIRECTIONS
from drake_oa.geometry.pinhole import AT, EMPTY, FREE, HIDDEN, OUT, classify_points
from drake_oa.geometry.voxels import connected_clusters
from drake_oa.perception.config import SegmentationConfig
from drake_oa.perception.segmentation import OCCLUSION_GAP, Segmentation
from drake_oa.perception.velocity import (
    DEPTH_MARGIN,
    START_STATISTIC,
    Reference,
    Tracks,
    correct_tracks,
    depth_deviation,
    find_sides,
    measure_velocities,
    new_tracks,
    predict_tracks,
    speed_statistic,
)
from drake_oa.perception.visibility import mutual_nearest

_MAX_EVIDENCE = 4
"""Maximum evidence (number of supporting frames, less contradicting ones) of a remembered point of
a track."""
_CONFIRMED = 2
"""Minimum evidence (number of supporting frames, less contradicting ones) at which a remembered
point of a track is confirmed, and output."""
SUPPORT_RADIUS = 0.012
"""Maximum distance from a confirmed remembered point of a track to an observed point that supports
it [m]."""
SAME_RADIUS = 0.008
"""Maximum distance at which an observed point and a remembered point of a track are the same point,
and are averaged [m]."""
_PRECEDENCE = np.array([1, 3, 4, 0, 2])
"""Precedence (5,) of the states of a point, if several images disagree; the state with the largest
number is used.

The states are HIDDEN (occluded), AT (at a surface), FREE (in free space), OUT (outside the image,
or without depth) and EMPTY (without depth, also far around it)."""
_MATCH_RADIUS = 0.02
"""Maximum distance from an observed point to a remembered point of a track to count as a common
point, in data association [m]."""
_COMMON_POINTS = 4
"""Minimum number of points that a track and an observed cluster must have in common for data
association to assign the cluster to the track."""
_COMMON_SHARE = 0.25
"""Minimum number of points that a track and an observed cluster must have in common, over the
number of points of the smaller one, for data association to assign the cluster to the track [-]."""
_GATE = 0.1
"""Gate of the data association: maximum distance between the centroids of a track and a cluster
without enough common points [m]."""
_IMMEDIATE_CONFIRMATION_FACTOR = 2.0
"""Minimum number of voxels of a new cluster whose points are confirmed and output at once, relative
to `min_cluster_voxels` [-]."""
_MEAN_FRAMES = 20
"""Maximum number of frames over which the position of a remembered point of a track is averaged."""
_OCCLUDED_SHARE = 0.3
"""Fraction of occluded points, among a track's remembered points beyond a side (end along a world
axis), from which on this side is not measured [-]: the obstacle may continue there, occluded."""
_SIDE_SLACK = 0.004
"""Minimum distance beyond an obstacle's side (end along an axis) of the remembered points that are
counted for `_OCCLUDED_SHARE` [m]."""
_MIN_VISIBLE_SHARE = 0.2
"""Minimum divisor in the motion evidence of a track, relative to the number of all remembered
points of the track [-]. Motion evidence is the number of visible points that are not observed
again, divided by the number of visible points. The minimum prevents high evidence from few visible
points."""
_EVIDENCE_DECAY = 0.9
"""Factor per frame by which the motion evidence of a track (fraction of its visible points that are
not observed again) decays [-]."""
_CORRECTION = 0.003
"""Displacement of a track by the Kalman filter's correction above which remembered points are
compared with the frame again [m]."""
_MIN_SUPPORT_RATIO = 0.9
"""Minimum fraction of supported points that a resting track must retain after a correction of its
position [-]: the number of remembered points with an observed point nearby after the correction,
over the same number before the correction. With less, the correction is undone, unless the velocity
of the track is significant."""
_SPLIT_FRAMES = 3
"""Number of consecutive frames with an obstacle in separate parts, after which its track is
split."""
_TABLE_SHIFT = 0.003
"""Height difference between the measured table and the last output table, within 1 m of the world
origin, above which the output is updated [m]."""
_MERGE_TIME = 0.5
"""Time for which two tracks must share one cluster and have similar velocities before they are
merged [s]."""
_MAX_VELOCITY_DIFFERENCE = 0.1
"""Maximum difference between the velocities of two tracks in one cluster that are merged [m/s]."""
_MAX_GROWTH = 0.0025
"""Growth of an obstacle's extent in any of 26 directions above which its cloud in the output is
updated [m]."""
_MAX_SHRINKAGE = 0.005
"""Shrinkage of an obstacle's extent in any of 26 directions above which its cloud in the output is
updated [m]."""
_CHANGED_SHARE = 0.1
"""Relative change of the number of an obstacle's points above which its cloud in the output is
updated [-]."""


@dataclass(frozen=True, eq=False)
class Points(Frozen):
    """N remembered surface points of tracks (obstacles followed over time), collected over several
    frames.

    Attributes:
        p_OQ: (N, 3) positions in the frame O of the track, which has the axes of the world and the
            origin `Tracks.shift_W` in the world [m].
        owner: (N,) row of the track to which each point belongs.
        evidence: (N,) evidence of each point, from 1 to `_MAX_EVIDENCE`: it increases by 1 in a
            frame that supports the point, and decreases by 1 in one that contradicts it; after a
            frame with free space at the point it is at most 1.
        weight: (N,) number of frames in the running mean of the position.
        confirmed: (N,) whether the point is confirmed, and thereby output: its evidence has reached
            2 (`_CONFIRMED`), or 3 for a resting track that was output before; or the point was in
            the first frame or in a large new cluster.
    """

    p_OQ: FloatArray = zeros(0, 3)
    owner: IntArray = zeros(0, kind=np.int64)
    evidence: IntArray = zeros(0, kind=np.int64)
    weight: IntArray = zeros(0, kind=np.int64)
    confirmed: BoolArray = zeros(0, kind=bool)

    def __len__(self) -> int:
        return len(self.owner)


class OutputCloud(NamedTuple):
    """Point cloud of one tracked obstacle as it is output.

    Attributes:
        p_OQ: (N, 3) points in the frame O of the track, which has the axes of the world and moves
            with the obstacle [m].
        p_WQ: (N, 3) points in the world [m].
    """

    p_OQ: FloatArray
    p_WQ: FloatArray


@dataclass(frozen=True, eq=False)
class TrackerState(Frozen):
    """State of the obstacle tracker after one frame (images of one instant), including its output.

    Attributes:
        obstacles: obstacles in the world frame, the output of the tracker.
        next_id: smallest track ID that was never used.
        tracks: Kalman filters and further state of the tracks.
        points: remembered points of the tracks.
        output_clouds: cloud in the output, by track ID.
        references: surface of each obstacle in an earlier frame, by track ID; for measuring
            velocities.
        frame_stamp: time of the last frame [s].
        last_image_stamps: (n,) time of the last image of each of n cameras that the segmentation
            did not reject [s].
        cloud_W: (K, 3) points of the last frame in the world, for visualization [m].
    """

    obstacles: ObstacleClouds = field(default_factory=ObstacleClouds)
    next_id: int = 0
    tracks: Tracks = field(default_factory=Tracks)
    points: Points = field(default_factory=Points)
    output_clouds: dict[int, OutputCloud] = field(default_factory=dict)
    references: dict[int, Reference] = field(default_factory=dict)
    frame_stamp: float = -np.inf
    last_image_stamps: FloatArray = zeros(0)
    cloud_W: FloatArray = zeros(0, 3)


_Rows = TypeVar("_Rows", Points, Tracks)


def select_rows(value: _Rows, index: IntArray | BoolArray) -> _Rows:
    """Returns tracks or remembered points with only the selected rows of every array.

    Args:
        value: tracks or points.
        index: (K,) indices of the rows, or one boolean per row.
    """
    return replace(value, **{name: part[index] for name, part in vars(value).items()})


def append_rows(first: _Rows, second: _Rows) -> _Rows:
    """Concatenates the rows of two groups of tracks, or of two groups of remembered points, into
    one group.
    """
    parts = {name: np.concatenate([one, vars(second)[name]]) for name, one in vars(first).items()}
    return replace(first, **parts)


@dataclass(frozen=True, eq=False)
class Association:
    """Result of data association: assignment of the Q points and C clusters of a frame to tracks,
    by the tracks' rows. Rows 0 to M - 1 are the existing tracks, rows from M new ones.

    Attributes:
        point_row: (Q,) row of the track of each point.
        cluster_row: (C,) row of the track of each cluster; if the cluster belongs to several
            tracks, that of the track with the most common points.
        is_shared: (C,) whether a cluster belongs to several tracks.
        new_clusters: indices of the clusters that start new tracks, in the order of the new rows.
        partner: (M,) row of the track with the most remembered points among the tracks that share a
            cluster with each track; -1: the track shares no cluster, or itself has the most points.
    """

    point_row: IntArray
    cluster_row: IntArray
    is_shared: BoolArray
    new_clusters: IntArray
    partner: IntArray


def associate(
    points: FloatArray,
    cluster: IntArray,
    clusters: int,
    votes_for: IntArray,
    track_points: FloatArray,
    owner: IntArray,
    tracks: int,
) -> Association:
    """Assigns clusters of a frame to tracks (data association): by common points, else by predicted
    centroids.

    An observed point within 2 cm (`_MATCH_RADIUS`) of the nearest remembered point is a common
    point of the observed point's cluster and the remembered point's track.

    A track owns every cluster with enough common points: at least 4 (`_COMMON_POINTS`), and at
    least 25 % (`_COMMON_SHARE`) of the points of the cluster or track, whichever has fewer. A
    cluster that several tracks own is divided: each point belongs to the track of the nearest
    remembered point. The other clusters are assigned to tracks without a cluster by the least total
    distance of centroids; distances of 10 cm (`_GATE`) or more are rejected (Hungarian method). A
    cluster that remains starts a new track.

    Args:
        points: (Q, 3) points of the frame in the world [m].
        cluster: (Q,) index of the cluster of each point.
        clusters: C, number of clusters.
        votes_for: (Q,) index of the remembered point nearest to each point; -1: none within
            `_MATCH_RADIUS`.
        track_points: (N, 3) predicted remembered points in the world [m].
        owner: (N,) row of the track of each remembered point.
        tracks: M, number of tracks.
    """
    sizes = np.bincount(cluster, minlength=clusters)
    track_sizes = np.bincount(owner, minlength=tracks)
    vote_row = np.append(owner, -1)[votes_for]
    pair = cluster * tracks + vote_row
    votes = np.bincount(pair[votes_for >= 0], minlength=clusters * tracks)
    votes = votes.reshape(clusters, tracks)
    smaller = np.minimum(sizes[:, None], track_sizes[None])
    owns = votes >= np.maximum(_COMMON_POINTS, _COMMON_SHARE * smaller)
    cluster_row = np.full(clusters, -1, dtype=np.int64)
    if tracks:
        is_owned = owns.any(axis=1)
        cluster_row[is_owned] = np.where(owns, votes, -1)[is_owned].argmax(axis=1)
    free_clusters = np.flatnonzero(cluster_row < 0)
    free_tracks = np.flatnonzero(~owns.any(axis=0) & (track_sizes > 0))
    if len(free_clusters) and len(free_tracks):
        measured_centers = np.stack([points[cluster == c].mean(axis=0) for c in free_clusters])
        predicted_centers = np.stack([track_points[owner == m].mean(axis=0) for m in free_tracks])
        gap = np.linalg.norm(measured_centers[:, None] - predicted_centers[None], axis=2)
        # Pairs beyond the gate cost more than any number of pairs within it.
        rows, columns = linear_sum_assignment(np.where(gap < _GATE, gap, 1e3 * _GATE))
        in_gate = gap[rows, columns] < _GATE
        cluster_row[free_clusters[rows[in_gate]]] = free_tracks[columns[in_gate]]
    new_clusters = np.flatnonzero(cluster_row < 0)
    cluster_row[new_clusters] = tracks + np.arange(len(new_clusters))
    is_shared = owns.sum(axis=1) > 1
    point_row = cluster_row[cluster]
    partner = np.full(tracks, -1, dtype=np.int64)
    for c in np.flatnonzero(is_shared):
        inside = np.flatnonzero(cluster == c)
        rows = np.flatnonzero(owns[c])
        among = np.isin(owner, rows)
        _, nearest = cKDTree(track_points[among]).query(points[inside])
        point_row[inside] = owner[among][nearest]
        largest = rows[track_sizes[rows].argmax()]
        partner[rows[rows != largest]] = largest
    return Association(point_row, cluster_row, is_shared, new_clusters, partner)


def update_tracks(
    previous: TrackerState,
    frame: Segmentation,
    stamp: float,
    config: SegmentationConfig | None = None,
    robot: CollisionGeometries | None = None,
    *,
    complete: bool = True,
) -> TrackerState:
    """Updates the tracks (obstacles over time) by a new frame: prediction, data association,
    correction, evidence of the remembered points, split and merged tracks, output.

    A track has remembered points, which earlier frames observed on the obstacle's surface. Such a
    point remains if no image of the frame has information about it. Reasons are: it is occluded by
    the arm or another obstacle; its pixels have no depth; it lies outside the images; the robot is
    at its place. An obstacle behind a parked arm is therefore remembered while the arm is there.
    Two frames with free space at the place of a point, in any of their images, delete it.

    - A frame that is not usable (hardly any depth, or no table) changes only the note of the
      output. A receiver computes the age of the obstacles from the stamp.
    - A frame with the stamp of the previous frame is a repetition: it only clears the note.
    - A frame with an earlier stamp resets the tracker, except that no track ID is used twice.
    - After a gap of more than 1 s (`velocity.MAX_GAP`) between frames all velocities are reset.

    Args:
        previous: state after the previous frame; `TrackerState()` before the first frame.
        frame: segmented frame. Infinite depth counts as free space. A cloud is assumed to contain
            every surface, without occlusion.
        stamp: time of the frame [s].
        config: parameters of the segmentation; None: defaults.
        robot: collision geometry of the robot in the world at that time; remembered points at the
            place of the robot remain. None: no robot.
        complete: whether the frame contains a usable image of each camera. If False, remembered
            points behind the visible part of their own obstacle remain, since the camera without an
            image may have a view of them.

    Returns:
        State after the frame; its `obstacles` are the output.
    """
    if not frame.usable:
        return replace(previous, obstacles=replace(previous.obstacles, note=frame.note))
    if stamp == previous.frame_stamp:
        return replace(previous, obstacles=replace(previous.obstacles, note=""))
    if stamp < previous.frame_stamp:
        previous = TrackerState(next_id=previous.next_id)
    return _FrameUpdate(
        previous, frame, stamp, config or SegmentationConfig(), robot, complete
    ).run()


class _Comparison(NamedTuple):
    """Comparison of N remembered points of tracks with the Q points and V images of a frame.

    Attributes:
        p_WQ: (N, 3) present positions of the remembered points in the world [m].
        nearest: (Q,) index of the remembered point nearest to each point of the frame, -1: none
            within `_MATCH_RADIUS`.
        to_remembered: (Q,) distance of each point of the frame from that remembered point, at most
            `_MATCH_RADIUS` [m].
        to_frame: (N,) distance of each remembered point from the nearest point of the frame, at
            most `_MATCH_RADIUS` [m].
        state: (N,) state of each remembered point, from the image with the highest precedence:
            HIDDEN (occluded), AT (at a surface), FREE (in free space), OUT (outside the image,
            without depth, or at the place of the robot) or EMPTY (without depth, also far around
            it).
        image_state: (V, N) state of each remembered point in each image.
        pixel: (V, N) flat index of the pixel of each remembered point in each image, -1 outside it.
    """

    p_WQ: FloatArray
    nearest: IntArray
    to_remembered: FloatArray
    to_frame: FloatArray
    state: IntArray
    image_state: IntArray
    pixel: IntArray


class _FrameUpdate:
    """Computation of one update of the tracks (obstacles over time) by a frame; an instance exists
    only during a call of `update_tracks`.
    """

    def __init__(
        self,
        previous: TrackerState,
        frame: Segmentation,
        stamp: float,
        config: SegmentationConfig,
        robot: CollisionGeometries | None,
        complete: bool,
    ) -> None:
        self.previous, self.frame, self.complete, self.stamp = previous, frame, complete, stamp
        self.config, self.robot, self.first = config, robot, previous.frame_stamp == -np.inf
        self.dt = 0.0 if self.first else stamp - previous.frame_stamp
        self.tracks, self.points = previous.tracks, previous.points
        lengths = [len(cloud) for cloud in frame.clouds_W]
        self.frame_points = np.concatenate([np.zeros((0, 3)), *frame.clouds_W])
        self.cluster = np.repeat(np.arange(len(lengths)), lengths)
        self.next_id = previous.next_id

    def run(self) -> TrackerState:
        """Runs all steps of the tracker's update by one frame, and returns the resulting state of
        the tracker.
        """
        self.tracks = predict_tracks(self.tracks, self.dt)
        comparison = self._compare()
        association = associate(
            self.frame_points,
            self.cluster,
            len(self.frame.clouds_W),
            comparison.nearest,
            comparison.p_WQ,
            self.points.owner,
            len(self.tracks),
        )
        centers = [self.frame.clouds_W[c].mean(axis=0) for c in association.new_clusters]
        self._add_tracks(new_tracks(np.reshape(centers, (-1, 3))))
        is_behind = self._find_self_occluded(association, comparison)
        self._update_motion_evidence(comparison, is_behind)
        # Missing pixels must not count as occlusion at the rear of a moving obstacle: its points
        # there would remain, and the obstacle would grow without end.
        state = comparison.state
        in_image = (comparison.pixel >= 0).any(axis=0)
        is_missing = (state == EMPTY) | ((state == OUT) & in_image)
        is_missing &= self.tracks.is_moving[self.points.owner]
        is_occluded = (state != AT) & (state != FREE) & ~is_behind & ~is_missing
        predicted = self.tracks
        self._correct(association, comparison.p_WQ, is_occluded)
        if np.abs(self.tracks.shift_W - predicted.shift_W).max(initial=0.0) > _CORRECTION:
            comparison = self._reject_corrections(predicted, comparison)
            is_behind = self._find_self_occluded(association, comparison)
        self._split_tracks(association, comparison)
        self._update_evidence(association, comparison, is_behind)
        self._update_points(association, comparison)
        self._merge_tracks(association)
        self._delete_tracks()
        return self._output()

    def _compare(self) -> _Comparison:
        """Compares the remembered points of the tracks, at their present positions, with the points
        and images of the frame.
        """
        p_WQ = self.points.p_OQ + self.tracks.shift_W[self.points.owner]
        nearest, to_remembered, to_frame = mutual_nearest(self.frame_points, p_WQ, _MATCH_RADIUS)
        # A cloud is assumed to contain every surface.
        visible = np.full(len(p_WQ), AT), np.full(len(p_WQ), -1)
        results = [classify_points(p_WQ, view, DEPTH_MARGIN) for view in self.frame.views]
        image_state, pixel = np.stack(results or [visible], axis=1)
        state = image_state[_PRECEDENCE[image_state].argmax(axis=0), np.arange(len(p_WQ))]
        if self.robot is not None:
            # Points at the place of the robot are occluded by it, not free. Only points that would
            # lose evidence are tested.
            is_tested = (to_frame >= SUPPORT_RADIUS) & np.isin(state, (AT, FREE, EMPTY))
            rows = np.flatnonzero(is_tested)
            margin = self.config.robot_margin
            d = least_distances(self.robot, p_WQ[rows], 0.0, margin, margin)
            state[rows[d < margin]] = OUT
        return _Comparison(p_WQ, nearest, to_remembered, to_frame, state, image_state, pixel)

    def _reject_corrections(self, predicted: Tracks, before: _Comparison) -> _Comparison:
        """Undoes position corrections of resting tracks that contradict the points of the frame.

        For each track, the remembered points near a point of the frame are counted before and after
        the correction. The correction is undone if their number decreases to less than 90 %
        (`_MIN_SUPPORT_RATIO`) and the velocity of the track is not significant. A side (end along a
        world axis) of a thin object may be visible at different places in two frames although the
        object rests. Then the object's surface does not fit the corrected position.

        Args:
            predicted: tracks before the correction.
            before: comparison of the tracks' points with the frame before the correction.

        Returns:
            Comparison of the remembered points, at their final positions, with the frame.
        """
        after, owner = self._compare(), self.points.owner
        rows = np.arange(len(self.tracks))
        support_before, support = (
            np.bincount(owner[comparison.to_frame < SUPPORT_RADIUS], minlength=len(rows))
            for comparison in (before, after)
        )
        is_rejected = ~predicted.is_moving & (support < _MIN_SUPPORT_RATIO * support_before)
        is_rejected &= speed_statistic(self.tracks) < START_STATISTIC
        is_rejected &= (self.tracks.shift_W != predicted.shift_W).any(axis=1)
        if not is_rejected.any():
            return after
        predicted = replace(
            predicted,
            unmeasured_time=predicted.unmeasured_time + self.dt,
            is_outlier=self.tracks.is_outlier,
        )
        both = append_rows(self.tracks, predicted)
        self.tracks = select_rows(both, np.where(is_rejected, len(rows) + rows, rows))
        return self._compare()

    def _find_self_occluded(self, association: Association, comparison: _Comparison) -> BoolArray:
        """Finds the remembered points behind the visible part of their own obstacle.

        An obstacle that has moved or rotated has such points. A point is found only if it is behind
        the obstacle in every image that contains its place. If the image of a camera is missing, no
        point is found, since that camera may have a view of the rear side.

        Returns:
            (N,) whether each remembered point is behind its own obstacle.
        """
        if not self.complete or not self.frame.views:
            return np.zeros(len(self.points), dtype=bool)
        rows = np.append(association.cluster_row, -1)
        pairs = zip(self.frame.labels, comparison.pixel, strict=True)
        pixel_row = np.stack([rows[label[pixel]] for label, pixel in pairs])
        is_behind = (comparison.image_state == HIDDEN) & (pixel_row == self.points.owner)
        everywhere = (is_behind | (comparison.pixel < 0)).all(axis=0)
        return np.asarray(is_behind.any(axis=0) & everywhere)

    def _update_motion_evidence(self, comparison: _Comparison, is_behind: BoolArray) -> None:
        """Updates the motion evidence of each track: the fraction of its visible, confirmed
        remembered points without an observed point near them.

        The new value is the larger one of this fraction and the decayed previous value.

        Args:
            comparison: comparison of the remembered points with the frame.
            is_behind: (N,) whether each remembered point is behind its own obstacle.
        """
        points, state, count = self.points, comparison.state, len(self.tracks)
        is_visible = (state == AT) | (state == FREE) | (state == EMPTY) | is_behind
        is_visible &= points.confirmed
        total = np.bincount(points.owner[is_visible], minlength=count)
        is_unsupported = is_visible & (comparison.to_frame >= SUPPORT_RADIUS)
        unsupported = np.bincount(points.owner[is_unsupported], minlength=count)
        min_total = _MIN_VISIBLE_SHARE * np.bincount(points.owner, minlength=count)
        fraction = unsupported / np.maximum(total, np.maximum(min_total, 1.0))
        decayed = _EVIDENCE_DECAY * self.tracks.motion_evidence
        self.tracks = replace(self.tracks, motion_evidence=np.maximum(fraction, decayed))

    def _correct(self, association: Association, p_WQ: FloatArray, is_occluded: BoolArray) -> None:
        """Corrects the positions of the tracks by the sides (ends along the world axes) of
        obstacles in the frame, and the velocities by their surfaces.

        Args:
            association: assignment of clusters to tracks; sides of a cluster that belongs to
                several tracks are not measured.
            p_WQ: (N, 3) remembered points in the world [m].
            is_occluded: (N,) whether each remembered point is occluded.
        """
        tracks = self.tracks
        rows = np.where(association.is_shared, -1, association.cluster_row)
        sides = find_sides(self.frame, rows, tracks.area, self.config.voxel)
        # A side is no end if too many of the remembered points beyond it are occluded.
        owner = self.points.owner
        low, high = np.moveaxis(sides.place[owner], 2, 0)
        beyond = np.stack([p_WQ < low - _SIDE_SLACK, p_WQ > high + _SIDE_SLACK], axis=2)
        beyond = beyond.reshape(-1, 6)
        is_own = (owner == np.arange(len(tracks))[:, None]).astype(float)
        fraction = is_own @ (beyond & is_occluded[:, None]) / np.maximum(is_own @ beyond, 1.0)
        is_visible = fraction.reshape(sides.ends.shape) < _OCCLUDED_SHARE
        sides = replace(sides, ends=sides.ends & is_visible)
        deviation = depth_deviation(tracks.p_W, self.frame.views)
        v_W, variance, self._references = measure_velocities(
            tracks,
            self.previous.references,
            self.frame_points,
            association.point_row,
            self.cluster,
            deviation,
            self.stamp,
        )
        self.tracks = correct_tracks(tracks, sides, deviation, v_W, variance, self.dt)

    def _update_evidence(
        self, association: Association, comparison: _Comparison, is_behind: BoolArray
    ) -> None:
        """Updates the evidence of the remembered points, and deletes points without evidence.

        Evidence is a count of frames that support the point minus frames that contradict it. It
        increases by 1 near an observed point. In free space it falls to 1, or from 1 to 0. At
        another surface, or behind its own obstacle, it decreases by 1. The module's docstring has
        the complete table.

        Args:
            association: assignment of the frame's points and clusters to tracks.
            comparison: comparison of the remembered points with the frame.
            is_behind: (N,) whether each remembered point is behind its own obstacle.
        """
        points, state = self.points, comparison.state
        radius = np.where(points.confirmed, SUPPORT_RADIUS, SAME_RADIUS)
        is_supported = comparison.to_frame < radius
        has_cluster = np.isin(points.owner, association.point_row)
        is_free = (state == FREE) | ((state == AT) & ~has_cluster)
        is_fading = (state == AT) | is_behind
        reduced = np.where(
            is_free, np.minimum(points.evidence, _CONFIRMED) - 1, points.evidence - is_fading
        )
        increased = np.minimum(points.evidence + 1, _MAX_EVIDENCE)
        evidence = np.where(is_supported, increased, reduced)
        # New points of a resting track in the output are confirmed by a third frame.
        is_settled = np.isin(self.tracks.ids, list(self.previous.output_clouds))
        is_settled &= ~self.tracks.is_moving
        confirmed = points.confirmed | (evidence >= _CONFIRMED + is_settled[points.owner])
        evidence[~points.confirmed & ~is_supported & (is_free | is_fading)] = 0
        remains = evidence > 0
        # Rows of the remaining points by previous row, for `_update_points`.
        self._new_row = np.where(remains, np.cumsum(remains) - 1, -1)
        self.points = select_rows(replace(points, evidence=evidence, confirmed=confirmed), remains)

    def _update_points(self, association: Association, comparison: _Comparison) -> None:
        """Averages each remembered point with the observed points of its track within 8 mm
        (`SAME_RADIUS`), and adds observed points without a remembered point within this distance.
        """
        point_of = np.append(self._new_row, -1)[comparison.nearest]
        row = association.point_row
        is_same_track = np.append(self.points.owner, -1)[point_of] == row
        p_OQ = np.array(self.points.p_OQ)
        weight = np.array(self.points.weight)
        local = self.frame_points - self.tracks.shift_W[row]
        is_near = comparison.to_remembered <= SAME_RADIUS
        is_same = is_same_track & is_near & (point_of >= 0)
        at = point_of[is_same]
        count = np.bincount(at, minlength=len(p_OQ))
        is_updated = count > 0
        weight[is_updated] = np.minimum(weight[is_updated] + 1, _MEAN_FRAMES)
        total = np.stack([np.bincount(at, one, len(p_OQ)) for one in local[is_same].T], axis=1)
        error = total[is_updated] / count[is_updated, None] - p_OQ[is_updated]
        p_OQ[is_updated] += error / weight[is_updated, None]
        self.points = replace(self.points, p_OQ=p_OQ, weight=weight)
        new = np.flatnonzero((point_of < 0) | ~is_near)
        ones = np.ones(len(new), dtype=np.int64)
        is_confirmed = np.zeros(len(self.tracks), dtype=bool)
        clusters = association.new_clusters
        sizes = np.array([len(self.frame.clouds_W[c]) for c in clusters], dtype=int)
        min_size = _IMMEDIATE_CONFIRMATION_FACTOR * self.config.min_cluster_voxels
        is_confirmed[association.cluster_row[clusters]] = self.first | (sizes >= min_size)
        new_points = Points(local[new], row[new], ones, ones, is_confirmed[row[new]])
        self.points = append_rows(self.points, new_points)

    def _split_tracks(self, association: Association, comparison: _Comparison) -> None:
        """Splits each track whose obstacle has been in separate parts for several frames.

        A track is split in the third consecutive frame (`_SPLIT_FRAMES`) with separate parts. Two
        parts are not separate if remembered points that the frame does not observe connect them.
        The part of the largest cluster retains the track ID; the other parts become new tracks.
        """
        tracks, points = self.tracks, self.points
        is_unobserved = (comparison.state != AT) & (comparison.state != FREE)
        rows = np.where(association.is_shared, -1, association.cluster_row)
        owner, sides, area = np.array(points.owner), np.array(tracks.sides), np.array(tracks.area)
        split_frames = np.zeros(len(tracks), dtype=np.int64)
        origin: list[int] = []
        for row in np.flatnonzero(np.bincount(rows + 1)[1:] > 1):
            visible = np.flatnonzero(np.isin(self.cluster, np.flatnonzero(rows == row)))
            own = np.flatnonzero(points.owner == row)
            occluded = comparison.p_WQ[own[is_unobserved[own]]]
            joined = np.concatenate([self.frame_points[visible], occluded])
            groups = np.concatenate([self.cluster[visible], -1 - np.arange(len(occluded))])
            label = connected_clusters(joined, self.config.cluster_tolerance, groups)
            label = label[: len(visible)]
            # Label 0 has the largest cluster.
            split_frames[row] = tracks.split_frames[row] + 1 if label.any() else 0
            if split_frames[row] < _SPLIT_FRAMES:
                continue
            sides[row], area[row], split_frames[row] = np.nan, 0.0, 0
            nearest, _, _ = mutual_nearest(
                comparison.p_WQ[own], self.frame_points[visible], OCCLUSION_GAP
            )
            part = np.append(label, 0)[nearest]
            for number in np.unique(label[label > 0]):
                new = len(tracks) + len(origin)
                owner[own[part == number]] = new
                association.point_row[visible[label == number]] = new
                origin.append(int(row))
        self.points = replace(points, owner=owner)
        self.tracks = replace(tracks, sides=sides, area=area, split_frames=split_frames)
        self._add_tracks(select_rows(self.tracks, np.array(origin, dtype=np.int64)))

    def _add_tracks(self, tracks: Tracks) -> None:
        """Appends tracks with new, unused IDs to the tracks of the tracker."""
        ids = self.next_id + np.arange(len(tracks))
        self.next_id += len(tracks)
        self.tracks = append_rows(self.tracks, replace(tracks, ids=ids))

    def _merge_tracks(self, association: Association) -> None:
        """Merges tracks that have shared one cluster with similar velocities for some time.

        The time is 0.5 s (`_MERGE_TIME`), the maximum difference of the velocities 0.1 m/s
        (`_MAX_VELOCITY_DIFFERENCE`). The points of the smaller track become those of the largest
        track in the cluster.
        """
        tracks = self.tracks
        rows = np.flatnonzero(association.partner >= 0)
        into = association.partner[rows]
        v_W = np.where(tracks.is_moving[:, None], tracks.v_W, 0.0)
        difference = np.linalg.norm(v_W[rows] - v_W[into], axis=1)
        is_similar = difference < _MAX_VELOCITY_DIFFERENCE
        merged_time = np.zeros(len(tracks))
        merged_time[rows] = np.where(is_similar, tracks.merged_time[rows] + self.dt, 0.0)
        sides = np.array(tracks.sides)
        p_OQ, owner = np.array(self.points.p_OQ), np.array(self.points.owner)
        for row, other in zip(rows, into, strict=True):
            if merged_time[row] >= _MERGE_TIME:
                is_own = owner == row
                p_OQ[is_own] += tracks.shift_W[row] - tracks.shift_W[other]
                owner[is_own], sides[other] = other, np.nan
        self.points = replace(self.points, p_OQ=p_OQ, owner=owner)
        self.tracks = replace(tracks, sides=sides, merged_time=merged_time)

    def _delete_tracks(self) -> None:
        """Deletes tracks with fewer remembered points than `_min_points`."""
        count = np.bincount(self.points.owner, minlength=len(self.tracks))
        remains = count >= self._min_points()
        row = np.cumsum(remains) - 1
        points = select_rows(self.points, remains[self.points.owner])
        self.points = replace(points, owner=row[points.owner])
        self.tracks = select_rows(self.tracks, remains)

    def _min_points(self) -> int:
        """Returns the minimum number of remembered points for a track to persist, which is also the
        minimum number of confirmed points for its output.
        """
        return max(4, self.config.min_cluster_voxels // 2)

    def _output(self) -> TrackerState:
        """Returns the state of the tracker after the frame; its output contains the tracks with at
        least `_min_points` confirmed points.
        """
        tracks, points = self.tracks, self.points
        confirmed = np.bincount(points.owner[points.confirmed], minlength=len(tracks))
        is_output = confirmed >= self._min_points()
        clouds = select_output_clouds(
            tracks.ids, tracks.shift_W, points, is_output, self.previous.output_clouds
        )
        has_velocity = tracks.is_moving & (np.linalg.norm(tracks.v_W, axis=1) > 0.0)
        obstacles = ObstacleClouds(
            self.stamp,
            tuple(clouds[track_id].p_WQ for track_id in tracks.ids[is_output].tolist()),
            tracks.ids[is_output],
            select_output_table(self.previous.obstacles.table, self.frame.table),
            v_WO=np.where(has_velocity[:, None], tracks.v_W, 0.0)[is_output],
        )
        return TrackerState(
            obstacles,
            self.next_id,
            tracks,
            points,
            clouds,
            self._references,
            self.stamp,
            self.previous.last_image_stamps,
        )


def select_output_clouds(
    ids: IntArray,
    shift_W: FloatArray,
    points: Points,
    is_output: BoolArray,
    previous: dict[int, OutputCloud],
) -> dict[int, OutputCloud]:
    """Selects the output cloud of each track: the previous cloud if the new one differs only by
    noise.

    A difference is noise if the extent in each of 26 directions grows by at most 2.5 mm and shrinks
    by at most 5 mm, and the number of points changes by at most 10 %. Then the points remain
    bitwise equal in the frame O of the track, so that receivers do not replan for an obstacle at
    rest.

    Args:
        ids: (M,) track IDs.
        shift_W: (M, 3) translation from the frame O of each track's points to the world [m].
        points: remembered points of the M tracks in their frames O; only confirmed points are
            output: those of several frames, of the first frame or of a large new cluster.
        is_output: (M,) whether each track has enough confirmed points (`_FrameUpdate._min_points`)
            to be output.
        previous: output clouds of the previous frame, by track ID.

    Returns:
        Output clouds, by track ID.
    """
    owner = np.where(points.confirmed, points.owner, -1)
    clouds = {}
    for row in np.flatnonzero(is_output):
        track_id, p_OQ = int(ids[row]), points.p_OQ[owner == row]
        old = previous.get(track_id)
        if old is not None:
            reach, old_reach = ((DIRECTIONS @ cloud.T).max(axis=1) for cloud in (p_OQ, old.p_OQ))
            growth, size = reach - old_reach, len(old.p_OQ)
            if (
                (growth <= _MAX_GROWTH).all()
                and (growth >= -_MAX_SHRINKAGE).all()
                and abs(len(p_OQ) - size) <= _CHANGED_SHARE * size
            ):
                p_OQ = old.p_OQ
        p_WQ = p_OQ + shift_W[row]
        p_WQ.flags.writeable = False
        is_same = old is not None and np.array_equal(p_WQ, old.p_WQ)
        clouds[track_id] = previous[track_id] if is_same else OutputCloud(p_OQ, p_WQ)
    return clouds


def select_output_table(
    previous: TablePlane | None, measured: TablePlane | None
) -> TablePlane | None:
    """Returns the table that is output: the previous plane, unless the measured one is different.

    It is different if an upper bound of their difference in height, within 1 m of the world origin,
    exceeds 3 mm (`_TABLE_SHIFT`).

    Args:
        previous: plane in the previous output; None: no plane.
        measured: plane in the present frame; None: no plane, and none is output.
    """
    if previous is None or measured is None:
        return measured
    return measured if measured.distance_to(previous) > _TABLE_SHIFT else previous
