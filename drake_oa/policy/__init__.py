"""Policy layer: a dynamic movement primitive (DMP) whose coupling terms steer around obstacles.

In: goal (3,) in the world frame [m]; optional `EllipsoidSet` (obstacles), `CouplingParameters`
(parameters of the coupling terms), `Route` (side on which each obstacle is passed), and from
`MotionGuard`, the system that slows the motion and evades moving obstacles, a speed scale in [0, 1]
and an evasion velocity (3,) [m/s]. Out: desired position [m], velocity [m/s] and acceleration
[m/s^2] (3,) of the tool point E in the world, the phase k and `PolicyState` (position, phase and
velocity with respect to normalized time); for the orientation the quaternion of R_WE, the angular
velocity w_WE [rad/s] and the angular acceleration [rad/s^2].

Systems, updated each `policy.period` (125 Hz by default):

- `DmpIntegrator`: position of the tool point. Between two steps the velocity is linear in time.
- `OrientationIntegrator`: orientation of the tool, a function of the phase k of `DmpIntegrator`.

Normalized time is s = t / (tau T), with the demonstrated duration T and the temporal scaling tau.
With the position x, the scaled velocity z = dx/ds, the goal g and the phase k, the equations are

    dz/ds = alpha_x (beta_x (g - x) - z) + f(k) + C,    dx/ds = z,    dk/ds = -alpha_k k.

These are the dynamic movement primitives of Ijspeert et al. (2013) in the form of Pairet et al.
(RA-L 2019). f is the forcing term, learned from a demonstration. The coupling term
C = Omega x z avoids obstacles: it rotates z at the rate Omega and leaves its length unchanged. A
step consists of half a step of the spring (the first two equations without C), the rotation, and
the other half step of the spring. The half steps of the spring are exact for a constant f. The
rotation by a coupling term that acts alone is exact, too; that of the avoidance term is
approximated within 2.5 % (docs/theory/integration.md).

Modules:

- `averaging`: mean of several recorded demonstrations, by a penalized spline.
- `dmp`, `coupling`, `guidance`: movement primitive, coupling terms, and heading toward the side on
  which an obstacle is passed. Tests compare the compiled formulas with readable ones in
  `tests/reference`.
- `action_kernels`, `action`: one step of the whole policy, with temporal scaling and holds, which
  stop the motion on its path.
- `rollout`: roll-outs (simulations) of many candidate motions.

The configuration is the block `policy` of a scenario (`config.Policy`).

Read first: `action.take_step`, then `dmp_integrator`.
"""
