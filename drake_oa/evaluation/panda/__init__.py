"""Evaluation of avoidance methods on the simulated Panda in random scenes.

In: kind, seed and number of the scenes, and methods. Out: the result of each method in each scene
(`evaluation.run_and_evaluate`: outcome, reason, contacts, clearances [m], goal error [m], times
[s]), and metrics over all scenes (`tables`).

A scene is a scenario (`scenes.draw_panda_scene`) in the world frame, in meters and seconds. Its
nominal motion is a straight tool motion of 0.5 to 1.0 m, on which some link would collide:

    scenes          tabletop, clutter6: objects on the table; elbow: the hand's path is free and the
                    elbow's is blocked; drawing of all kinds
    moving_scenes   moving, moving_hard, moving_high: objects that cross the nominal motion
    drp_scenes      boxes by the parameters of the benchmark DRPBench
    scene_parts     obstacles on the table, straight motions, and the camera's field of view
    scene_arm       the arm's straight motions, and its distances to obstacles

Methods (`evaluation`): `verified`, the paper's method, the nominal motion without avoidance, and
two baselines that know the obstacles exactly:

    differential_ik   Drake's DifferentialInverseKinematicsSystem with collision constraints at the
                      policy's period; `CommandedJoints` has its inputs
    planner           OMPL's RRT-Connect (Kuffner and LaValle, ICRA 2000), not simulated

Ground truth of finished runs: `true_world` (arm and collision geometry), `contacts` (causes of
contacts) and `claims` (passive motion safety). Read `evaluation.py` first.
"""
