"""Tests of the ground-truth model: limits of bang motions, and collisions as of SceneGraph."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drake_oa.evaluation.panda.true_world import STEP, bang_motions, clear_steps, make_true_world
from drake_oa.runs.metrics import clearance_evaluator
from drake_oa.scenario.end_poses import end_positions
from tests.builders import ball_scene


@pytest.fixture(scope="module")
def scenario():
    return ball_scene([0.5, -1.5, 0.5], waypoints=[[0, 0, 0, 0], [2, 0, 3, 0]])


@pytest.fixture(scope="module")
def world(scenario):
    return make_true_world(scenario)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_bang_motions_satisfy_the_limits_and_end_at_rest_at_the_target(world, seed):
    random, chain = np.random.default_rng(seed), world.arm.chain
    q, v = random.uniform(chain.lower, chain.upper), random.uniform(-1.0, 1.0, 7) * chain.speed
    legs = random.uniform(chain.lower, chain.upper, (4, 2, 7))
    switch = random.integers(0, 100, 4)
    motions = bang_motions(world, q, v, legs, switch, 600)
    assert np.array_equal(motions[:, 0], np.tile(q, (4, 1)))
    # Velocities at the steps, from the mean velocity of each step.
    speeds = [np.tile(v, (4, 1))]
    for mean in np.moveaxis(np.diff(motions, axis=1) / STEP, 1, 0):
        speeds.append(2.0 * mean - speeds[-1])
    speeds = np.array(speeds)
    assert (np.abs(speeds) <= chain.speed + 1e-6).all()
    assert (np.abs(np.diff(speeds, axis=0)) <= world.acceleration * STEP + 1e-6).all()
    assert np.abs(motions[:, -1] - legs[:, 1]).max() < 1e-5
    assert np.abs(motions[:, -1] - motions[:, -2]).max() < 1e-6


def test_resting_arm_is_clear_until_the_obstacle_arrives(scenario, world):
    evaluator, (q, _) = clearance_evaluator(scenario), end_positions(scenario)
    count = len(world.ball)
    stay = np.tile(q[world.arm.chain.q_index], (1, count, 1))
    clear = int(clear_steps(world, stay, np.zeros(1, dtype=np.int64))[0])
    touched = [
        row
        for row in range(count)
        if evaluator.contact_speeds(q, np.zeros(len(q)), evaluator.positions_at(STEP * row))[0]
    ]
    assert 0 < clear < count
    # The spheres protrude by 5 mm, which the obstacle travels in 4 ms.
    assert clear <= touched[0] <= clear + 3
    later = np.array([touched[0] - 10])
    assert clear_steps(world, stay, later)[0] == clear - later[0]
