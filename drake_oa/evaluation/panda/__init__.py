"""Evaluation of obstacle avoidance methods on a simulated Panda arm in random scenes.

Inputs: kind, seed and number of the scenes, and the methods. Outputs: the result of each method in
each scene (`evaluation.run_and_evaluate`: outcome "success", "contact" or "stopped", reason of a
stop, contacts, clearances [m], goal error [m], times [s]), and metrics over all scenes (`tables`).

A scene is a scenario, the configuration of one simulation (`scenes.draw_panda_scene`). Positions
are in the world frame in meters, times in seconds. Its nominal motion (without avoidance) moves the
tool along a straight line; in most kinds the line is 0.5 to 1.0 m long, and some link of the arm
would collide on it. These modules draw the scenes:

    scenes          draw_panda_scene for all kinds; kinds tabletop and clutter6, with objects on the
                    table; kind elbow, in which only the path of the elbow is blocked
    moving_scenes   kinds moving, moving_hard, moving_high, with objects that cross the motion
    drp_scenes      kinds drp_LEVEL, for example drp_sudden1, with boxes that move or appear by the
                    parameters of a level of the benchmark DRPBench
    scene_parts     obstacles on the table, straight tool motions, and the camera's field of view
    scene_arm       joint motions of the arm along straight tool paths, and distances from the arm
                    to obstacles

The methods (module `evaluation`) are `verified`, which searches motions and verifies them by
simulation of the whole arm; the method of Pairet et al., RA-L 2019; the nominal motion; and two
baselines that know the obstacles exactly:

    differential_ik   Drake's DifferentialInverseKinematicsSystem with collision constraints,
                      evaluated once a period of the movement primitive
    planner           OMPL's RRT-Connect (Kuffner and LaValle, ICRA 2000), or a search in joint
                      space and time if obstacles move; its plans are not simulated

Three modules evaluate finished runs on ground truth: `true_world` models the arm and the true
trajectories of all collision geometry, `contacts` finds the closing speed of each contact and
whether the arm could have avoided it, and `claims` checks the two claims of passive motion safety:
the arm rests or recedes before a moving obstacle can reach it (A), and is slow toward space that no
camera has observed (B). Read `evaluation.py` first.
"""
