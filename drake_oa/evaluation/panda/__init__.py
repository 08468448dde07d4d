"""Methods on the simulated Panda, in random scenes that stand in the way of a planned motion.

In: a kind of scenes, a seed, how many, and methods. Out: for each method and scene a judged run
(`evaluation.run_and_evaluate`: outcome, reason, contacts, clearances [m], goal error [m], times [s]),
and figures over all (`tables`).

A scene is a scenario (`scenes.draw_panda_scene`), in the world frame, meters and seconds, whose
straight tool motion of 0.5 to 1.0 m some link would make into an obstacle:

    scenes          tabletop, clutter6: things on the table; elbow: the hand's way is free and the
                    elbow's is not
    moving_scenes   moving, moving_hard: things that cross the way, or do as they like
    scene_parts     obstacles on the table, motions, and what a camera sees
    scene_arm       the arm's straight motions, and its distances to obstacles

Methods (`evaluation`): the project's, the paper's, the motion without avoidance, and two baselines that
know the obstacles exactly:

    differential_ik   Drake's DifferentialInverseKinematicsSystem with collision constraints at the
                      policy's period; ProgramInputs gives it the pose a moment ahead
    planner           OMPL's RRT-Connect (Kuffner and LaValle, ICRA 2000), not simulated

There is no block in the scenario: a study writes scenarios. Read `evaluation.py` first.
"""
