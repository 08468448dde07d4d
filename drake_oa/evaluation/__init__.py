"""Evaluation of avoidance methods on many scenes by independent code.

    scenes/   a point and an ellipsoid, as in Pairet et al., RA-L 2019       evaluate novel, ...
    panda/    the simulated robot in random scenes                           evaluate panda
    mbm/      the simulated robot on motion planning problems of the         evaluate mbm
              data set MotionBenchMaker

    paper_tables   Tables I to III of Pairet et al.                         evaluate table1, ...

Each evaluation draws scenes from a seed (or reads them), runs every method on every scene, and
computes metrics of the motions from ground truth: contacts, minimum clearance [m], achievable
clearance [m] (the requested one, or that of start or goal if it is less), goal error [m] and
duration [s]. `drake-oa evaluate` writes the metrics as JSON and prints them as a table. A seed
gives the same scenes with the same version of this package.

Modules that the three packages share:

    cameras    poses of the depth cameras in evaluated scenes
    results    function calls carried out in this process, or by the package joblib in worker
               processes or on a Dask cluster; results on disk, identified by a digest of call and
               source

Read `panda/evaluation.py` first: an evaluation from its scenes to its results on disk.
"""
