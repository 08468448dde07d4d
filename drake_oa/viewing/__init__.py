"""Visualization: the robot and intermediate results of the layers in Drake's Meshcat.

Inputs, all in the world frame: `EllipsoidSet` (ellipsoids around the obstacles), `PolicyState`
(state of the movement primitive), `Route` (selected side of each obstacle, with the costs of all
sides), a point cloud, and the poses of the bodies. Only the policy state is required. Output:
objects in Meshcat under "/drake_oa".

- `MeshcatOverlay` draws ellipsoids, cost rings (costs of passing an obstacle on each side),
  selected directions, nominal and executed paths at 15 Hz, and a point cloud every 0.2 s. The
  drawing is visible in the live view and in a recording.
- `drawing` computes the geometry of cost rings from arrays. `viewer` starts Meshcat, sets its
  background and camera, records the scene, and keeps Meshcat open after a command of drake-oa.
- `panel` adds a title, readings (text on the present state of the run) and a legend to the page of
  a recording or to the live page (`LivePage`).
- `still` draws a scenario as an image file. `layer_figure` draws the layers of a diagram as SVG.

Read the class docstring of `meshcat_overlay.MeshcatOverlay` first.
"""
