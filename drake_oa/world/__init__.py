"""The SIMULATED station: plant, cameras, noise, moving obstacles and faults.

On a real robot this folder is replaced by drivers, and nothing above it changes: it offers the
robot's state [q, v], an ImageDepth32F [m] with its time and the camera's pose X_WC, and takes
torques [N m]. Frames: W world, C camera (x right, y down, z forward).

- `station.make_station` adds a scenario's plant, scene graph and cameras to a diagram;
  `world_model` adds its models, `obstacles` those that are written in the scenario.
  `ObstacleMover` drives one on its course, at the plant's step.
- `cameras` renders in a scene graph of its own. `DelayedCamera` takes an image every period and
  outputs it some time after, with its noise; it is rendered meanwhile in a thread.
- `LiveCamera` hands out the images of a camera outside the simulation (`!LcmCamera`),
  with the time and the state they belong to. `depth_messages` packs
  depth images as LCM messages, and unpacks and receives them.
- `depth_noise` makes of a true depth image the one of a structured-light camera (Nguyen, Izadi and
  Lovell 2012; Khoshelham and Oude Elberink 2012): steps of disparity, axial noise smooth over a
  few pixels, shadows, flying and missing pixels. It is a function of seed, time and image: runs
  repeat.
- `faults` are the faults of a scenario as systems: `WeakActuators`, `ExternalPush`; `DelayedCamera`
  loses images by `CameraDropout`.

Configuration: the blocks `obstacles`, `cameras`, `directives` and `faults` of a scenario, and
`perception.noise`.

Begin with `station.make_station`.
"""
