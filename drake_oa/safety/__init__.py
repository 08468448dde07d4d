"""Safety: slows, holds or stops a motion, and gets the arm out of the way of what moves.

In:  robot_state (2n,) [rad, rad/s], policy_state `PolicyState`; solids_W `SolidScene` (W, [m]),
     motion `PlannedMotion` and demonstration `Demonstration`, where there is a verified motion;
     tracking_error (3,) [m], torque_saturation.
Out: speed_scale in [0, 1] and evasion (3,) [m/s] for `DmpIntegrator`; supervision `Supervision`;
     evading `Evasion` for `PostureFollower`.

Systems
    Supervisor       every step of the policy (8 ms); the least of what its monitors allow
    ObstacleEvasion  every observation (15 Hz), its velocity every step; leaves the motion alone,
                     holds it, turns the arm in its null space, or displaces the tool

Method
    The arm is spheres, what it is kept from are the true shapes. A link is slowed so that it rests
    before it touches: share * c + c_obstacle <= (d - d_stop) / T_reaction for every sphere and
    solid, which is speed and separation monitoring (ISO/TS 15066); what rests beside a verified
    motion is approached as near as braking allows: see `supervision`. Evasion rolls some hundred
    ways of the arm out for about a second, as planning does its candidates, among solids that go
    on at their velocities.

Parts: `guarded_arm` (the arm, and how its joints go with its tool); `supervision` (state and
decision) with `monitors` (what each asks for) and `approach_kernels` (how fast each solid may be
approached); `evasion` (the choice) with `evasion_candidates` (where ways lead) and `lookout` (what
comes of them).

Configuration: `config`, the blocks `supervisor` and `evasion` of a scenario.

Read first: `supervision`, then `evasion`.
"""
