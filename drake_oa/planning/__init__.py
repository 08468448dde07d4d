"""Verification: the motion of the whole arm, selected by roll-outs among the collision geometry.

In:  collision_scene_W `CollisionScene` (W, [m, m/s]); policy_state `PolicyState`; goal (3,) [m]; robot_state
     (2m,) [rad, rad/s]; ellipsoids_W `EllipsoidSet`; coupling_parameters `CouplingParameters` and
     route `Route`, the rows of the paper's chain and the sides.
Out: coupling_parameters and route, verified; demonstration `Demonstration`, with which the motion
     is to restart; motion `PlannedMotion` with the arm's joints (T, n) [rad]; shortfall and lowered
     [m]; decision [s]; source and candidates.

Systems
    GroundTruthScene      every observation; the collision geometry of the simulator
    PerceivedScene     every observation; the collision geometry of obstacles_W
    MotionVerifier  every observation (15 Hz); rolls candidates out and selects the shortest one
                    that achieves the requested clearance of tool and links

Method
    The robot is spheres (`robot.spheres`), the world solids that may move (`geometry.collision_scene`). A
    candidate is rolled out by the kernel of DmpIntegrator (`policy.rollout`), becomes joints by
    differential inverse kinematics (D. E. Whitney, 1969) led by a posture, and every sphere is
    measured at its time. Candidates are the nominal motion, the rows of the paper's chain together,
    and those of an evolution strategy. Where none is clear, a path in the joints (RRT-Connect, J.
    J. Kuffner and S. M. LaValle, ICRA 2000) is imitated by the primitives and rolled out like the
    rest. Where nothing is clear, or the goal touches something, the motion is
    held, and a note gives the reason.

Parts, in the order data flows: `ground_truth_scene` and `perceived_scene` (collision geometry); `collision_model`
(clearances of one configuration), `search` (roll-outs of the whole arm on all cores, and the
evolution strategy; `point_search` for a point among ellipsoids), `joint_planner` and `imitation` (a
path in the joints as a demonstration), `motion_search` (the selection), `motion_verifier`.

Configuration: the block `inference` of a scenario, tagged `!Verified`.

Read first: `motion_search`, then `search`.
"""
