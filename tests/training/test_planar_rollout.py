"""The compiled roll-outs against the readable step of the action level."""

from dataclasses import replace
from math import ceil

import numpy as np
import pytest
from scipy.spatial import cKDTree

from drake_oa.training.planar_rollout import (
    forcing_table,
    planar_rollouts,
    released_forcing,
    released_rollouts,
    straight_dmp,
)
from tests.reference.coupling import CouplingTerms
from tests.reference.dmp import step
from tests.reference.released_code import euler_trajectory

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


def reference_path(parameters, center, end=1.0):
    """The same motion in 3-D with `dmp.step` and `CouplingTerms`."""
    dmp = straight_dmp()
    # Only the first dimension of a planar motion is forced.
    dmp = replace(dmp, weights=np.vstack((dmp.weights, np.zeros((2, dmp.centers.size)))))
    terms = CouplingTerms(np.array([[*center, 0.0]]), parameters[None])
    p, z, k, goal = np.zeros(3), np.zeros(3), 1.0, np.array([1.0, 0.0, 0.0])
    path = [p]
    steps = ceil(round(end * STEPS, 9))
    for _ in range(steps):
        p, z, k = step(
            dmp, p, z, k, end / steps, goal, frame=np.eye(3), baseline=1.0, turn=terms.turn
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
    extents, parameters, centers = scenes(24)
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
    assert compared > 8


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
    above, below = (
        planar_rollouts(extents, parameters, centers=centers * (1.0, side)) for side in (1.0, -1.0)
    )
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
    dmp = straight_dmp()
    table = forcing_table(dmp, 10)
    assert table.shape == (10,)
    assert table[3] == pytest.approx(dmp.forcing(float(dmp.phase(0.35)))[0], abs=1e-12)


def test_fading_lets_the_motion_arrive():
    scene = ([[0.1, 0.1]], [[100.0, 1.5, 1.0]])
    centers = [[0.75, 0.0]]
    plain, faded = (planar_rollouts(*scene, centers=centers, fade=fade) for fade in (0.0, 0.4))
    assert not plain.contact[0]
    assert faded.goal_error[0] < 0.1 * plain.goal_error[0]


# --- the released code's motion -------------------------------------------------------


def papers_rows(n, seed=0):
    rng = np.random.default_rng(seed)
    semi_axes = rng.uniform(0.025, 0.25, (n, 2))
    parameters = rng.uniform((0.01, 0.1, 0.0), (30000.0, 1.0, 1000.0), (n, 3))
    # Most rows with a large kappa touch.
    parameters[: n // 2, 2] *= 0.1
    return semi_axes, parameters


def test_released_forcing_is_what_the_released_code_fitted(reference):
    data = np.load(reference("authors_action_level.npz"))
    on_one_metre = np.flatnonzero(data["baseline"] == 1.0)[0]
    table = released_forcing(500, time=2.5)
    np.testing.assert_allclose(table, data["forcing"][on_one_metre, :, 0], atol=2e-4)


def test_released_rollouts_agree_with_the_readable_path():
    semi_axes, parameters = papers_rows(14)
    result = released_rollouts(semi_axes, parameters, between=True)
    forcing = np.column_stack((released_forcing(), np.zeros((1000, 2))))
    compared = 0
    for i, (alpha, psi, kappa) in enumerate(parameters):
        path = euler_trajectory(
            np.array([0.5, 0.0, 0.0]),
            np.array([1.0, 0.0, 0.0]),
            forcing,
            (alpha, psi, kappa),
            tau=np.sqrt(1.0 + 4.0 * semi_axes[i, 1] ** 2) + 0.1,
            step=0.003,
            # Exactly head-on it has no side to turn to.
            start=np.array([0.0, 1e-12, 0.0]),
        )
        inside = (((path[:, :2] - (0.5, 0.0)) / semi_axes[i]) ** 2).sum(axis=1) <= 1.0
        assert inside.any() == result.contact[i]
        if result.contact[i]:
            continue
        steps = np.diff(np.vstack((np.zeros(3), path)), axis=0)
        length = np.linalg.norm(steps, axis=1).sum()
        if kappa < 10.0 and np.linalg.norm(path[-1] - (1.0, 0.0, 0.0)) > 0.02:
            continue  # Turned about all the way, a path amplifies the last bit of a sum.
        compared += 1
        measured = densely_measured(path, semi_axes[i], (0.5, 0.0))
        assert result.clearance[i] == pytest.approx(measured, abs=1e-4)
        assert result.path_length[i] == pytest.approx(length, abs=1e-4)
        assert result.goal_error[i] == pytest.approx(np.linalg.norm(path[-1] - (1, 0, 0)), abs=1e-4)
    assert compared > 3


@pytest.mark.parametrize("end", [0.6, 1.2513])
def test_the_motion_runs_to_the_end_that_is_asked(end):
    extents, parameters, centers = scenes(30, seed=4)
    result = planar_rollouts(extents, parameters, centers=centers, steps=STEPS, end=end)
    compared = 0
    for i in np.flatnonzero(~result.contact):
        path = reference_path(parameters[i], centers[i], end=end)
        goal_error = np.linalg.norm(path[-1] - (1.0, 0.0, 0.0))
        if goal_error > 0.5 or result.path_length[i] > 1.6:
            continue  # A path that circles amplifies the last bit of a sum.
        compared += 1
        length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
        assert result.goal_error[i] == pytest.approx(goal_error, abs=1e-7)
        assert result.path_length[i] == pytest.approx(length, abs=1e-7)
    assert compared > 5


def test_a_longer_motion_keeps_its_shape_and_arrives():
    extents, parameters, centers = scenes(400, seed=6)
    short, long = (
        planar_rollouts(extents, parameters, centers=centers, end=end, fade=0.3)
        for end in (1.0, 1.25)
    )
    calm = (short.goal_error > 2e-3) & (short.goal_error < 0.02)
    assert calm.sum() > 10
    assert (long.goal_error < short.goal_error)[calm].all()
    assert (long.clearance <= short.clearance + 1e-9)[calm].all()


@pytest.mark.parametrize("end", [0.0, -1.0, np.inf, np.nan])
def test_an_end_that_is_none_is_named(end):
    with pytest.raises(ValueError, match="end must be finite and positive"):
        planar_rollouts([[0.1, 0.1]], [[1.0, 1.0, 1.0]], end=end)


def test_a_fade_that_is_none_is_named():
    with pytest.raises(ValueError, match="fade must be finite and not negative"):
        planar_rollouts([[0.1, 0.1]], [[1.0, 1.0, 1.0]], fade=-1.0)


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
    with pytest.raises(ValueError, match="steps must be at least 2"):
        released_rollouts([[0.1, 0.1]], [[1.0, 1.0, 1.0]], steps=1)
