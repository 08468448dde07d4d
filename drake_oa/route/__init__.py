"""The decision level: the side on which to pass each obstacle, and the ranking of all sides.

In: `EllipsoidSet` and `PolicyState` in the world, the goal (3,) [m], and the table's plane if it is
known apart, and the rows of candidate sides. Out: `Route`: for each obstacle the direction omega_d
across the baseline, the normal of the plane in which it is passed, and the clearance to be led at;
and the ranking of the candidate sides.

System: `CostRingSelector`, 15 times a second, with hysteresis.

A cost ring (Pairet et al., RA-L 2019, section IV-D) is a cost in [0, 1] of each direction of a
circle about the baseline: length of the detour, table, limits of the workspace and of the joints;
1 forbids. The direction of least sum is taken, and where obstacles stand one after the other the
sequence of least total, by dynamic programming.

- `cost_rings`: the rings, groups of obstacles, legs between them, and the selection.

The configuration is in the block `policy`: `table_height`.

Begin with `cost_rings.select_directions`.
"""
