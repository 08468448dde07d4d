"""Planning: the motion of the whole arm, chosen among the true shapes of things.

In:  solids_W `SolidScene` (W, [m, m/s]); policy_state `PolicyState`; goal (3,) [m]; robot_state
     (2m,) [rad, rad/s]; ellipsoids_W `EllipsoidSet`, by which a network proposes.
Out: coupling_parameters `CouplingParameters`, one term or none; demonstration `Demonstration`,
     where the motion is to begin anew with one; motion `PlannedMotion` with the arm's joints (T, n)
     [rad]; shortfall and lowered [m], decision [s].

Systems
    TrueSolids      every observation; what is in the world, as the simulator knows it
    CloudSolids     every observation; the same as perception sees it, from obstacles_W
    GivenSolids     given ellipsoids as solids
    MotionSelector  every observation (15 Hz); rolls candidates out and takes the shortest that
                    keeps what is asked of tool and links

Method
    The robot is spheres (`robot.spheres`), the world solids that may move (`geometry.solids`). A
    candidate, a motion bent by one coupling term, becomes joints by differential inverse kinematics
    (D. E. Whitney, 1969) led by a posture, and every sphere is measured at its time. Where none
    clears, a path in the joints (RRT-Connect, J. J. Kuffner and S. M. LaValle, ICRA 2000) is
    imitated by the primitives and rolled out like the rest: a plan is one more demonstration.
    Where nothing clears, or the goal touches something, the motion is held, and a note says why.

Parts, in the order data flows: `solid_scene`, `true_solids`, `unseen_ends` and `cloud_solids` (the
world); `arm_world` (what one configuration keeps of it), `rollout` (candidates on all cores),
`sides` and `search` (the coupling family), `joint_planner` and `imitation` (a plan as a
demonstration), `motion_search` (the choice), `motion_selector`.

Configuration: the block `regulation` of a scenario, tagged `!Verified`.

Read first: `motion_search`, then `rollout`.
"""
