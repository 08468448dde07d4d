import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from drake_oa.perception.visibility import mutual_nearest


@settings(deadline=None)
@given(
    st.integers(0, 60),
    st.integers(0, 60),
    st.sampled_from([0.05, 0.5, 20.0]),
    st.integers(0, 9999),
)
def test_nearest_points_and_queries_are_found(queries, count, spread, seed):
    rng = np.random.default_rng(seed)
    query, points = (rng.uniform(-spread, spread, (n, 3)) for n in (queries, count))
    points[: queries // 2] = query[: queries // 2][: len(points)] + 0.01
    radius = 0.2
    nearest, from_query, from_point = mutual_nearest(query, points, radius)
    apart = np.linalg.norm(query[:, None] - points, axis=-1)
    best = apart.min(axis=1, initial=np.inf)
    expected = np.where(best < radius, apart.argmin(axis=1) if count else -1, -1)
    np.testing.assert_array_equal(nearest, expected)
    np.testing.assert_allclose(from_query, np.minimum(best, radius))
    least = apart.min(axis=0, initial=radius)
    np.testing.assert_allclose(from_point, least)
