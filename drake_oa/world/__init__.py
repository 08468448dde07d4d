"""The SIMULATED station: plant, cameras, noise, moving obstacles and faults.

On a real robot, drivers replace this package, and no other package changes. In: torques [N m].
Out: the robot's state [q, v], and depth images (ImageDepth32F) [m] with their times and camera
poses X_WC. Frames: W world, C camera (x right, y down, z forward).

- `station.make_station` adds a scenario's plant, scene graph and cameras to a diagram.
  `world_model` adds the models, `obstacles` the obstacles of primitive shapes. `ObstacleMover`
  moves an obstacle along its trajectory, at the plant's time step.
- `cameras` renders in a separate scene graph. `DelayedCamera` captures an image every period,
  renders it in a background thread, and outputs it with noise after a delay.
- `LiveCamera` outputs the images of a camera outside the simulation (`!LcmCamera`), with the time
  and plant state of each image. `depth_messages` packs, unpacks and receives depth images as LCM
  messages.
- `depth_noise` turns a true depth image into that of a structured-light camera (Nguyen, Izadi and
  Lovell 2012; Khoshelham and Oude Elberink 2012): steps of disparity, axial noise smooth over a
  few pixels, pixels without projected light, flying and missing pixels. Noise is a function of
  seed, time and image, so that runs repeat.
- `faults` has the systems `WeakActuators` and `ExternalPush`. `DelayedCamera` simulates the fault
  `CameraDropout`.

Configuration: the blocks `obstacles`, `cameras`, `directives` and `faults` of a scenario, and
`perception.noise`.

Read `station.make_station` first.
"""
