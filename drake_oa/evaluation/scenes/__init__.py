"""Evaluation of methods on synthetic scenes: a point and an ellipsoid, as in the paper.

In: the scenes of a suite (`suites`), N at once as arrays (`scenes.Scenes`: meters, in the frame of
the motion, start at the origin, goal at (baseline, 0, 0), with the distance `baseline`), and
methods (`methods`), each a function of scenes and a setting (requested clearance, and whether the
duration is scaled). Out: `scenes.Motions`, sampled paths and velocities; their evaluation on ground
truth between the samples (`ground_truth`), and metrics over all motions (`evaluation`).

    methods        `verified`, this project's search among simulated candidate motions, and
                   `movement_primitives`, the package of that name
    paper_method   `paper`, the authors' action level (equations of motion) with their regressor
                   chain, and `original`, Hoffmann's coupling term on that action level
                   (Pairet et al., RA-L 2019; eq. 8 and 7)

`evaluation` runs methods batch by batch. It also compares Hoffmann's coupling term and that of the
paper at equal peak and area of the turning rate: the paper's dead-zone figure. `ground_truth`
shares no code with the kernels that compute the motions, except the distance to an ellipsoid. Read
`suites.py` first, then `evaluation.py`.
"""
