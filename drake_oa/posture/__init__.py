"""Posture: where the rest of a redundant arm goes while its tool follows a path.

In:  a motion of the tool `PlannedMotion` (W, [m]); the arm's positions (n,) [rad]; obstacles_W
     `ObstacleClouds`, table `TablePlane`, the camera's position (W, [m]); policy_state; evading
     `Evasion`.
Out: the motion with postures (T, n) [rad]; desired_posture (2n,) [rad, rad/s] and
     null_space_acceleration (n,) [rad/s^2] for `CartesianInverseDynamics`.

Systems
    PostureFollower    every step of the policy (8 ms); the planned posture as a smooth course of
                       time
    NullSpaceCoupling  every step; the coupling law on the links' points that are nearest to
                       obstacles (the paper's final remarks); off unless asked for

`posture_planner.WholeArm` is no system: `regulation.VerifiedRegressorChain` asks it along each
motion that it verifies.

Method
    Viterbi's algorithm over a grid of path samples and values of one joint; where no way through
    it is clear, over nodes along the null space itself (J. W. Burdick, IEEE ICRA 1989). Where the
    tool is stuck, a rapidly exploring random tree of straight legs (S. M. LaValle, 1998), each
    with a planned posture.

Parts: `posture_planner` (when to plan anew), `posture_plan` with `plan_kernels` and
`trace_kernels` (the plan), `arm_surroundings` (what is kept clear of), `waypoint_tree` (legs
aside), `posture_course` (a plan over time), `null_space_coupling`.

It is for seven joints: an arm of another number has no planned posture, which a line in the log
says, and one of six no null space for the coupling either, which is refused.

Configuration: the block `robot.posture` (`drake_oa.robot.config.Posture`), and
`posture_plan.PostureParameters`.

Read first: `posture_plan`.
"""
