"""Evaluation of the simulated robot on MotionBenchMaker's motion planning problems.

The problems are those of C. Chamzas et al., "MotionBenchMaker: A Tool to Generate and Benchmark
Motion Planning Datasets", RA-L 7(2), 2022. Input: an archive (.tar.bz2) of problems as published in
the repository of VAMP, a motion planning library; it is not part of this package. Output, as in
`evaluation.panda`: the result of each run (success, contacts, clearances [m], duration [s]), and
metrics over the runs of each set of problems and of all sets.

    problems   reads a problem from the archive: boxes and cylinders in the world [m], joint
               positions at start and goal [rad]; the problems' robots, Panda and UR5 with gripper
    suite      converts a problem to a scenario with a straight tool motion of 5 s from start to
               goal; makes a suite (scenes, methods and conditions of success) of each set of
               problems

Read `suite.py` first.
"""
