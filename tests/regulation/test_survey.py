"""Motions all round a scene, in the place of the shortest one."""

import numpy as np
import pytest

from drake_oa.regulation.regressor import ChainWeights, load_chain
from drake_oa.regulation.rollout import SpatialScenes
from drake_oa.regulation.survey import assessed, survey
from drake_oa.regulation.verification import ALPHA, ANGLE, SearchParameters, verify
from drake_oa.scenario.loading import package_file

DURATION = 5.0
QUICK = SearchParameters(candidates=32, rounds=12, polish=0, steps=250)


@pytest.fixture(scope="module")
def chain() -> ChainWeights:
    return load_chain(package_file("package://drake_oa/weights/regressor_chain.npz"))


def ball(y: float = 0.0, *, velocity: float = 0.0, semi_axis: float = 0.08) -> SpatialScenes:
    """A motion of 1 m along x, a ball half-way."""
    return SpatialScenes(
        p_WE=np.zeros((1, 3)),
        z_W=np.zeros((1, 3)),
        p_WG=np.array([[1.0, 0.0, 0.0]]),
        R_WL=np.eye(3)[None],
        baseline=np.ones(1),
        p_WO=np.array([[[0.5, y, 0.0]]]),
        R_WO=np.eye(3)[None, None],
        semi_axes=np.full((1, 1, 3), semi_axis),
        v_WO=np.array([[[0.0, velocity, 0.0]]]),
        clearance=np.full((1, 1), 0.1),
    )


def test_given_genes_come_to_what_the_search_says_of_them(chain: ChainWeights) -> None:
    found = verify(ball(), chain, duration=DURATION, parameters=QUICK)
    again = assessed(ball(), found.genes, duration=DURATION, parameters=QUICK)
    for name in ("terms", "tau", "end", "clearance", "shortfall", "kept", "path_length", "cost"):
        # One row and many are two kernels, which a processor's instructions may round apart.
        np.testing.assert_allclose(
            getattr(again, name), getattr(found, name), rtol=1e-12, err_msg=name
        )


@pytest.mark.parametrize("y", [0.0, 0.4])
def test_it_goes_round_on_every_side_in_detours_of_every_size(y: float) -> None:
    # Also where the straight motion is free.
    found = survey(ball(y), duration=DURATION, clearance=0.05, parameters=QUICK)
    kept = found.rows(found.kept)
    sides = np.unique(np.round(np.mod(kept.genes[:, ANGLE], 2.0 * np.pi) / (np.pi / 4.0)) % 8)
    assert len(sides) >= 7
    assert kept.path_length.min() < 1.2
    assert kept.path_length.max() > 1.6
    assert (found.genes[:, ALPHA] <= 8.0 + 1e-9).all()
    assert (found.clearance > 0.045).all()
    # The first is as good as any that does not creep.
    prompt = found.cost[found.end <= found.end[0] + 1e-9]
    assert found.cost[0] == prompt.min()


def test_it_is_the_same_each_time_and_times_what_moves() -> None:
    moving = ball(-0.5, velocity=0.2)
    one, other = (survey(moving, duration=DURATION, clearance=0.05) for _ in range(2))
    np.testing.assert_array_equal(one.genes, other.genes)
    assert len(np.unique(one.tau)) > 1


def test_where_nothing_passes_there_is_none() -> None:
    found = survey(ball(semi_axis=0.46), duration=DURATION, clearance=0.2, parameters=QUICK)
    assert len(found.cost) == 0


def test_more_than_one_scene_is_refused() -> None:
    two = ball().rows(np.zeros(2, dtype=int))
    with pytest.raises(ValueError, match="single one, not 2"):
        survey(two, duration=DURATION, clearance=0.05)
    with pytest.raises(ValueError, match="single one, not 2"):
        assessed(two, np.zeros((2, 7)), duration=DURATION)
