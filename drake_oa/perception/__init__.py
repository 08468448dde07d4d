"""From depth images to obstacles with names and velocities.

In: of each camera an ImageDepth32F [m] and its pose X_WC (x right, y down, z forward) every period,
and the robot's state [q, v] to take the robot itself out. Out: `ObstacleClouds` in the world frame:
one cloud (N, 3) [m] an obstacle, velocities [m/s], names that stay, the table's plane and a stamp
[s].

Sources, one in place of the other (block `perception` of a scenario):

- `DepthPerception` (`!DepthCamera`, `!LcmCamera`), at the camera's rate;
- `GroundTruthPerception` (`!GroundTruth`), which asks SceneGraph, at 15 Hz;
- `RecordedPerception` (`!RecordedClouds`), which plays back files (`recordings`), at 15 Hz.

A frame, of the images that all cameras took at one instant, goes through

1. `segmentation`: the supporting plane by consensus with a prior on gravity and range (`table`;
   Fischler and Bolles 1981), pixels above it (without a table all of them), voxels
   and clusters;
2. `tracking`: clusters are given to obstacles by common points, else by the least total distance
   (Hungarian method); positions are measured by the obstacles' sides, so that what hides
   a part of one does not move it, velocities by laying a frame's surface on the one before
   (`velocity`; Chen and Medioni 1992), and both are filtered by a constant-velocity Kalman
   filter (`velocity`; Bar-Shalom, Li and Kirubarajan 2001); remembered points gain and lose
   evidence;
3. `tracking.held_clouds`: what changed by more than noise is handed on, all else stays the same
   bit for bit.

The configuration is `config`: `SegmentationConfig` and the sources' blocks. All run-time data is
one `TrackerState` in the Context.

Begin with `depth_perception.DepthPerception`, then `segmentation.segment_depth` and
`tracking.update_tracks`.
"""
