"""Methods on synthetic scenes: a point that moves among ellipsoids, as in the paper's experiments.

In: a suite's scenes (`suites`), N at once as arrays (`scenes.Scenes`: meters and m/s,
in the frame of the motion, start at the origin, goal at (baseline, 0, 0)), and methods
(`methods`), each a function of scenes and a setting. Out: `scenes.Motions`, sampled paths and
velocities, which `evaluate_motions` looks at to convergence between the samples, and figures over all of
them (`evaluation`).

    methods        by name: `verified`, the project's, the regressor chain's and more, checked
                   by roll-outs; `movement_primitives`, the package of that name; and
    paper_method   `paper`, the authors' action level with their regressor, and `original`,
                   Hoffmann's term on it (Pairet et al., RA-L 2019; eq. 8 and 7)

`evaluation` runs them batch by batch; it also compares both coupling terms at the same peak and
area, the paper's dead-zone figure. The judge shares no code with the kernels that make the motions
but the nearest point of an ellipsoid.
Read `suites.py` first for what is asked, then `evaluation.py`.
"""
