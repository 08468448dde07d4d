"""The compiled roll-outs against the readable step of the action level."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from drake_oa.coupling import CouplingTerms
from drake_oa.dmp import step
from drake_oa.rollout import default_dmp, forcing_table, planar_rollouts

STEPS = 200


def scenes(n, seed=0):
    rng = np.random.default_rng(seed)
    extents = rng.uniform(0.02, 0.25, (n, 2))
    parameters = np.column_stack(
        (np.exp(rng.uniform(3, 8, n)), rng.uniform(0.8, 2.2, n), rng.uniform(0.5, 20.0, n))
    )
    centers = np.column_stack((rng.uniform(0.35, 0.65, n), rng.uniform(-0.15, 0.15, n)))
    centers[: n // 3, 1] = 0.0
    return extents, parameters, centers


def reference_path(parameters, center, steps=STEPS):
    """The same motion in 3-D with `dmp.step` and `CouplingTerms`."""
    dmp = default_dmp()
    # Only the first dimension of a planar motion is forced.
    dmp = replace(dmp, weights=np.vstack((dmp.weights, np.zeros((2, dmp.centers.size)))))
    terms = CouplingTerms(np.array([[*center, 0.0]]), parameters[None])
    p, z, k, goal = np.zeros(3), np.zeros(3), 1.0, np.array([1.0, 0.0, 0.0])
    path = [p]
    for _ in range(steps):
        p, z, k = step(
            dmp, p, z, k, 1.0 / steps, goal, frame=np.eye(3), baseline=1.0, turn=terms.turn
        )
        path.append(p)
    return np.array(path)


def densely_measured(path, extents, center):
    """Clearance by brute force: 20 points a step against 20,000 on the ellipse."""
    angle = np.linspace(0.0, 2.0 * np.pi, 20001)
    ellipse = center + extents * np.column_stack((np.cos(angle), np.sin(angle)))
    fractions = np.linspace(0.0, 1.0, 20, endpoint=False)[:, None, None]
    points = path[:-1, :2] + fractions * np.diff(path[:, :2], axis=0)
    points = np.vstack((points.reshape(-1, 2), path[-1:, :2]))
    inside = (((points - center) / extents) ** 2).sum(axis=1) <= 1.0
    return 0.0 if inside.any() else cKDTree(ellipse).query(points)[0].min()


def test_agrees_with_the_readable_step():
    extents, parameters, centers = scenes(40)
    result = planar_rollouts(extents, parameters, centers=centers, steps=STEPS)
    compared = 0
    for i in range(len(extents)):
        path = reference_path(parameters[i], centers[i])
        if result.contact[i]:
            assert densely_measured(path, extents[i], centers[i]) < 2e-3
            continue
        goal_error = np.linalg.norm(path[-1] - (1.0, 0.0, 0.0))
        if goal_error > 0.05:
            continue  # A path that circles amplifies the last bit of a sum.
        compared += 1
        length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
        assert result.goal_error[i] == pytest.approx(goal_error, abs=1e-9)
        assert result.path_length[i] == pytest.approx(length, abs=1e-9)
        measured = densely_measured(path, extents[i], centers[i])
        assert result.clearance[i] == pytest.approx(measured, abs=1e-4)
    assert compared > 15


def test_straight_motion_ends_at_the_goal_when_nothing_acts():
    result = planar_rollouts([[0.05, 0.05]], [[0.0, 1.0, 1.0]], centers=[[0.5, 0.3]])
    assert result.clearance[0] == pytest.approx(0.25, abs=1e-6)
    assert result.path_length[0] == pytest.approx(1.0, abs=1e-3)
    assert result.goal_error[0] < 1e-3


def test_contact_is_reported_as_zero_clearance_and_no_goal():
    result = planar_rollouts([[0.05, 0.05]], [[0.0, 1.0, 1.0]])
    assert result.contact[0]
    assert result.clearance[0] == 0.0
    assert np.isinf(result.goal_error[0])
    assert np.isinf(result.path_length[0])


def test_mirror_image_scenes_have_mirror_image_motions():
    extents, parameters, centers = scenes(30, seed=1)
    centers[:, 1] = np.abs(centers[:, 1]) + 0.01
    above = planar_rollouts(extents, parameters, centers=centers)
    below = planar_rollouts(extents, parameters, centers=centers * (1.0, -1.0))
    calm = above.goal_error < 0.05
    assert calm.sum() > 10
    np.testing.assert_allclose(above.clearance[calm], below.clearance[calm], atol=1e-9)


def test_halving_the_step_changes_the_clearance_by_less_than_a_millimetre_a_metre():
    extents, parameters, _ = scenes(300, seed=2)
    coarse = planar_rollouts(extents, parameters)
    fine = planar_rollouts(extents, parameters, steps=1000)
    kept = (coarse.clearance > 0.01) & (fine.clearance > 0.01) & (coarse.goal_error < 2e-3)
    assert kept.sum() > 30
    change = np.abs(coarse.clearance - fine.clearance)[kept]
    assert np.median(change) < 5e-4
    assert np.quantile(change, 0.9) < 2e-3


def test_forcing_table_is_the_primitives_own_at_the_middles():
    dmp = default_dmp()
    table = forcing_table(dmp, 10)
    assert table.shape == (10,)
    assert table[3] == pytest.approx(dmp.forcing(float(dmp.phase(0.35)))[0], abs=1e-12)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([[0.1, 0.1, 0.1]], [[1.0, 1.0, 1.0]]), r"extents must have the shape \(N, 2\)"),
        (([[0.1, 0.1]], [[1.0, 1.0]]), r"parameters must have the shape \(N, 3\)"),
        (([[0.1, 0.0]], [[1.0, 1.0, 1.0]]), "extents must be positive"),
        (([[0.1, np.nan]], [[1.0, 1.0, 1.0]]), "extents must hold finite"),
        (([[0.1, 0.1]], [[1.0, 0.0, 1.0]]), "psi must be positive"),
        (([[0.1, 0.1]], [[-1.0, 1.0, 1.0]]), "not negative"),
        (([[0.1, 0.1]] * 2, [[1.0, 1.0, 1.0]]), "must have as many"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        planar_rollouts(*arguments)


def test_no_steps_is_an_error():
    with pytest.raises(ValueError, match="steps must be at least 1"):
        planar_rollouts([[0.1, 0.1]], [[1.0, 1.0, 1.0]], steps=0)
