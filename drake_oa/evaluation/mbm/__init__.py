"""MotionBenchMaker's problems on the simulated robot.

C. Chamzas et al., "MotionBenchMaker: A Tool to Generate and Benchmark Motion Planning Datasets",
RA-L 7(2), 2022. In: an archive (.tar.bz2) of the problems, as VAMP's repository carries them;
nothing of it is part of this package. Out: the same results and figures as of `studies.panda`, a
block for each set and one for all.

    problems   the archive, read where it lies; what a problem says: boxes and cylinders in the
               world [m], joints at start and goal [rad]; the Panda, and the UR5 with its gripper
    suite      a problem as a scenario: the tool's straight motion from start to goal, 5 s, in the
               world frame, the posture led from the start's joints to the goal's; a set of problems
               as a suite of `studies.panda.evaluation`, and what success is

Read `suite.py` first.
"""
