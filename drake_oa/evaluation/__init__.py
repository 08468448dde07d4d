"""Experiments: methods on many scenes, judged by independent code.

    scenes/   a point among ellipsoids: the paper's experiments and beyond   evaluate novel, ...
    panda/    the simulated robot in random scenes                           evaluate panda
    mbm/      the robot on MotionBenchMaker's problems                       evaluate mbm

    paper_tables   the paper's Tables I to III                              evaluate table1, ...

Each draws scenes from a seed (or reads them), runs every method on every scene, and judges the
motions: contacts, clearances [m], what start and goal leave of the requested clearance, goal errors
[m], durations [s]. The outcome is plain data, which `drake-oa evaluate` writes as JSON and prints
as a table. A seed gives the same scenes with the same version of this package.

What the three share:

    cameras    where depth cameras stand that are not a shipped scenario's
    results    calls carried out here, in processes or on a Dask cluster (joblib), with results on
               disk by a digest of all that they follow from

Read `panda/evaluation.py` first: an evaluation from its scenes to its results on disk.
"""
