"""Inference layer: computes the parameters of coupling terms by a regressor chain.

A coupling term is a turning rate that steers the motion away from one obstacle.

In:  ellipsoids_W `EllipsoidSet`, policy_state `PolicyState` (world frame W).
Out: coupling_parameters `CouplingParameters` (alpha [1/T] with the demonstrated duration T,
     psi [rad], kappa [1/m^2]).

Systems
    RegressorChain  stateless; three chained networks map the section of each obstacle by the
                    plane of motion to the parameters of a coupling term

`planning.MotionVerifier` verifies the motion of these parameters by roll-out (simulation).

Method
    The regressor chain is that of E. Pairet et al., IEEE RA-L 4(4), 2019. The coupling term is
    scale invariant, so lengths are divided by the baseline (distance from start to goal).

Modules, in the order of the data flow: `weights_file` (named arrays), `regressor`,
`regressor_chain`.

Configuration: the block `inference` of a scenario, tagged `!Verified` or `!Paper`.

Read first: `regressor`.
"""
