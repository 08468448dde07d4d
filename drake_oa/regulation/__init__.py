"""Regulation: the parameters of the coupling terms, and the turn of the tool.

In:  ellipsoids_W `EllipsoidSet`, or route `Route`; policy_state `PolicyState`; goal (3,) [m]; table
     `TablePlane`; for the posture of the arm robot_state (2m,) [rad, rad/s], obstacles_W
     `ObstacleClouds` and camera_pose. All in the world frame W.
Out: coupling_parameters `CouplingParameters` (alpha in turns a duration T, psi [rad], kappa
     [1/m^2]), motion `PlannedMotion`, shortfall and lowered [m], decision [s].

Systems
    RegressorChain          stateless; three networks from the section of each obstacle to its
                            parameters, as the paper has it
    VerifiedRegressorChain  every observation (15 Hz); rolls candidates out and takes the shortest
                            motion that keeps the feasible clearance; with an arm, one that the
                            arm can follow
    ToolTurnSelector        every observation; how far the tool is turned to pass

Method
    The regressor chain is that of E. Pairet et al., IEEE RA-L 4(4), 2019. The coupling law is scale
    free, so lengths are counted in baselines. Candidates are one avoidance term each; a plain
    evolution strategy varies the best of them. Rows of one scene are rolled out many at a time by
    loops over vectors.

Parts, in the order data flows: `regressor` (networks and their file), `proposals` (candidates and
their genes), `rollout` with `rollout_kernels` and `lane_math` (the motions), `search` (the
choice), `regulator` with its state `regulation` (from one observation to the next),
`regulated_arm` (what the arm can follow), `tool_turn`.

Configuration: the block `regulation` of a scenario, tagged `!Verified` or `!Regressor`.

Read first: `search`, then `regulator`.
"""
