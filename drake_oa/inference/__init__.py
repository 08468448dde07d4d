"""Regulation: the parameters of the coupling terms, by the paper's regressor chain.

In:  ellipsoids_W `EllipsoidSet`, policy_state `PolicyState` (world frame W).
Out: coupling_parameters `CouplingParameters` (alpha in turns a duration T, psi [rad], kappa
     [1/m^2]).

Systems
    RegressorChain  stateless; the chain of three networks from the section of each obstacle to its
                    parameters

`planning.MotionVerifier` verifies the motion of these parameters.

Method
    The regressor chain is that of E. Pairet et al., IEEE RA-L 4(4), 2019. The coupling law is scale
    free, so lengths are counted in baselines.

Parts, in the order data flows: `weights_file` (named arrays), `regressor`, `regressor_chain`.

Configuration: the block `inference` of a scenario, tagged `!Verified` or `!Paper`.

Read first: `regressor`.
"""
