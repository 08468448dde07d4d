"""Diagram builders that connect the layers, and the shipped scenarios.

In: a `Scenario`. Out: a Drake `Diagram` with the simulated station (robot, objects and cameras),
all layers from camera images to joint torques, and loggers.

Layers, in the order of the data flow:

- station: simulated plant, scene graph and cameras.
- perception: obstacles as point clouds (obstacles_W).
- collision_scene: collision geometry of the obstacles.
- descriptor: ellipsoids around obstacles dilated by the tool.
- inference: parameters of the coupling terms by neural networks (regressor chain).
- route: side on which each obstacle is passed, by cost rings.
- verification: search for a motion of the whole arm, with simulations (roll-outs).
- policy: movement primitive with coupling terms, which generates the motion of the tool.
- posture: nominal posture, to which the null space of the arm is attracted.
- safety: joint command, speed limits, and maneuvers away from moving obstacles.
- control: joint torques by inverse dynamics.

In addition, faults are simulated, and a view displays the run. A function
`add_<layer>(signals, scenario, station)` creates the systems of a layer from the blocks of the
scenario, and adds these systems to a `SignalBuilder` (`drake_oa.common.signal_builder`). This
builder connects ports by the names of their signals. The packages of the layers import neither
scenarios nor the station; only the modules of `drake_oa.diagrams` do.

Signals and the systems that output them (`avoidance.Layers` lists the inputs of each layer). With
the tag `inference: !Paper` in a scenario, motions are not verified by roll-outs (simulations), and
motion_verifier and motion_guard are absent:

    robot_state, plant_state, query_object, body_poses     station: the plant
    depth_image, camera_pose, image_stamp,                 station: the camera; with the suffix
    plant_state_at_image                                   _NAME for each of several cameras
    obstacles_W, free_space_W, cloud                       perception
    collision_scene_W                                      collision_scene
    ellipsoids_W                                           ellipsoid_descriptor
    proposed_parameters (`!Paper`: coupling_parameters)    regressor_chain
    proposed_route (`!Paper`: route)                       cost_ring_selector
    coupling_parameters, route, motion, demonstration      motion_verifier
    goal, policy_state, phase, desired_*                   goal, dmp_integrator,
                                                           orientation_integrator
    desired_posture                                        nominal_posture_source
                                                           (`!Paper`: guide_follower)
    desired_joint_state, desired_joint_acceleration,       motion_guard
    path_state, speed_scale, evasion_velocity
    tracking_error                                         motion_guard (`!Paper`: controller)
    actuation, torque_saturation, stopping                 controller

cloud is the point cloud that the viewer draws, and free_space_W the space that the cameras
observed to be free. path_state is the state that the robot has on the verified motion at the
present phase; the predictions of motion_verifier start from it. evasion_velocity is the velocity
that moves the desired position to the tool if a maneuver has made no progress toward the verified
motion for 1 s. stopping is 1 while the controller brakes the joints because an input is not finite.

The files `*.scenario.yaml` in the folder of this package are the shipped scenarios.

Read first: `avoidance`.
"""
