"""The way out of the simulator: what speaks the messages of a Panda and of depth cameras.

Messages are Drake's, over LCM: `lcmt_panda_command` on PANDA_COMMAND, `lcmt_panda_status` on
PANDA_STATUS, `lcmt_image_array` on DRAKE_RGBD_CAMERA_IMAGES_<camera>. Stamps are of the wall
clock, in microseconds; positions are the arm's seven [rad].

- `panda_station.PandaStation` is a scenario's simulated robot and cameras behind these messages,
  as `drake-oa station` runs it. It takes positions only.
- `CommandGuard` judges each command before the arm follows it: one that is old, out of limits,
  that jumps, or of a second commander is refused, and the arm holds. It knows nothing of LCM.

Nothing here was ever run on a real arm.

Begin with `panda_station.PandaStation`.
"""
