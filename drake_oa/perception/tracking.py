"""Obstacles from frame to frame: what is remembered, their names, and their motion.

A frame shows only what nothing stands before, and shows it with noise. Each frame is
joined with what was remembered:

1. Position and velocity of each obstacle are predicted (`velocity`), and what is
   remembered of a moving obstacle moves with it.
2. Clusters are given to obstacles (`associate`), by common points first.
3. The obstacles' positions are measured by their sides (`seen_sides`), their velocities by their
   surfaces (`velocity`), and both are filtered.
4. Each remembered point is confirmed, kept as hidden, or dropped.
5. What changed by more than noise is handed on (`held_clouds`): a copy of the remembered points,
   which follow the camera's noise. Receivers that compare see no change, and need not plan again.

Each point carries evidence. A frame that shows it adds one; a frame whose rays pass
through it takes away all but one, and the next such frame the rest: two frames confirm
a point, two remove it. One that is hidden (by the arm, another obstacle, a missing
pixel, the border of the image) stays as it is: a pixel without depth is unknown, never free, of
obstacles that move as well. Of several images one that sees through it is
enough, and it is hidden only if it is in all. Where the image shows something at the
point's depth but no cluster has a point there (grazing surfaces, the foot of an
obstacle) the evidence only decays.
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
from drake_oa.geometry.pinhole import AT, EMPTY, FREE, HIDDEN, OUT, shown
from drake_oa.geometry.voxels import connected_clusters
from drake_oa.perception.config import SegmentationConfig
from drake_oa.perception.segmentation import OCCLUSION_GAP, Segmentation
from drake_oa.perception.velocity import (
    DEPTH_MARGIN,
    START,
    Reference,
    Tracks,
    depth_deviation,
    measured_tracks,
    new_tracks,
    predicted_tracks,
    registered_tracks,
    seen_sides,
    speed_statistic,
)
from drake_oa.perception.visibility import mutual_nearest

_CERTAIN = 4
"""The most evidence that a point can have."""
_CONFIRMED = 2
"""From this much evidence on a point is handed on."""
SUPPORT_RADIUS = 0.012
"""Distance at which a point of a frame supports the remembered point [m]."""
SAME_RADIUS = 0.008
"""Distance at which a seen and a remembered point are the same point [m]."""
_SAYS = np.array([1, 3, 4, 0, 2])
"""How much HIDDEN, AT, FREE, OUT and EMPTY say: of several images the one counts that says most."""
_MATCH_RADIUS = 0.02
"""Distance at which a point of a frame votes for the obstacle of a remembered one [m]."""
_COMMON_POINTS = 4
"""Fewest points that an obstacle has in common with its clusters."""
_COMMON_SHARE = 0.25
"""Least share of common points, of the smaller of obstacle and cluster."""
_GATE = 0.1
"""Distance of centroids within which a cluster without common points is matched [m]."""
_SOLID = 2.0
"""Size of a new cluster that is believed at once, in fewest voxels of a cluster."""
_MEAN_FRAMES = 20
"""Most frames of which a remembered point is the mean."""
_HIDDEN_SHARE = 0.3
"""Share of the points beyond a side that are occluded where the side is not seen."""
_SIDE_SLACK = 0.004
"""Distance beyond a side within which points belong to it [m]."""
_LEAST_SEEN = 0.2
"""Least share of the points of an obstacle of which the missing ones are counted."""
_FADING = 0.9
"""Share of the doubt about the place of an obstacle that is left a frame later."""
_CORRECTION = 0.003
"""Correction of a position above which the frame is compared again [m]."""
_FOUND_AGAIN = 0.9
"""Least ratio of points seen at the measured place to those at the expected one."""
_SPLIT_FRAMES = 3
"""Frames in a row after which separate parts become two obstacles."""
_TABLE_SHIFT = 0.003
"""Motion of the table within 1 m at which its plane is handed on again [m]."""
_MERGE_TIME = 0.5
"""Time as one cluster after which obstacles that move alike become one [s]."""
_ALIKE = 0.1
"""Difference of the velocities of obstacles that move alike [m/s]."""


_GROWN = 0.0025
"""Growth in any direction at which the cloud of an obstacle is handed on again [m]."""
_SHRUNK = 0.005
"""Shrinkage in any direction at which the cloud of an obstacle is handed on again [m]."""
_CHANGED_SHARE = 0.1
"""Relative change of the number of points at which a cloud is handed on again."""


@dataclass(frozen=True, eq=False)
class Points(Frozen):
    """N remembered points of obstacles.

    Attributes:
        p_OQ: (N, 3) in the frame O of its obstacle [m].
        owner: (N,) row of its obstacle.
        evidence: (N,) from 1 to `CERTAIN`.
        weight: (N,) how many frames it is the mean of.
        confirmed: (N,) whether a second frame has shown it.
    """

    p_OQ: FloatArray = zeros(0, 3)
    owner: IntArray = zeros(0, kind=np.int64)
    evidence: IntArray = zeros(0, kind=np.int64)
    weight: IntArray = zeros(0, kind=np.int64)
    confirmed: BoolArray = zeros(0, kind=bool)

    def __len__(self) -> int:
        return len(self.owner)


class HeldCloud(NamedTuple):
    """The cloud of an obstacle as it was handed on last.

    Attributes:
        p_OQ: (N, 3) in the obstacle's frame O [m].
        p_WQ: (N, 3) in the world [m].
    """

    p_OQ: FloatArray
    p_WQ: FloatArray


@dataclass(frozen=True, eq=False)
class TrackerState(Frozen):
    """Everything that perception remembers.

    Attributes:
        obstacles: what is handed on.
        next_id: the first name that was never given to an obstacle.
        tracks: the obstacles.
        points: their points.
        held: id -> its cloud as it was handed on last.
        references: id -> surface in an earlier frame, for its velocity.
        taken: time of the last frame [s].
        last_image_stamps: (n,) times of the last image of each camera that told something [s].
        cloud_W: (K, 3) points of the last frame, for viewing [m].
    """

    obstacles: ObstacleClouds = field(default_factory=ObstacleClouds)
    next_id: int = 0
    tracks: Tracks = field(default_factory=Tracks)
    points: Points = field(default_factory=Points)
    held: dict[int, HeldCloud] = field(default_factory=dict)
    references: dict[int, Reference] = field(default_factory=dict)
    taken: float = -np.inf
    last_image_stamps: FloatArray = zeros(0)
    cloud_W: FloatArray = zeros(0, 3)


_Rows = TypeVar("_Rows", Points, Tracks)


def taken(value: _Rows, index: IntArray | BoolArray) -> _Rows:
    """Takes some rows of points or tracks."""
    return replace(value, **{name: part[index] for name, part in vars(value).items()})


def appended(first: _Rows, second: _Rows) -> _Rows:
    """Joins the rows of two values."""
    parts = {name: np.concatenate([one, vars(second)[name]]) for name, one in vars(first).items()}
    return replace(first, **parts)


@dataclass(frozen=True, eq=False)
class Association:
    """Rows of obstacles for the points and clusters of a frame.

    Attributes:
        point_row: (Q,) obstacle of each point; those not known before follow the others.
        cluster_row: (C,) obstacle that most of each cluster belongs to.
        mixed: (C,) whether a cluster holds points of several obstacles.
        new: the clusters that are new obstacles, in the order of their rows.
        partner: (M,) the largest obstacle in a cluster with this one, -1: none.
    """

    point_row: IntArray
    cluster_row: IntArray
    mixed: BoolArray
    new: IntArray
    partner: IntArray


def associate(
    points: FloatArray,
    cluster: IntArray,
    clusters: int,
    voted: IntArray,
    remembered: FloatArray,
    owner: IntArray,
    tracks: int,
) -> Association:
    """Gives clusters to obstacles: by common points, else by predicted centroids.

    An obstacle takes every cluster that has points in common with it, a share of the smaller
    of the two. A cluster that two obstacles claim is divided between them, each point to
    that of the nearest remembered point. The rest is matched by the least total distance
    of centroids below the gate; what then is left is new.

    Args:
        points: (Q, 3) of the frame in the world [m].
        cluster: (Q,) their clusters.
        clusters: C, how many there are.
        voted: (Q,) the remembered point nearest to each, -1: none near.
        remembered: (N, 3) where remembered points should be in the world [m].
        owner: (N,) their obstacles.
        tracks: M, how many there are.
    """
    sizes = np.bincount(cluster, minlength=clusters)
    known = np.bincount(owner, minlength=tracks)
    vote_row = np.append(owner, -1)[voted]
    pair = cluster * tracks + vote_row
    votes = np.bincount(pair[voted >= 0], minlength=clusters * tracks).reshape(clusters, tracks)
    smaller = np.minimum(sizes[:, None], known[None])
    least = np.maximum(_COMMON_POINTS, _COMMON_SHARE * smaller)
    claims = votes >= least
    cluster_row = np.full(clusters, -1, dtype=np.int64)
    if tracks:
        claimed = claims.any(axis=1)
        cluster_row[claimed] = np.where(claims, votes, -1)[claimed].argmax(axis=1)
    left = np.flatnonzero(cluster_row < 0)
    lost = np.flatnonzero(~claims.any(axis=0) & (known > 0))
    if len(left) and len(lost):
        seen = np.stack([points[cluster == c].mean(axis=0) for c in left])
        expected = np.stack([remembered[owner == m].mean(axis=0) for m in lost])
        gap = np.linalg.norm(seen[:, None] - expected[None], axis=2)
        # Pairs beyond the gate cost more than any number of pairs within it.
        rows, columns = linear_sum_assignment(np.where(gap < _GATE, gap, 1e3 * _GATE))
        near = gap[rows, columns] < _GATE
        cluster_row[left[rows[near]]] = lost[columns[near]]
    new = np.flatnonzero(cluster_row < 0)
    cluster_row[new] = tracks + np.arange(len(new))
    mixed = claims.sum(axis=1) > 1
    point_row = cluster_row[cluster]
    partner = np.full(tracks, -1, dtype=np.int64)
    for c in np.flatnonzero(mixed):
        inside = np.flatnonzero(cluster == c)
        rows = np.flatnonzero(claims[c])
        among = np.isin(owner, rows)
        _, nearest = cKDTree(remembered[among]).query(points[inside])
        point_row[inside] = owner[among][nearest]
        largest = rows[known[rows].argmax()]
        partner[rows[rows != largest]] = largest
    return Association(point_row, cluster_row, mixed, new, partner)


def update_tracks(
    previous: TrackerState,
    frame: Segmentation,
    stamp: float,
    config: SegmentationConfig | None = None,
    robot: CollisionGeometries | None = None,
    *,
    complete: bool = True,
) -> TrackerState:
    """Joins a new frame with what was known before it.

    A remembered point is kept where no image of the frame can tell: something stands before it
    (the arm, another obstacle), its pixels have no depth, it lies outside the image, or
    the robot is where it is. An obstacle behind a parked arm is therefore remembered for
    as long as the arm stays. Two frames that show its place without it, in any of their images,
    remove it.

    - A frame that is not usable (no valid pixel, no table) changes nothing but the note: the
      stamp tells how old the obstacles are.
    - A frame with the stamp of the one before it is that frame again: nothing changes.
    - A frame from before the last one begins again: nothing is remembered, but no name is
      given twice.
    - After a gap of `velocity.LONGEST_GAP` obstacles are remembered, velocities not.

    Args:
        previous: what is remembered; `TrackerState()` before the first frame.
        frame: the new frame, segmented. In its images inf counts as free space; a cloud is taken
            to show everything, so that nothing is hidden.
        stamp: time of the frame [s].
        config: the parameters the frame was segmented with; None for the defaults.
        robot: the robot's solids at that time, or None.
        complete: whether all cameras have told something; what only another one has seen of an
            obstacle is else kept behind what this frame shows of it.

    Returns:
        What is remembered after the frame; its `obstacles` are to be handed on.
    """
    if not frame.usable:
        return replace(previous, obstacles=replace(previous.obstacles, note=frame.note))
    if stamp == previous.taken:
        return replace(previous, obstacles=replace(previous.obstacles, note=""))
    if stamp < previous.taken:
        previous = TrackerState(next_id=previous.next_id)
    return _Step(previous, frame, stamp, config or SegmentationConfig(), robot, complete).run()


class _Look(NamedTuple):
    """State of N remembered points in V images of the frame, and the nearest of the points.

    Attributes:
        p_WQ: (N, 3) where they should be in the world [m].
        nearest: (Q,) of them to each point of the frame, -1: none near.
        from_seen: (Q,) how far [m].
        distance: (N,) from the frame's nearest point [m].
        shows: (N,) HIDDEN, AT, FREE, OUT or EMPTY, by the image that says most.
        each: (V, N) the same of each image.
        pixel: (V, N) their pixels in each, -1 outside it.
    """

    p_WQ: FloatArray
    nearest: IntArray
    from_seen: FloatArray
    distance: FloatArray
    shows: IntArray
    each: IntArray
    pixel: IntArray


class _Step:
    """One frame joined with the memory; lives as long as `update_tracks` runs."""

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
        self.config, self.robot, self.first = config, robot, previous.taken == -np.inf
        self.dt = 0.0 if self.first else stamp - previous.taken
        self.tracks, self.points = previous.tracks, previous.points
        lengths = [len(cloud) for cloud in frame.clouds_W]
        self.seen = np.concatenate([np.zeros((0, 3)), *frame.clouds_W])
        self.cluster = np.repeat(np.arange(len(lengths)), lengths)
        self.next_id = previous.next_id

    def run(self) -> TrackerState:
        """The memory after the frame."""
        self.tracks = predicted_tracks(self.tracks, self.dt)
        look = self._look()
        association = associate(
            self.seen,
            self.cluster,
            len(self.frame.clouds_W),
            look.nearest,
            look.p_WQ,
            self.points.owner,
            len(self.tracks),
        )
        new = [self.frame.clouds_W[c].mean(axis=0) for c in association.new]
        self._append(new_tracks(np.reshape(new, (-1, 3))))
        behind = self._behind_itself(association, look)
        self._motion_evidence(look, behind)
        # Of what moves, missing pixels must not hide where it ends: it would go on for ever.
        in_image = (look.pixel >= 0).any(axis=0)
        missing = (look.shows == EMPTY) | ((look.shows == OUT) & in_image)
        missing &= self.tracks.moving[self.points.owner]
        hidden = (look.shows != AT) & (look.shows != FREE) & ~behind & ~missing
        expected = self.tracks
        self._measure(association, look.p_WQ, hidden)
        if np.abs(self.tracks.shift_W - expected.shift_W).max(initial=0.0) > _CORRECTION:
            look = self._moved_back(expected, look)
            behind = self._behind_itself(association, look)
        self._split(association, look)
        self._weigh(association, look, behind)
        self._remember(association, look)
        self._merge(association)
        self._forget()
        return self._handed_on()

    def _look(self) -> _Look:
        p_WQ = self.points.p_OQ + self.tracks.shift_W[self.points.owner]
        nearest, from_seen, distance = mutual_nearest(self.seen, p_WQ, _MATCH_RADIUS)
        # A cloud is taken to show every point.
        everything = np.full(len(p_WQ), AT), np.full(len(p_WQ), -1)
        looks = [shown(p_WQ, view, DEPTH_MARGIN) for view in self.frame.views]
        each, pixel = np.stack(looks or [everything], axis=1)
        shows = each[_SAYS[each].argmax(axis=0), np.arange(len(p_WQ))]
        if self.robot is not None:
            # Only what seems to be gone needs the robot's excuse.
            requested = np.flatnonzero(
                (distance >= SUPPORT_RADIUS) & np.isin(shows, (AT, FREE, EMPTY))
            )
            margin = self.config.robot_margin
            d = least_distances(self.robot, p_WQ[requested], 0.0, margin, margin)
            shows[requested[d < margin]] = OUT
        return _Look(p_WQ, nearest, from_seen, distance, shows, each, pixel)

    def _moved_back(self, expected: Tracks, before: _Look) -> _Look:
        """Leaves where they were expected those of which less is seen at the measured place.

        A side of something thin may be seen here in one frame and there in the next, though the
        thing does not move; then its surface does not either.

        Args:
            expected: the obstacles before they were measured.
            before: the frame as it shows their points then.

        Returns:
            The frame as it shows their points now.
        """
        after, near, owner = self._look(), SUPPORT_RADIUS, self.points.owner
        rows = np.arange(len(self.tracks))
        there, here = (
            np.bincount(owner[look.distance < near], minlength=len(rows))
            for look in (before, after)
        )
        lost = ~expected.moving & (here < _FOUND_AGAIN * there)
        lost &= speed_statistic(self.tracks) < START
        lost &= (self.tracks.shift_W != expected.shift_W).any(axis=1)
        if not lost.any():
            return after
        expected = replace(
            expected, unmeasured_time=expected.unmeasured_time + self.dt, odd=self.tracks.odd
        )
        both = appended(self.tracks, expected)
        self.tracks = taken(both, np.where(lost, len(rows) + rows, rows))
        return self._look()

    def _behind_itself(self, association: Association, look: _Look) -> BoolArray:
        """Finds hidden points (N,) behind their own obstacle: it moved or turned.

        They are so in each image that shows their place; another one may have seen them
        from behind.
        """
        if not self.complete or not self.frame.views:
            return np.zeros(len(self.points), dtype=bool)
        rows = np.append(association.cluster_row, -1)
        pairs = zip(self.frame.labels, look.pixel, strict=True)
        shown_row = np.stack([rows[label[pixel]] for label, pixel in pairs])
        before = (look.each == HIDDEN) & (shown_row == self.points.owner)
        return np.asarray(before.any(axis=0) & (before | (look.pixel < 0)).all(axis=0))

    def _motion_evidence(self, look: _Look, behind: BoolArray) -> None:
        """How much of each obstacle is not where it is remembered."""
        points, shows = self.points, look.shows
        last_image_stamps = (shows == AT) | (shows == FREE) | (shows == EMPTY) | behind
        requested = points.confirmed & last_image_stamps
        count = len(self.tracks)
        total = np.bincount(points.owner[requested], minlength=count)
        requested &= look.distance >= SUPPORT_RADIUS
        missed = np.bincount(points.owner[requested], minlength=count)
        least = _LEAST_SEEN * np.bincount(points.owner, minlength=count)
        share = missed / np.maximum(total, np.maximum(least, 1.0))
        left = _FADING * self.tracks.motion_evidence
        self.tracks = replace(self.tracks, motion_evidence=np.maximum(share, left))

    def _measure(self, association: Association, p_WQ: FloatArray, hidden: BoolArray) -> None:
        tracks = self.tracks
        rows = np.where(association.mixed, -1, association.cluster_row)
        seen = seen_sides(self.frame, rows, tracks.area, self.config.voxel)
        # Of the remembered points beyond each side, the share that the frame does not show.
        owner = self.points.owner
        low, high = np.moveaxis(seen.place[owner], 2, 0)
        far = np.stack([p_WQ < low - _SIDE_SLACK, p_WQ > high + _SIDE_SLACK], axis=2)
        far = far.reshape(-1, 6)
        mine = (owner == np.arange(len(tracks))[:, None]).astype(float)
        share = mine @ (far & hidden[:, None]) / np.maximum(mine @ far, 1.0)
        is_seen = share.reshape(seen.ends.shape) < _HIDDEN_SHARE
        seen = replace(seen, ends=seen.ends & is_seen)
        deviation = depth_deviation(tracks.p_W, self.frame.views)
        v_W, spread, self._references = registered_tracks(
            tracks,
            self.previous.references,
            self.seen,
            association.point_row,
            self.cluster,
            deviation,
            self.stamp,
        )
        self.tracks = measured_tracks(tracks, seen, deviation, v_W, spread, self.dt)

    def _weigh(self, association: Association, look: _Look, behind: BoolArray) -> None:
        """Weighs the remembered points, and drops those without evidence."""
        points, shows = self.points, look.shows
        hit = look.distance < np.where(points.confirmed, SUPPORT_RADIUS, SAME_RADIUS)
        is_found = np.isin(points.owner, association.point_row)
        gone = (shows == FREE) | ((shows == AT) & ~is_found)
        fading = (shows == AT) | behind
        less = np.where(gone, np.minimum(points.evidence, _CONFIRMED) - 1, points.evidence - fading)
        evidence = np.where(hit, np.minimum(points.evidence + 1, _CERTAIN), less)
        # New points of an obstacle that rests, and is handed on, are confirmed by a third frame.
        settled = np.isin(self.tracks.ids, list(self.previous.held)) & ~self.tracks.moving
        confirmed = points.confirmed | (evidence >= _CONFIRMED + settled[points.owner])
        evidence[~points.confirmed & ~hit & (gone | fading)] = 0
        left = evidence > 0
        # `remember` still asks for these points by their places here.
        self._kept = np.where(left, np.cumsum(left) - 1, -1)
        self.points = taken(replace(points, evidence=evidence, confirmed=confirmed), left)

    def _remember(self, association: Association, look: _Look) -> None:
        """Moves remembered points to what was seen of them, and adds what is new."""
        distance = look.from_seen
        kept = np.append(self._kept, -1)[look.nearest]
        row = association.point_row
        same = np.append(self.points.owner, -1)[kept] == row
        p_OQ = np.array(self.points.p_OQ)
        weight = np.array(self.points.weight)
        local = self.seen - self.tracks.shift_W[row]
        near = distance <= SAME_RADIUS
        again = same & near & (kept >= 0)
        # Points that are seen again move to the mean of what was seen of them.
        at = kept[again]
        count = np.bincount(at, minlength=len(p_OQ))
        seen = count > 0
        weight[seen] = np.minimum(weight[seen] + 1, _MEAN_FRAMES)
        total = np.stack([np.bincount(at, one, len(p_OQ)) for one in local[again].T], axis=1)
        p_OQ[seen] += (total[seen] / count[seen, None] - p_OQ[seen]) / weight[seen, None]
        self.points = replace(self.points, p_OQ=p_OQ, weight=weight)
        new = np.flatnonzero((kept < 0) | ~near)
        ones = np.ones(len(new), dtype=np.int64)
        geometry = np.zeros(len(self.tracks), dtype=bool)
        sizes = np.array([len(self.frame.clouds_W[c]) for c in association.new], dtype=int)
        believed = self.first | (sizes >= _SOLID * self.config.min_cluster_voxels)
        geometry[association.cluster_row[association.new]] = believed
        added = Points(local[new], row[new], ones, ones, geometry[row[new]])
        self.points = appended(self.points, added)

    def _split(self, association: Association, look: _Look) -> None:
        """Makes obstacles of the smaller parts of those that are seen in parts for long.

        Parts that remembered points connect which the frame does not show are one obstacle.
        """
        tracks, points = self.tracks, self.points
        unseen = (look.shows != AT) & (look.shows != FREE)
        rows = np.where(association.mixed, -1, association.cluster_row)
        owner, sides, area = np.array(points.owner), np.array(tracks.sides), np.array(tracks.area)
        apart = np.zeros(len(tracks), dtype=np.int64)
        origin: list[int] = []
        for row in np.flatnonzero(np.bincount(rows + 1)[1:] > 1):
            seen = np.flatnonzero(np.isin(self.cluster, np.flatnonzero(rows == row)))
            mine = np.flatnonzero(points.owner == row)
            hidden = look.p_WQ[mine[unseen[mine]]]
            joined = np.concatenate([self.seen[seen], hidden])
            groups = np.concatenate([self.cluster[seen], -1 - np.arange(len(hidden))])
            label = connected_clusters(joined, self.config.cluster_tolerance, groups)[: len(seen)]
            # The first part has the largest cluster.
            apart[row] = tracks.apart[row] + 1 if label.any() else 0
            if apart[row] < _SPLIT_FRAMES:
                continue
            sides[row], area[row], apart[row] = np.nan, 0.0, 0
            nearest, _, _ = mutual_nearest(look.p_WQ[mine], self.seen[seen], OCCLUSION_GAP)
            part = np.append(label, 0)[nearest]
            for number in np.unique(label[label > 0]):
                new = len(tracks) + len(origin)
                owner[mine[part == number]] = association.point_row[seen[label == number]] = new
                origin.append(int(row))
        self.points = replace(points, owner=owner)
        self.tracks = replace(tracks, sides=sides, area=area, apart=apart)
        self._append(taken(self.tracks, np.array(origin, dtype=np.int64)))

    def _append(self, tracks: Tracks) -> None:
        """Adds obstacles under new names."""
        ids = self.next_id + np.arange(len(tracks))
        self.next_id += len(tracks)
        self.tracks = appended(self.tracks, replace(tracks, ids=ids))

    def _merge(self, association: Association) -> None:
        """Joins obstacles that are one cluster and move alike for long."""
        tracks = self.tracks
        rows = np.flatnonzero(association.partner >= 0)
        into = association.partner[rows]
        v_W = np.where(tracks.moving[:, None], tracks.v_W, 0.0)
        alike = np.linalg.norm(v_W[rows] - v_W[into], axis=1) < _ALIKE
        sync_tolerance = np.zeros(len(tracks))
        sync_tolerance[rows] = np.where(alike, tracks.sync_tolerance[rows] + self.dt, 0.0)
        sides = np.array(tracks.sides)
        p_OQ, owner = np.array(self.points.p_OQ), np.array(self.points.owner)
        for row, other in zip(rows, into, strict=True):
            if sync_tolerance[row] >= _MERGE_TIME:
                mine = owner == row
                p_OQ[mine] += tracks.shift_W[row] - tracks.shift_W[other]
                owner[mine], sides[other] = other, np.nan
        self.points = replace(self.points, p_OQ=p_OQ, owner=owner)
        self.tracks = replace(tracks, sides=sides, sync_tolerance=sync_tolerance)

    def _forget(self) -> None:
        """Lets go of obstacles of which too little is left."""
        count = np.bincount(self.points.owner, minlength=len(self.tracks))
        left = count >= self._fewest()
        row = np.cumsum(left) - 1
        points = taken(self.points, left[self.points.owner])
        self.points = replace(points, owner=row[points.owner])
        self.tracks = taken(self.tracks, left)

    def _fewest(self) -> int:
        return max(4, self.config.min_cluster_voxels // 2)

    def _handed_on(self) -> TrackerState:
        tracks, points = self.tracks, self.points
        confirmed = np.bincount(points.owner[points.confirmed], minlength=len(tracks))
        listed = confirmed >= self._fewest()
        held = held_clouds(tracks.ids, tracks.shift_W, points, listed, self.previous.held)
        moving = tracks.moving & (np.linalg.norm(tracks.v_W, axis=1) > 0.0)
        obstacles = ObstacleClouds(
            self.stamp,
            tuple(held[name].p_WQ for name in tracks.ids[listed].tolist()),
            tracks.ids[listed],
            held_table(self.previous.obstacles.table, self.frame.table),
            v_WO=np.where(moving[:, None], tracks.v_W, 0.0)[listed],
        )
        return TrackerState(
            obstacles,
            self.next_id,
            tracks,
            points,
            held,
            self._references,
            self.stamp,
            self.previous.last_image_stamps,
        )


def held_clouds(
    ids: IntArray,
    shift_W: FloatArray,
    points: Points,
    listed: BoolArray,
    previous: dict[int, HeldCloud],
) -> dict[int, HeldCloud]:
    """Selects the clouds to hand on, by name.

    The cloud of an obstacle stays while the present one differs from it by no more than noise.

    Args:
        ids: (M,) names of the obstacles.
        shift_W: (M, 3) from the frame O of each obstacle's points to the world [m].
        points: the remembered points; only the confirmed are handed on.
        listed: (M,) which obstacles to hand on.
        previous: what was handed on last.
    """
    owner = np.where(points.confirmed, points.owner, -1)
    held = {}
    for row in np.flatnonzero(listed):
        name, p_OQ = int(ids[row]), points.p_OQ[owner == row]
        old = previous.get(name)
        if old is not None:
            reach, before = ((DIRECTIONS @ cloud.T).max(axis=1) for cloud in (p_OQ, old.p_OQ))
            more, size = reach - before, len(old.p_OQ)
            if (
                (more <= _GROWN).all()
                and (more >= -_SHRUNK).all()
                and abs(len(p_OQ) - size) <= _CHANGED_SHARE * size
            ):
                p_OQ = old.p_OQ
        p_WQ = p_OQ + shift_W[row]
        p_WQ.flags.writeable = False
        is_held = old is not None and np.array_equal(p_WQ, old.p_WQ)
        held[name] = previous[name] if is_held else HeldCloud(p_OQ, p_WQ)
    return held


def held_table(previous: TablePlane | None, seen: TablePlane | None) -> TablePlane | None:
    """The previous plane unless the new one is farther from it than `_TABLE_SHIFT`."""
    if previous is None or seen is None:
        return seen
    return seen if seen.distance_to(previous) > _TABLE_SHIFT else previous
