"""Simulating a scenario; its log, metrics, report, plots and replay.

In: a `Scenario`. Out: a `MotionLog` (arrays over the T steps of the plant, SI units, world frame;
an .npz file), figures of it, and its replay in Meshcat.

- `simulation`: builds the diagram, runs it until the motion has settled, is stopped, or time is up,
  and collects what the diagram's log sinks kept (`simulate`).
- `motion_log`: the log and its file.
- `metrics`: collisions, clearance, convergence and path length, measured on the true obstacles.
- `report`: the figures of a run as JSON.
- `plots`: figures of a logged run and of demonstrations.
- `replay`: a logged motion on ports (`LogPlayer`), and a diagram that shows it again.

Nothing here is part of the robot's software: on a real robot one logs the same signals.

Begin with `simulation.simulate`.
"""
