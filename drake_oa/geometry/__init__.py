"""Geometry as functions of arrays: ellipsoids, superquadrics, collision geometries, distance
fields, voxels and cameras.

The package has no systems and no state. Lengths are in meters, angles in radians; `p_WQ` are points
Q in the world frame W, `X_WG` (4, 4) and `R_WO` (3, 3) poses and rotations, all of float64.

- `ellipsoid`: the unified system-obstacle descriptor (Pairet et al., RA-L 2019, section IV-B): an
  obstacle's cloud dilated by the tool, O + (-E), and the enclosing ellipsoid of least volume (Todd
  and Yildirim 2007), certified against every point and corner; distances and sections. Its loops
  are in `ellipsoid_kernels`.
- `superquadric`: the paper's least-squares fit (Solina and Bajcsy 1990).
- `collision_scene`: collision geometries of robots and obstacles, read from Drake, and their
  distances to points at a time: exact shapes, hulls and distance fields, each with a velocity;
  points on their surfaces.
- `distance_field`: the distance field of a cloud, with its occluded space filled.
- `shapes`: `!Box`, `!Cylinder` and `!Sphere`, blocks of a scenario.
- `voxels`: mean points by voxel, and clusters of near points.
- `pinhole`: projection of a pinhole camera; `View`: depth image, intrinsics and pose together.
- `directions`: unit vectors, lattices, and points on a sphere.

Compiled kernels take C-contiguous arrays of one type each, so that numba compiles each of them once
and caches it on disk. A NamedTuple such as `View` or `CollisionGeometries` counts as one argument.

Read first: `ellipsoid.enclosing_ellipsoid`.
"""
