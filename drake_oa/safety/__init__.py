"""Safety: the commanded motion of the arm's joints, on the verified motion or away from obstacles.

In:  robot_state (2m,) [rad, rad/s]; the desired motion of the tool; desired_posture (2n,) [rad,
     rad/s]; policy_state `PolicyState`, motion `PlannedMotion`; collision_scene_W `CollisionScene` (W, [m]);
     free_space_W `FreeSpace`.
Out: desired_joint_state (2n,) [rad, rad/s] and desired_joint_acceleration (n,) [rad/s^2] for
     `JointInverseDynamics`; speed_scale in [0, 1] and evasion (3,) [m/s] for `DmpIntegrator`;
     supervision `Supervision`.

System
    MotionGuard   steps of 8 ms; a decision per observation

Method
    While the verified motion at full speed is predicted to be clear, it is followed: the joints
    have the tool at the desired pose. Otherwise it is compared with slower ones and with
    maneuvers, joint motions of two legs over 1.4 s, among obstacles at constant velocity. The
    phase rests during a maneuver. Old observations and saturated torques slow the phase; a joint
    that is pushed from its command resets the command.

Parts: `motion_guard` (system), `maneuvers` (decision), `passive_safety` (speed limited by what was
seen), `joint_motions` (the arm as spheres, kernels), `supervision` (speed of the phase).

Configuration: `config`, the blocks `guard` and `supervisor` of a scenario.

Read first: `maneuvers`, then `motion_guard`.
"""
