"""The action level: a movement primitive whose motion coupling terms bend round obstacles.

In: goal (3,) [m], `EllipsoidSet`, `CouplingParameters`, `Route`, the motion guard's speed scale and
displacement velocity (3,) [m/s], all but the goal optional. Out: desired position, velocity and
acceleration (3,) of the tool point E in the world, the phase k and `PolicyState`; for the
orientation a quaternion R_WE, w_WE [rad/s] and its derivative.

Systems, at `policy.period` (125 Hz by default):

- `DmpIntegrator`: the position. Between two steps velocity is linear in time.
- `OrientationIntegrator`: the tool's orientation on the same phase, and its turn about an axis.

In normalized time s = t / (tau T)

    dz/ds = alpha_x (beta_x (g - x) - z) + f(k) + C,    dx/ds = z,    dk/ds = -alpha_k k,

the dynamic movement primitives of Ijspeert et al. (2013) in the form of Pairet et al. (RA-L 2019),
with the coupling term C = Omega x z, which turns z and pushes nothing. A step is half a step of
the spring, the turn, and the spring's other half, each an exact flow (docs/equations.md).

- `averaging`: recordings of one motion as one, which is imitated (locally weighted regression).
- `dmp`, `coupling`, `guidance`: primitive, turning terms, heading to the chosen side; each formula
  has one compiled form, which `tests/reference` holds to account.
- `action_kernels`, `action`: one step of all of it, with holds and temporal scaling.

The configuration is the block `policy` of a scenario (`config.Policy`).

Begin with `action_kernels.take_step`, then `dmp_integrator`.
"""
