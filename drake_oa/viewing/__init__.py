"""Visualization: the robot and intermediate results of the layers in Drake's Meshcat.

In, all in the world frame: `EllipsoidSet`, `PolicyState`, `Route`, the cloud and the bodies' poses;
only the policy state is required. Out: objects in Meshcat under "/drake_oa".

- `MeshcatOverlay` draws ellipsoids, cost rings, selected directions, planned and executed paths at
  15 Hz, and a cloud every 0.2 s. It works in the live view and in a recording.
- `drawing` computes the geometry of cost rings from arrays. `viewer` starts Meshcat, sets its
  background and camera, records it, and keeps it open for the commands.
- `panel` adds title, readings and legend to Meshcat's page, recorded or live (`LivePage`).
- `still` draws a scenario as an image file, `layer_figure` a diagram's layers as SVG.

Read the class docstring of `meshcat_overlay.MeshcatOverlay` first.
"""
