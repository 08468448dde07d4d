"""From a depth image or a point cloud to obstacles with velocities."""
