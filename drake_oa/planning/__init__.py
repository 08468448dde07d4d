"""Planning layer: selects whole-arm motions by roll-outs (simulations) among collision geometry.

In:  collision_scene_W `CollisionScene`, all collision geometry but the robot, in the world frame W;
     policy_state `PolicyState`, state of the movement primitive; goal (3,) of the tool in W [m];
     robot_state (2m,), positions and velocities of all m joints [rad, m, rad/s, m/s];
     ellipsoids_W `EllipsoidSet`, the obstacles dilated by the tool; coupling_parameters
     `CouplingParameters` of the regressor chain; route `Route`, the side on which the cost rings
     pass each obstacle.
Out: coupling_parameters and route of the selected motion; demonstration `Demonstration`, which the
     motion imitates after a restart from rest; motion `PlannedMotion`, the predicted motion of the
     tool and of the arm's n joints (T, n) [rad]; shortfall, by which the motion falls below the
     required clearance [m]; clearance_reduction, by which the required clearance is below the
     requested one, because start or goal is near an obstacle [m]; decision, the start time and the
     compute latency of the last decision [s]; source, the kind of the selected candidate;
     candidates, the number of candidates of each kind; sides `Route`, the costs of the passing
     sides, for a viewer.

Systems
    GroundTruthScene  collision scene (collision geometry without the robot) of the simulator
    PerceivedScene    collision scene of the perceived obstacles obstacles_W
    MotionVerifier    rolls out candidates, and selects the shortest one that achieves the
                      requested clearance of tool and links

    All of them are updated with every observation.

Method
    Spheres cover the robot (`robot.spheres`), and the obstacles are collision geometries that may
    move (`geometry.collision_scene`). The kernel of DmpIntegrator rolls out candidates
    (`policy.rollout`). Differential inverse kinematics with a nominal posture (D. E. Whitney, 1969)
    converts them to joint motions, along which the distances of all spheres are computed.
    Candidates are the nominal (demonstrated) motion, a motion with the coupling terms (turning
    rates) of the regressor chain of Pairet et al., RA-L 2019, and motions of an evolution strategy.
    If none is feasible (achieves the required clearance, reaches the goal, and can be followed by
    the arm), and the arm is at rest, the movement primitives imitate a joint-space path
    (RRT-Connect, J. J. Kuffner and S. M. LaValle, ICRA 2000), which is rolled out like the others.
    If the selected candidate is predicted to be in contact or to miss the goal, or if the arm
    cannot follow it, the motion is held (stopped on its path), and a note gives the reason.

Modules, in the order of the data flow: `ground_truth_scene` and `perceived_scene` (collision
scene); `collision_model` (distances minus required clearances of a configuration); `search`
(evolution strategy, roll-outs of the whole arm on all cores) and `point_search` (evolution strategy
for a point among ellipsoids); `joint_planner` and `imitation` (joint-space path as a
demonstration); `motion_search` (selection); `motion_verifier`.

Configuration: the block `inference` of a scenario, tagged `!Verified`.

Read first: `motion_search`, then `search`.
"""
