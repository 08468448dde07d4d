"""Regulation: the parameters of the coupling terms, by two networks.

In:  ellipsoids_W `EllipsoidSet`, policy_state `PolicyState` (world frame W).
Out: coupling_parameters `CouplingParameters` (alpha in turns a duration T, psi [rad], kappa
     [1/m^2]).

Systems
    RegressorChain  stateless; the paper's chain of three networks from the section of each obstacle
                    to its parameters, and a set network from all obstacles to a candidate motion on
                    each side of the baseline

`route.CostRingSelector` ranks the sides; `planning.MotionVerifier` verifies the proposals.

Method
    The regressor chain is that of E. Pairet et al., IEEE RA-L 4(4), 2019. The coupling law is scale
    free, so lengths are counted in baselines. Candidates of a side are one avoidance
    term each, by a set network (M. Zaheer et al., NeurIPS 2017) that is trained on results of the
    search.

Parts, in the order data flows: `weights_file` (named arrays), `regressor` and
`regressor_chain` (the paper's), `proposals` (candidates, their genes and the proposal network).

Configuration: the block `regulation` of a scenario, tagged `!Verified` or `!Paper`.

Read first: `regressor`, then `proposals`.
"""
