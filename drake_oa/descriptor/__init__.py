"""Descriptor layer: describes each obstacle, dilated by the tool, by ellipsoids.

In: `ObstacleClouds` in the world frame [m]; optionally the goal (3,) [m].
Out: `EllipsoidSet`: centers (M, 3) [m], rotations (M, 3, 3), semi-axes (M, 3) [m], velocities
(M, 3) [m/s], IDs (M,).

Systems, both without state:

- `EllipsoidDescriptor` computes the ellipsoids of perceived obstacles. Results are cached: the
  ellipsoid of an unchanged cloud is computed once.
- `GivenEllipsoidSource` outputs the constant ellipsoids of a scenario (`!GivenEllipsoids`).

Each cloud is dilated by the reflected tool (Minkowski sum). The method "enclosing" computes the
ellipsoid of minimum volume that contains the dilated cloud, "least_squares" the superquadric fit by
equation (11) of Pairet et al., RA-L 2019. Start and goal are known to be free. If the enclosing
ellipsoid would contain start or goal, or be closer than 2 cm to one of these points, the cloud is
divided into up to eight parts, and the tool into its convex parts. The obstacle then has several
rows in the output, whose IDs differ by multiples of `messages.PART_ID_STRIDE`.

Read first: `descriptor.describe`.
"""
