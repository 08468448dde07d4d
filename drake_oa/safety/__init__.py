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
     tool of a stuck arm [m/s]. supervision `Supervision`: run, slow, hold or stop, and the reason.

System
    MotionGuard   commands in steps of 8 ms; one decision per observation

Method
    While no contact is predicted on the verified motion at full speed, the arm follows it, with the
    tool at the desired pose. Otherwise a decision compares it with slower motions and with evasive
    maneuvers. A maneuver is a joint trajectory of two legs; in a leg, every joint moves to a target
    and rests there. It is predicted over 1.34 s, among obstacles at constant velocity. The phase of
    the movement primitive rests during a maneuver. Saturated torques, and an observation older than
    `stale_frames` periods (2.5 by default), slow the motion down. A contact, detected by the joint
    error, restarts the command at the measured configuration.

Modules: `motion_guard` (system), `maneuvers` (decision), `joint_motions` (kernels of joint
trajectories), `passive_safety` (limits of the speed toward moving obstacles and unobserved space),
`supervision` (speed scale).

Configuration: `config`, the block `guard` of a scenario.

Read first: `maneuvers`, then `motion_guard`.
"""
