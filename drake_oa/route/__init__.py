"""Route layer: selects the side on which the motion passes each obstacle.

In: `EllipsoidSet`, the obstacles as ellipsoids in the world frame; `PolicyState`, the state of the
movement primitive; the goal (3,) in the world frame [m]; optionally the support plane.
Out: `Route`, with three values for each obstacle: the direction omega_d from the baseline (the line
from start to goal) to the selected side; the normal of the plane in which the obstacle is passed;
and the clearance [m] at which heading guidance leads the motion past the obstacle.

System: `CostRingSelector`, updated 15 times per second, with hysteresis.

A cost ring (Pairet et al., RA-L 2019, section IV-D) assigns a cost in [0, 1] to each direction on a
circle around the baseline. There are rings for the length of the detour, the height above the
table, the workspace of the arm, and its joint limits; a cost of 1 forbids a direction. The
direction with the minimum sum of costs is selected. For several obstacles along the baseline, the
sequence of directions with the minimum total cost is selected by dynamic programming.

- `cost_rings`: cost rings, groups of obstacles without a passage between them, path segments
  between obstacles, and the selection.
- `cost_ring_selector`: the system.

The configuration is the field `table_height` of the block `policy`, and, for user-supplied rings,
the field `ring_weight` of the block `inference` tagged `!Verified`.

Read first: `cost_rings.select_directions`.
"""
