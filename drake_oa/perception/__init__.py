"""Perception: from depth images to tracked obstacles with velocities.

Inputs: for each camera an ImageDepth32F [m] and its pose X_WC (x right, y down, z forward) every
period, and the robot's state [q, v] for the self filter. Output: `ObstacleClouds` in the world
frame: for each obstacle a point cloud (N, 3) [m], a velocity [m/s] and a constant track ID; the
support plane; a stamp [s].

Perception sources (block `perception` of a scenario); one replaces the other:

- `DepthPerception` (`!DepthCamera`, `!LcmCamera`): depth cameras, at the camera's rate;
- `GroundTruthPerception` (`!GroundTruth`): exact obstacles from SceneGraph, at 15 Hz;
- `RecordedPerception` (`!RecordedClouds`): recorded files (`recordings`), at 15 Hz.

A frame consists of the images of all cameras at one instant. Its processing:

1. `segmentation`: support plane by consensus with a prior on gravity and height (`table`;
   Fischler and Bolles 1981); pixels above it, without a table all pixels; voxels; clusters.
2. `tracking`: data association assigns clusters to tracks by common points, else by the least total
   distance within a gate (Hungarian method). Positions are measured by the sides of obstacles,
   which do not shift with partial occlusion, velocities by registration of surfaces (`velocity`;
   Chen and Medioni 1992). A constant-velocity Kalman filter corrects both (Bar-Shalom, Li and
   Kirubarajan 2001). Remembered points gain and lose evidence.
3. `tracking.select_output_clouds`: clouds that changed by more than noise are output; the others
   remain equal to the bit.

`visibility` extends obstacles that the border of an image truncates, and `coverage` computes the
share of the space near an arm that the cameras do not observe. `config` has the configuration:
`SegmentationConfig` and the blocks of the sources. All run-time data is one `TrackerState` in the
Context.

Begin with `depth_perception.DepthPerception`, then `segmentation.segment_depth` and
`tracking.update_tracks`.
"""
