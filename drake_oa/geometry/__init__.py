"""Geometry as functions of arrays: ellipsoids, superquadrics, solids, points.

No systems and no state. Lengths are in meters, angles in radians; `p_WQ` are points Q in the
world frame W, `X_WG` (4, 4) and `R_WO` (3, 3) poses and rotations, all of float64.

- `ellipsoid`: the unified system-obstacle descriptor (Pairet et al. 2019, section IV-B). A cloud
  dilated by the tool, O + (-E), and the ellipsoid of least volume round it (Todd and Yildirim
  2007), certified against every point and corner; distances, sections, tangent headings. Its
  loops are in `ellipsoid_kernels`.
- `superquadric`: the paper's least-squares fit (Solina and Bajcsy 1990).
- `geometries`: collision shapes of robots and obstacles, read from Drake, and their distances to points
  at a time: exact shapes, hulls and fields, each with a velocity; points on their surfaces.
  `distance_field`: a cloud as such a field, what it hides filled.
- `shapes`: `!Box`, `!Cylinder` and `!Sphere`, the blocks of a scenario.
- `voxels`: mean points by voxel, and clusters of near points.
- `pinhole`: the camera's projection, and a `View`: image, intrinsics and pose together.
- `directions`: 26 directions.

Compiled kernels take C-contiguous arrays of one type each, so that numba compiles each of them
once and caches it on disk; a NamedTuple such as `View` or `CollisionGeometries` counts as one argument.

Begin with `ellipsoid.enclosing_ellipsoid`.
"""
