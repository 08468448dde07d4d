"""Motions of the training set: what the engine is asked, against the readable step."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from drake_oa.training.rollouts import planar_rollouts, straight_dmp
from tests.reference.coupling import terms, turning
from tests.reference.dmp import step

STEPS = 200
DMP = straight_dmp(48.0)


def scenes(n, seed=0):
    rng = np.random.default_rng(seed)
    extents = rng.uniform(0.02, 0.25, (n, 2))
    parameters = np.column_stack(
        (np.exp(rng.uniform(3, 8, n)), rng.uniform(0.8, 2.2, n), rng.uniform(0.5, 20.0, n))
    )
    centers = np.column_stack((rng.uniform(0.35, 0.65, n), rng.uniform(-0.15, 0.15, n)))
    centers[: n // 3, 1] = 0.0
    return extents, centers, parameters[:, None]


def readable_path(parameters, center):
    turn = turning(terms([*center, 0.0], parameters))
    p, z, k, goal = np.zeros(3), np.zeros(3), 1.0, np.array([1.0, 0.0, 0.0])
    path = [p]
    for _ in range(STEPS):
        p, z, k = step(DMP, p, z, k, 1.0 / STEPS, goal, frame=np.eye(3), baseline=1.0, turn=turn)
        path.append(p)
    return np.array(path)


def densely_measured(path, extents, center):
    """Clearance by brute force: the samples against 20,000 points on the ellipse."""
    angle = np.linspace(0.0, 2.0 * np.pi, 20001)
    ellipse = center + extents * np.column_stack((np.cos(angle), np.sin(angle)))
    inside = (((path[:, :2] - center) / extents) ** 2).sum(axis=1) <= 1.0
    return 0.0 if inside.any() else cKDTree(ellipse).query(path[:, :2])[0].min()


def test_agrees_with_the_readable_step():
    extents, centers, parameters = scenes(16)
    found = planar_rollouts(extents, centers, parameters, dmp=DMP, steps=STEPS)
    compared = 0
    for i in range(len(extents)):
        path = readable_path(parameters[i], centers[i])
        measured = densely_measured(path, extents[i], centers[i])
        assert found.contact[i, 0] == (measured == 0.0)
        goal_error = np.linalg.norm(path[-1] - (1.0, 0.0, 0.0))
        if found.contact[i, 0] or goal_error > 0.05:
            continue  # A path that circles amplifies the last bit of a sum.
        compared += 1
        assert found.goal_error[i, 0] == pytest.approx(goal_error, abs=1e-7)
        assert found.clearance[i, 0] == pytest.approx(measured, abs=1e-4)
    assert compared > 5


def test_contact_is_zero_clearance_and_no_goal():
    found = planar_rollouts(
        np.array([[0.05, 0.05]]), np.array([[0.5, 0.0]]), np.array([[[0.0, 1.0, 1.0]]]), dmp=DMP
    )
    assert found.contact.all()
    assert (found.clearance == 0.0).all()
    assert np.isinf(found.goal_error).all()


def test_several_parameters_a_scene_are_as_many_scenes():
    extents, centers, parameters = scenes(6, seed=1)
    grid = np.tile(parameters[:, 0], (6, 1, 1))
    together = planar_rollouts(extents, centers, grid, dmp=DMP, steps=100)
    alone = planar_rollouts(
        np.repeat(extents, 6, axis=0),
        np.repeat(centers, 6, axis=0),
        grid.reshape(36, 1, 3),
        dmp=DMP,
        steps=100,
    )
    assert together.clearance.shape == (6, 6)
    np.testing.assert_allclose(together.clearance.ravel(), alone.clearance[:, 0], atol=1e-5)
