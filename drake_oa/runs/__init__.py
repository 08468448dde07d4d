"""Simulation of a scenario; its log, metrics, report, plots and replay.

Input: a `Scenario`. Outputs: a `MotionLog` (arrays over T instants, SI units, world frame, in an
.npz file), plots of it, and its replay in Meshcat.

- `simulation`: builds the diagram, simulates it until the motion has terminated and the world is
  at rest, and collects the data of the log sinks (`simulate`).
- `motion_log`: the log and its file.
- `metrics`: collisions, clearance and path length, computed from the true geometry.
- `report`: the metrics of a run as JSON and as a table.
- `plots`: plots of a logged run.
- `replay`: a logged motion on output ports (`LogPlayer`), and a diagram that replays it.
- `page`, `play`: the panel of a viewer's page, and the interactive run of `drake-oa play`.
- `scenario_check`, `camera_placement`: checks of a scenario before it is run.
- `hardware_run`: the same motion with a real arm and real cameras.

Nothing here is part of the robot's software: on a real robot the same signals are logged.

Begin with `simulation.simulate`.
"""
