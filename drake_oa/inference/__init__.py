"""Inference layer: computes the parameters of coupling terms by a regressor chain.

A coupling term is a turning rate that steers the motion away from one obstacle.

In:  ellipsoids_W `EllipsoidSet`, policy_state `PolicyState` (world frame W).
Out: coupling_parameters `CouplingParameters` (alpha [1/T] with the demonstrated duration T,
     psi [rad], kappa [1/m^2]).

Systems
    RegressorChain  stateless; three networks in sequence map the section of each obstacle to the
                    parameters of a coupling term; the plane of the section is spanned by the
                    tool's velocity and the direction from the tool to the obstacle's center

`planning.MotionVerifier` verifies the motion with these parameters by roll-out (simulation).

Method
    The regressor chain is that of E. Pairet et al., IEEE RA-L 4(4), 2019. The coupling term is
    scale invariant, so lengths are divided by the baseline (distance from start to goal).

Modules, in the order of the data flow: `weights_file` (named arrays), `regressor`,
`regressor_chain`.

Configuration: the block `inference` of a scenario, tagged `!Verified` or `!Paper`.

Read first: `regressor`.
"""
