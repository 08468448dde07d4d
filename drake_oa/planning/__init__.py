"""Planning: whole-arm motions, selected by roll-outs among collision geometry.

In:  collision_scene_W `CollisionScene` (W, [m, m/s]); policy_state `PolicyState`; goal (3,) [m];
     robot_state (2m,) [rad, rad/s]; ellipsoids_W `EllipsoidSet`; coupling_parameters
     `CouplingParameters` and route `Route`: rows of the paper's regressor chain, and sides.
Out: coupling_parameters and route, verified; demonstration `Demonstration` for a restart of the
     motion; motion `PlannedMotion` with the arm's joints (T, n) [rad]; shortfall and
     clearance_reduction [m]; decision [s]; source and candidates.

Systems
    GroundTruthScene  every observation; collision scene of the simulator
    PerceivedScene    every observation; collision scene of obstacles_W
    MotionVerifier    every observation (15 Hz); rolls out candidates, and selects the shortest one
                      that achieves the requested clearance of tool and links

Method
    The robot is covered by spheres (`robot.spheres`); the obstacles are collision geometries that
    may move (`geometry.collision_scene`). A candidate is rolled out by the kernel of DmpIntegrator
    (`policy.rollout`). Differential inverse kinematics with a nominal posture (D. E. Whitney, 1969)
    converts it to joint motions, along which the distances of all spheres are computed. Candidates
    are the nominal motion, the rows of the paper's chain together, and those of an evolution
    strategy. If none is feasible, the movement primitives imitate a joint-space path (RRT-Connect,
    J. J. Kuffner and S. M. LaValle, ICRA 2000), which is rolled out like the others. If every
    candidate is predicted to be in contact, the motion is held, and a note gives the reason.

Parts, in the order of the data flow: `ground_truth_scene` and `perceived_scene` (collision scene);
`collision_model` (clearance margins of a configuration); `search` (evolution strategy, roll-outs
of the whole arm on all cores) and `point_search` (the same for a point among ellipsoids);
`joint_planner` and `imitation` (joint-space path as a demonstration); `motion_search` (selection);
`motion_verifier`.

Configuration: the block `inference` of a scenario, tagged `!Verified`.

Read first: `motion_search`, then `search`.
"""
