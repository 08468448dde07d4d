"""From obstacles to ellipsoids, the tool included: the low-dimensional geometric descriptors.

In: `ObstacleClouds` in the world frame [m]; optionally the goal (3,) [m] and a turn of the tool
[rad]. Out: `EllipsoidSet`: centers (M, 3) [m], rotations (M, 3, 3), semi-axes (M, 3) [m],
velocities, names.

- `EllipsoidDescriptor` has no state: the output is computed when it is asked for, once for each
  change of the input. An obstacle that does not change is described once (it is looked up by the
  bytes of its cloud).
- `GivenEllipsoidSource` hands out ellipsoids that a scenario gives (`!GivenEllipsoids`).

Each cloud is dilated by the reflected tool and enclosed in the ellipsoid of least volume (method
"enclosing"), or fitted by least squares as in Pairet et al. 2019, eq. 11 ("least_squares").
Where the one ellipsoid would hold start or goal, which are known to be free, the cloud is halved
into up to eight parts and the tool taken apart, and the obstacle has several rows, whose names
differ by multiples of `messages.PART_ID_STRIDE`.

Begin with `descriptor.describe`.
"""
