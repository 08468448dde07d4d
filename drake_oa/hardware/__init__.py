"""The way out of the simulator: a Panda and depth cameras behind messages.

Messages are Drake's, over LCM: `lcmt_panda_command` on PANDA_COMMAND, `lcmt_panda_status` on
PANDA_STATUS, `lcmt_image_array` on DRAKE_RGBD_CAMERA_IMAGES_<camera>. Stamps are of the wall
clock, in microseconds; positions are the arm's seven [rad].

Whoever drives an arm (`drake-oa run --hardware`):

- `hardware_station.add_hardware` puts the robot's messages and live cameras in the place of the
  simulated world; `robot_link` has the systems, and looks at the arm before it moves;
- `command_streamer.CommandStreamer` commands, in a process of its own, what the diagram wrote a little
  ahead into a `SharedTrajectory`, and stops the arm where it must.

The arm's side (`drake-oa station`):

- `panda_station.PandaStation` is a scenario's simulated robot and cameras behind the messages;
- `command_streamer.CommandValidator` checks each command before the arm follows it: one that is old,
  out of limits, that jumps, or of a second commander is refused. It does not use LCM.

Nothing here was ever run on a real arm.

Begin with `robot_link.RobotLink`.
"""
