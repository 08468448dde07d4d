"""Safety layer: joint commands of the arm, along the verified motion or on an evasive maneuver.

The verified motion is the joint motion q(s) that MotionVerifier predicted and checked by
simulation. Normalized time s is time divided by tau T, with the temporal scaling tau and the
demonstrated duration T. The robot has m joints, and its arm n joints.

In:  robot_state (2m,) [rad, m, rad/s, m/s]; desired motion of the tool; desired_posture (2n,)
     [rad, rad/s]; policy_state `PolicyState`; motion `PlannedMotion`, the verified motion;
     collision_scene_W `CollisionScene` in the world W [m]; free_space_W `FreeSpace`.
Out: desired_joint_state (2n,) [rad, rad/s] and desired_joint_acceleration (n,) [rad/s^2] for
     `JointInverseDynamics`. For `DmpIntegrator`: speed_scale, the fraction of full speed in [0, 1],
     and evasion_velocity (3,), the velocity in the world that moves the desired position to the
     tool of a stuck arm [m/s]. An arm is stuck after 1 s without progress toward the verified
     motion. supervision `Supervision`: run, slow, hold (rest until the cause ends) or stop (rest,
     as the cause is not expected to end), and the reason.

System
    MotionGuard   commands in steps of 8 ms; one decision per observation

Method
    The arm follows the verified motion at full speed, with the tool at the desired pose, while
    neither contact, nor proximity to moving obstacles, nor a violation of passive motion safety is
    predicted. Otherwise a decision compares this motion at several speeds and, if obstacles move,
    evasive maneuvers. A maneuver is a joint trajectory of two legs; in a leg, every joint moves to
    a target and rests there. Trajectories are predicted over 1.34 s, among obstacles
    at constant velocity. During a maneuver, normalized time s does not advance. Saturated torques,
    and an observation older than `stale_frames` periods (2.5 by default), slow the motion down. A
    contact is detected by the joint error. The guard then commands the arm to rest at its measured
    configuration.

Modules: `motion_guard` (system), `maneuvers` (decision), `joint_motions` (kernels of joint
trajectories), `passive_safety` (limits of the speed toward moving obstacles and unobserved space),
`supervision` (speed scale).

Configuration: `config`, the block `guard` of a scenario.

Read first: `maneuvers`, then `motion_guard`.
"""
