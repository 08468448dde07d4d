"""Verified regulation: what is chosen keeps the clearance, by measures of our own."""

from dataclasses import replace

import numpy as np
import pytest

from drake_oa.geometry.ellipsoid import signed_distance
from drake_oa.policy.coupling import ALPHA as ALPHA_COLUMN
from drake_oa.policy.coupling import NORMAL
from drake_oa.regulation.config import SearchParameters
from drake_oa.regulation.proposals import ANGLE, N_GENES, Proposer, avoidance_terms
from drake_oa.regulation.rollout import SpatialScenes, spatial_rollouts
from drake_oa.regulation.search import SearchResult, verify

DURATION = 3.0
QUICK = SearchParameters(rounds=20)


def scenes(
    center: list[list[float]],
    semi_axes: float | list[float] = 0.08,
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    clearance: float = 0.1,
) -> SpatialScenes:
    """One scene, 1 m along x, with an axis-aligned ellipsoid at each centre."""
    count = len(center)
    axes = np.broadcast_to(semi_axes, (count, 3))
    return SpatialScenes(
        p_WE=np.zeros((1, 3)),
        z_W=np.zeros((1, 3)),
        p_WG=np.array([[1.0, 0.0, 0.0]]),
        R_WL=np.eye(3)[None],
        baseline=np.ones(1),
        p_WO=np.array(center).reshape(1, count, 3),
        R_WO=np.tile(np.eye(3), (1, count, 1, 1)),
        semi_axes=np.array(axes)[None],
        v_WO=np.tile(velocity, (1, count, 1)),
        asked_clearance=np.full((1, count), clearance),
    )


def followed(posed: SpatialScenes, found: SearchResult) -> tuple[np.ndarray, np.ndarray]:
    """Path (n, 3) and stamps (n,) of the motion that was chosen."""
    rolled = spatial_rollouts(
        posed,
        [0],
        found.terms,
        seconds=DURATION * found.tau,
        steps=QUICK.steps,
        horizon=2.0,
        fade=QUICK.fade,
        tolerance=QUICK.tolerance,
        keep_path=True,
    )
    count = int(rolled.steps[0]) + 1
    stamps = np.arange(count) / QUICK.steps * DURATION * found.tau[0]
    return rolled.path[0, :count], stamps


def least_distance(posed: SpatialScenes, path: np.ndarray, stamps: np.ndarray) -> float:
    return min(
        float(
            signed_distance(
                path - stamps[:, None] * posed.v_WO[0, j],
                posed.p_WO[0, j],
                posed.R_WO[0, j],
                posed.semi_axes[0, j],
            ).min()
        )
        for j in range(posed.p_WO.shape[1])
    )


@pytest.mark.parametrize(
    ("center", "semi_axes"),
    [
        ([[0.5, 0.0, 0.0]], 0.08),
        ([[0.5, 0.0, 0.0]], [0.05, 0.2, 0.25]),
        ([[0.4, 0.05, 0.02], [0.7, -0.06, 0.0]], 0.06),
        ([[0.8, 0.01, 0.0]], 0.06),
        ([[0.2, 0.0, 0.03]], 0.07),
    ],
)
def test_the_asked_clearance_is_kept_and_not_much_more(
    proposer: Proposer, center: list[list[float]], semi_axes: float | list[float]
) -> None:
    posed = scenes(center, semi_axes)
    found = verify(posed, proposer, duration=DURATION, parameters=QUICK)
    assert found.kept.all()
    assert found.shortfall == 0.0
    path, stamps = followed(posed, found)
    assert 0.0995 <= least_distance(posed, path, stamps) <= 0.11
    assert np.linalg.norm(path[-1] - posed.p_WG[0]) <= 7e-4
    assert found.kept_clearance == pytest.approx(least_distance(posed, path, stamps), abs=1e-4)


def test_nothing_is_done_where_nothing_is_in_the_way(proposer: Proposer) -> None:
    found = verify(scenes([[0.5, 0.3, 0.0]]), proposer, duration=DURATION)
    assert found.kept
    assert found.terms[0, ALPHA_COLUMN] == 0.0
    assert found.tau == pytest.approx(1.0, abs=1e-4)
    assert found.in_range


def test_a_moving_obstacle_is_met_where_it_will_be(proposer: Proposer) -> None:
    # It crosses the baseline's middle at t = 1.5 s, and is far from it now.
    posed = scenes([[0.5, 0.45, 0.0]], velocity=(0.0, -0.3, 0.0))
    still = replace(posed, v_WO=np.zeros((1, 1, 3)))
    assert verify(still, proposer, duration=DURATION).terms[0, ALPHA_COLUMN] == 0.0
    found = verify(posed, proposer, duration=DURATION, parameters=QUICK)
    assert found.kept
    path, stamps = followed(posed, found)
    assert least_distance(posed, path, stamps) >= 0.0995


def test_a_clearance_that_cannot_be_kept_is_reported(proposer: Proposer) -> None:
    # Walls all around, and 0.1 m asked in a gap of 0.12 m.
    posed = scenes([[0.5, 3.06, 0.0], [0.5, -3.06, 0.0]], [0.2, 3.0, 50.0])
    found = verify(posed, proposer, duration=DURATION, parameters=QUICK)
    assert not found.kept
    assert 0.03 < found.shortfall < 0.06
    assert found.kept_clearance == pytest.approx(0.1 - found.shortfall, abs=1e-3)


def test_the_choice_does_not_depend_on_the_company(proposer: Proposer) -> None:
    alone = scenes([[0.5, 0.02, 0.0]])
    other = scenes([[0.6, 0.0, -0.05]], 0.12)
    both = SpatialScenes(
        **{
            name: np.concatenate([getattr(other, name), getattr(alone, name)])
            for name in (
                *("p_WE", "z_W", "p_WG", "R_WL", "baseline"),
                *("p_WO", "R_WO", "semi_axes", "v_WO", "asked_clearance"),
            )
        }
    )
    first = verify(alone, proposer, duration=DURATION)
    second = verify(both, proposer, duration=DURATION)
    np.testing.assert_array_equal(first.genes[0], second.genes[1])
    np.testing.assert_array_equal(first.terms, verify(alone, proposer, duration=DURATION).terms)


def test_it_goes_on_from_the_middle_of_a_motion(proposer: Proposer) -> None:
    posed = scenes([[0.6, 0.0, 0.0]])
    found = verify(posed, proposer, duration=DURATION)
    first = spatial_rollouts(posed, [0], found.terms, fade=0.3, keep_path=True)
    half = replace(posed, p_WE=first.path[:, 200], z_W=first.velocity[:, 200], s=0.4)
    again = verify(half, proposer, duration=DURATION)
    assert again.kept
    rest = spatial_rollouts(half, [0], again.terms, fade=0.3, horizon=2.0, keep_path=True)
    path = rest.path[0][: int(rest.steps[0]) + 1]
    assert signed_distance(path, [0.6, 0.0, 0.0], np.eye(3), [0.08] * 3).min() >= 0.0995


def test_a_turn_about_the_normal_goes_to_the_side() -> None:
    genes = np.zeros((1, N_GENES))
    genes[0, ANGLE] = 0.3
    terms = avoidance_terms(scenes([[0.5, 0.0, 0.0]]), np.zeros(1, dtype=np.int64), genes)
    omega = np.cross(terms[0, NORMAL : NORMAL + 3], [1.0, 0.0, 0.0])
    np.testing.assert_allclose(omega, [0.0, np.cos(0.3), np.sin(0.3)], atol=1e-15)
