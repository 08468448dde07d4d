"""Descriptor layer: describes each obstacle, dilated by the tool, by ellipsoids.

In: `ObstacleClouds` in the world frame [m]; optionally the goal (3,) [m].
Out: `EllipsoidSet`: centers (M, 3) [m], rotations (M, 3, 3), semi-axes (M, 3) [m], velocities
(M, 3) [m/s], IDs (M,).

Systems, both without state:

- `EllipsoidDescriptor` computes the ellipsoids of perceived obstacles. Results are cached by the
  bytes of the cloud, so that an unchanged obstacle is described once.
- `GivenEllipsoidSource` outputs the constant ellipsoids of a scenario (`!GivenEllipsoids`).

Each cloud is dilated by the reflected tool (Minkowski sum) and enclosed in the ellipsoid of minimum
volume (method "enclosing"), or fitted by least squares as in Pairet et al., RA-L 2019, eq. 11
("least_squares"). If the ellipsoid would contain the start or the goal, which are known to be free,
the cloud is divided into up to eight parts and the tool into its convex parts. The obstacle then
has several rows, whose IDs differ by multiples of `messages.PART_ID_STRIDE`.

Read first: `descriptor.describe`.
"""
