"""Interface to hardware: a Panda by LCM messages, or a Franka Research 3 by the library of its
vendor, and depth cameras by LCM messages.

The message types are those of Drake: `lcmt_panda_command` on channel PANDA_COMMAND,
`lcmt_panda_status` on PANDA_STATUS, and `lcmt_image_array` on DRAKE_RGBD_CAMERA_IMAGES_<camera>.
Time stamps are wall-clock times [us]. Positions in the arm's messages are those of its seven joints
[rad].

Modules that compute and send the motion (`drake-oa run --hardware`):

- `hardware_station.add_hardware` adds the robot's messages and live cameras to a diagram, instead
  of the simulated world. `robot_link` has the systems that connect the arm to the diagram, and
  checks the arm before it moves.
- `command_streamer.CommandStreamer` runs in a separate process. The diagram writes planned
  positions, a little ahead of time, into a `SharedTrajectory` (memory that both processes share);
  the streamer sends them to the arm, and stops the arm after a failure. Its connections to an arm
  are `LcmArm` and `franka_arm.FrankaArm`.

Modules that simulate the arm behind the messages (`drake-oa station`):

- `panda_station.PandaStation` connects the simulated robot and cameras of a scenario to the
  messages.
- `command_streamer.CommandValidator` checks each command before the arm follows it. It rejects
  commands with an old time stamp, outside the joint limits, with a jump of the positions, or from a
  second command source.

This package was never run on a real arm.

Read `robot_link.RobotLink` first.
"""
