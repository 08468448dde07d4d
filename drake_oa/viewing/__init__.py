"""Intermediate results of the layers, drawn into Drake's Meshcat beside the robot.

In, all in the world frame: `EllipsoidSet`, `PolicyState`, `Route`, the cloud and the bodies' poses;
only the policy's state is needed. Out: nothing, it writes to Meshcat under "/drake_oa".

- `MeshcatOverlay` draws at 15 Hz, and a cloud every 0.2 s: ellipsoids, cost rings, chosen
  directions, planned and executed paths. It works live and in a recording, which holds transforms
  and properties but no objects.
- `drawing` has the geometry of it, as functions of arrays; `viewer` starts, dresses, records and
  keeps Meshcat for the commands.
- `panel` adds title, readings and legend to Meshcat's page, recorded or live (`LivePage`).

Begin with the class docstring of `meshcat_overlay.MeshcatOverlay`.
"""
