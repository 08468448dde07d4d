"""The wiring: what joins the layers into a diagram, and the scenarios that come with it.

In: a `Scenario`. Out: a Drake `Diagram` with the simulated station, all layers between its
camera and its torques, and loggers.

The layers, in the order data flows: station, perception, solids, descriptor, inference, route,
verification, policy, posture, safety, control; besides them faults and view. Each has an
`add_<layer>(wires, scenario, station)` that makes the layer's systems from their blocks of the
scenario and adds them to `drake_oa.common.signal_builder.SignalBuilder`, where signals have names, and all is
connected at the end. A layer's own folder knows neither scenario nor station; only these modules
join them.

Signals, with who offers them (`avoidance.Layers` says who reads them):

    robot_state, plant_state, query_object, body_poses     station: the plant
    depth_image, camera_pose, image_stamp                  station: the camera; of several cameras
                                                           with _NAME behind it
    obstacles_W, cloud, views                              perception
    collision_scene_W                                               solids
    ellipsoids_W                                           ellipsoid_descriptor
    proposed_parameters (`!Paper`: coupling_parameters)    regressor_chain
    proposed_route (`!Paper`: route)                       cost_ring_selector
    coupling_parameters, route, motion, demonstration      motion_verifier
    goal, policy_state, phase, desired_*                   goal, dmp_integrator
    desired_posture                                        nominal_posture_source
    desired_joint_state, speed_scale, evasion_velocity              motion_guard
    actuation, tracking_error, torque_saturation           controller

The files `*.scenario.yaml` are the shipped scenarios. Read `avoidance` first.
"""
