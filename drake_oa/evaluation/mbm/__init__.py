"""Evaluation of the simulated robot on MotionBenchMaker's motion planning problems.

C. Chamzas et al., "MotionBenchMaker: A Tool to Generate and Benchmark Motion Planning Datasets",
RA-L 7(2), 2022. In: an archive (.tar.bz2) of the problems as published in VAMP's repository; it is
not part of this package. Out: the same results and metrics as of `evaluation.panda`, for each set
of problems and for all sets.

    problems   reads a problem from the archive: boxes and cylinders in the world [m], joint
               positions at start and goal [rad]; the problems' robots, Panda and UR5 with gripper
    suite      converts a problem to a scenario: a straight tool motion from start to goal of 5 s in
               the world frame, with a posture from the start's joints to the goal's; makes a suite
               of `evaluation.panda.evaluation` of each set, and defines success

Read `suite.py` first.
"""
