"""Regulation: the parameters of the coupling terms, and the search among motions that they bend.

In:  ellipsoids_W `EllipsoidSet`, policy_state `PolicyState` (world frame W).
Out: coupling_parameters `CouplingParameters` (alpha in turns a duration T, psi [rad], kappa
     [1/m^2]).

Systems
    RegressorChain  stateless; three networks from the section of each obstacle to its parameters,
                    as the paper has it

`planning.search` rolls motions out and selects the shortest that keeps the feasible clearance, of
the whole arm among true shapes or of a point among ellipsoids; `planning.MotionSelector` is the
system.

Method
    The regressor chain is that of E. Pairet et al., IEEE RA-L 4(4), 2019. The coupling law is scale
    free, so lengths are counted in baselines. Candidates are one avoidance term each: a set network
    (M. Zaheer et al., NeurIPS 2017), which was trained on what the search finds, proposes the
    first, and a plain evolution strategy varies the best of them.

Parts, in the order data flows: `network` (a perceptron, and the file of weights), `regressor` and
`regressor_chain` (the paper's), `proposals` (candidates and their genes), `proposal_network`.

Configuration: the block `regulation` of a scenario, tagged `!Verified` or `!Paper`.

Read first: `regressor`, then `proposals`.
"""
