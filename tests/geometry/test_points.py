"""Points of obstacles in blocks of neighbours."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drake_oa.common.messages import FloatArray, ObstacleClouds
from drake_oa.geometry.points import ObstaclePoints


def seen(*clouds: FloatArray) -> ObstacleClouds:
    return ObstacleClouds(0.0, tuple(clouds), np.arange(len(clouds)) + 7)


@given(seed=st.integers(0, 10_000), spread=st.sampled_from([0.01, 0.3, 100.0]))
@settings(max_examples=30)
def test_blocks_hold_every_point_once(seed: int, spread: float) -> None:
    rng = np.random.default_rng(seed)
    clouds = [rng.normal(size=(count, 3)) * spread for count in (7, 0, 300, 1)]
    grouped = ObstaclePoints.of(seen(*clouds))
    assert grouped.start[-1] == len(grouped.points) == 308
    assert (np.diff(grouped.start) > 0).all()
    for row, cloud in enumerate(clouds):
        mine = np.repeat(grouped.owner, np.diff(grouped.start)) == row
        np.testing.assert_array_equal(
            np.unique(grouped.points[mine], axis=0), np.unique(cloud, axis=0)
        )
    for block, (begin, end) in enumerate(zip(grouped.start, grouped.start[1:], strict=False)):
        away = np.linalg.norm(grouped.points[begin:end] - grouped.sphere[block, :3], axis=1)
        assert away.max() <= grouped.sphere[block, 3] + 1e-12


def test_points_that_are_not_finite_are_refused() -> None:
    with pytest.raises(ValueError, match="not finite"):
        ObstaclePoints.of(seen(np.full((2, 3), np.nan)))
