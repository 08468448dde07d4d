"""Geometry as functions of arrays: ellipsoids, superquadrics, collision geometries, distance
fields, voxels and cameras.

The package has no systems. Lengths are in meters, angles in radians; `p_WQ` are points Q in the
world frame W, `R_WO` (3, 3) rotations, and `X_WG` poses, as matrices (4, 4), their upper rows (3,
4), or RigidTransform.

- `ellipsoid`: the unified system-obstacle descriptor (Pairet et al., RA-L 2019, section IV-B). An
  obstacle's point cloud is dilated by the tool: the dilated points are the differences of a point
  of the cloud and a vertex of the tool. The descriptor is the enclosing ellipsoid of least volume
  (Todd and Yildirim 2007), which is checked to contain all dilated points. The module also computes
  signed distances from points to ellipsoids, and sections of ellipsoids by planes. Its loops are in
  `ellipsoid_kernels`.
- `superquadric`: the paper's least-squares fit of a superquadric to a cloud (Solina and Bajcsy
  1990).
- `collision_scene`: collision geometries of robots and obstacles: exact shapes and convex hulls,
  which can be read from Drake, and distance fields of point clouds, each with a velocity; signed
  distances from points to them at a given time, and points on their surfaces.
- `distance_field`: grid of distances to an obstacle's point cloud and to the space behind it that
  the obstacle probably fills.
- `shapes`: `!Box`, `!Cylinder` and `!Sphere`, blocks of a scenario.
- `voxels`: mean of the points in each voxel, and clusters of near points.
- `pinhole`: projection by a pinhole camera; depth images with the intrinsics and pose of their
  camera (`View`); classification of points by depth images as free, occluded or at a surface.
- `directions`: unit vectors, lattices, and points on a sphere.

Compiled kernels that Python calls take C-contiguous arrays of one type each, so that numba compiles
each of them once and caches it on disk. A NamedTuple such as `CollisionGeometries` counts as one
argument.

Read first: `ellipsoid.enclosing_ellipsoid`.
"""
