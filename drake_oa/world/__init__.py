"""Simulated station of a scenario: plant, cameras, noise, moving obstacles and faults.

On a real robot, drivers replace the simulated plant and cameras, and the other packages are
unchanged. The inputs are joint torques [N m]. The outputs are the robot's state [q, v], and depth
images (ImageDepth32F) [m] with their capture times [s] and camera poses X_WC. Frames: W is the
world, C is the camera (x right, y down, z forward).

- `station.make_station` adds the plant, scene graph and cameras of a scenario to a diagram.
  `world_model` adds the models, and `obstacles` adds the obstacles of primitive shapes.
  `ObstacleMover` moves an obstacle along its trajectory, at the plant's time step.
- `cameras` renders images in a separate scene graph. `DelayedCamera` captures an image every
  period, renders it in a background thread, and outputs it with noise after a delay.
- `LiveCamera` outputs the images of a camera outside the simulation (scenario block
  `perception: !LcmCamera`), with the capture time of each image and the plant state at that time.
  `depth_messages` packs, unpacks and receives depth images as LCM messages.
- `BagCamera` replays the images of a bag of ROS 2 messages (`perception: !RecordedBag`), and
  `ImageRecorder` writes such a bag; both are in `bag_images`.
- `depth_noise` converts a true depth image to the image that a structured-light camera would
  measure (Nguyen, Izadi and Lovell 2012; Khoshelham and Oude Elberink 2012). It simulates steps of
  disparity, axial noise that is smooth over a few pixels, pixels without projected light, flying
  pixels and missing pixels. The noise is a function of seed, time and image, so that runs are
  repeatable.
- `faults` has the systems `WeakActuators` (reduced effort limits) and `ExternalPush` (wrench on a
  link). `DelayedCamera` simulates the fault `CameraDropout` (no new images for some time).

The scenario blocks `obstacles`, `cameras`, `directives` and `faults`, and the field
`perception.noise`, configure this package.

Read `station.make_station` first.
"""
