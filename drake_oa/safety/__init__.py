"""Safety: commanded joint motion of the arm, on the verified motion or an evasive maneuver.

In:  robot_state (2m,) [rad, rad/s]; desired motion of the tool; desired_posture (2n,) [rad, rad/s];
     policy_state `PolicyState`; motion `PlannedMotion`; collision_scene_W `CollisionScene` (W,
     [m]); free_space_W `FreeSpace`.
Out: desired_joint_state (2n,) [rad, rad/s] and desired_joint_acceleration (n,) [rad/s^2] for
     `JointInverseDynamics`; speed_scale in [0, 1] and evasion_velocity (3,) [m/s] for
     `DmpIntegrator`; supervision `Supervision`.

System
    MotionGuard   commands in steps of 8 ms; one decision per observation

Method
    While no contact is predicted on the verified motion at full speed, the arm follows it, with the
    tool at the desired pose. Otherwise a decision compares it with slower motions and with evasive
    maneuvers: joint trajectories of two legs over 1.4 s, among obstacles at constant velocity. The
    phase rests during a maneuver. Old observations and saturated torques slow the phase down. A
    contact, detected by the joint error, restarts the command at the measured configuration.

Parts: `motion_guard` (system), `maneuvers` (decision), `joint_motions` (kernels of joint
trajectories), `passive_safety` (claims that limit the speed), `supervision` (speed scale).

Configuration: `config`, the block `guard` of a scenario.

Read first: `maneuvers`, then `motion_guard`.
"""
