"""Simulation of the motions of a scenario, and evaluation of their logs: metrics, report, plots,
replay.

Input: a `Scenario`, which configures robot, obstacles, cameras and task. Outputs: a `MotionLog`
(arrays over T instants, SI units, world frame, stored in an .npz file), plots of this log, and its
replay in Meshcat.

- `simulation`: builds and simulates the diagram of a scenario until the motion has terminated and
  the world is at rest, and collects the log (`simulate`).
- `motion_log`: the class `MotionLog`, and functions that write and read log files.
- `bag_log`: the log as ROS 2 messages in a bag.
- `metrics`: contacts, clearances and path length, computed from the true geometry.
- `report`: the metrics of a run as JSON and as a table.
- `plots`: plots of a logged run.
- `replay`: a system that outputs a logged motion (`LogPlayer`), and a diagram that replays it.
- `page`, `play`: the text panel of the viewer's page, and the interactive run of `drake-oa play`.
- `scenario_check`, `camera_placement`: checks of a scenario before its run.
- `hardware_run`: run of a scenario with a real arm and real cameras.

The layers that control the robot do not use this package. A run with a real arm logs the same
signals as a simulation.

Begin with `simulation.simulate`.
"""
