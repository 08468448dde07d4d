"""Evaluation of methods on synthetic scenes: a point and an ellipsoid, as in the paper.

A suite (`suites`) gives N scenes as arrays (`scenes.Scenes`) in meters. In each scene the motion
starts at the origin; the goal is at (baseline, 0, 0), where `baseline` is the distance from start
to goal. A method is a function of scenes and a setting (requested clearance, and whether the
duration is multiplied by the temporal scaling tau). It returns sampled paths and velocities
(`scenes.Motions`). `ground_truth` evaluates the motions, also between the samples, and `evaluation`
computes metrics over all motions.

    methods        `verified`, this project's search among simulated candidate motions, and
                   `movement_primitives`, the package of that name
    paper_method   `paper`, the authors' action level (equations of motion) with their regressor
                   chain, and `original`, Hoffmann's coupling term on that action level
                   (Pairet et al., RA-L 2019; eq. 8 and 7)

`evaluation` runs methods batch by batch. For the paper's dead-zone figure, in which a point-like
obstacle is on or beside the straight line to the goal, it also compares Hoffmann's coupling term
with that of the paper. Both terms then have turning rates of equal peak
and area over the angle to the obstacle. `ground_truth` shares no code with the kernels that compute
the motions, except the distance to an ellipsoid. Read `suites.py` first, then `evaluation.py`.
"""
