"""Interface to hardware: a Panda and depth cameras connected by LCM messages.

Messages are Drake's: `lcmt_panda_command` on PANDA_COMMAND, `lcmt_panda_status` on PANDA_STATUS,
`lcmt_image_array` on DRAKE_RGBD_CAMERA_IMAGES_<camera>. Stamps are wall-clock times [us]; positions
are those of the arm's seven joints [rad].

The side of the motion (`drake-oa run --hardware`):

- `hardware_station.add_hardware` adds the robot's messages and live cameras instead of the
  simulated world. `robot_link` has the systems, and checks the arm before it moves.
- `command_streamer.CommandStreamer` runs in a separate process. It sends the commands that the
  diagram writes a little ahead into a `SharedTrajectory`, and stops the arm after a failure.

The side of the arm (`drake-oa station`):

- `panda_station.PandaStation` is a scenario's simulated robot and cameras behind the messages.
- `command_streamer.CommandValidator` checks each command before the arm follows it. It rejects
  commands that are old, out of limits, discontinuous, or from a second command source.

This package was never run on a real arm.

Read `robot_link.RobotLink` first.
"""
