"""Perception: from depth images to tracked obstacles with velocities.

Inputs every period: for each camera an ImageDepth32F [m] and the camera's pose X_WC (x right, y
down, z forward). The robot's state [q, v] is an input of the self filter, which removes points on
the robot. Output: `ObstacleClouds` in the world frame: for each obstacle a point cloud (N, 3) [m],
a velocity [m/s] and a constant track ID; the support plane; a stamp [s].

Perception sources; the block `perception` of a scenario selects one of them:

- `DepthPerception`: depth cameras, at the camera's rate; simulated (`!DepthCamera`), received as
  LCM messages (`!LcmCamera`), or from a bag of ROS 2 (`!RecordedBag`);
- `GroundTruthPerception` (`!GroundTruth`): exact obstacles from SceneGraph, by default at 15 Hz;
- `RecordedPerception` (`!RecordedClouds`): a folder of recorded depth images or point clouds
  (`recordings`), by default at 15 Hz.

A frame consists of the images of all cameras at one instant. It is processed in these steps:

1. `segmentation` finds the support plane by consensus with a prior on gravity and height (`table`;
   Fischler and Bolles 1981). Points above the plane, or all points if no table is expected, are
   averaged in voxels (cubes of a grid), and near voxels form clusters.
2. `tracking` assigns clusters to tracks (obstacles followed over time): by common points, else by
   the least total distance of centroids within a gate (Hungarian method). Positions are measured at
   the sides of obstacles (ends along the world axes), which do not shift with partial occlusion.
   Velocities are measured by registration of surfaces (`velocity`; Chen and Medioni 1992). A
   constant-velocity Kalman filter corrects both (Bar-Shalom, Li and Kirubarajan 2001). Each track
   remembers its surface points; later frames confirm or delete them.
3. `tracking.select_output_clouds` outputs clouds that changed by more than noise; the other clouds
   in the output remain bitwise equal.

`visibility` extends obstacles that the border of an image truncates. `coverage` computes the
fraction of the space near an arm that no camera observes to be free. `config` has the
configuration: `SegmentationConfig` and the blocks of the sources. The tracks and the output of a
source are one `TrackerState` in the Context.

Begin with `depth_perception.DepthPerception`, then `segmentation.segment_depth` and
`tracking.update_tracks`.
"""
