import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from drake_oa.perception import depth_image as kernels


@settings(max_examples=30)
@given(st.integers(1, 9), st.integers(1, 9), st.integers(1, 4), st.integers(0, 9999))
def test_a_coarser_image_names_its_pixels_in_the_finer_one(height, width, stride, seed):
    rng = np.random.default_rng(seed)
    z = rng.choice([0.0, 0.5, 1.0, 3.0, np.inf, np.nan], (height, width)).astype(np.float32)
    coarse, fine = kernels.sampled(z, stride, 0.4, 2.0)
    grid = z[::stride, ::stride].ravel()
    np.testing.assert_array_equal(coarse, np.flatnonzero((grid >= 0.4) & (grid <= 2.0)))
    np.testing.assert_array_equal(z.ravel()[fine], grid[coarse])


def test_pixels_between_heights_are_those_a_plain_formula_gives():
    rng = np.random.default_rng(0)
    z = rng.uniform(0.0, 3.0, (50, 70)).astype(np.float32)
    z[rng.random(z.shape) < 0.2] = np.nan
    z[rng.random(z.shape) < 0.1] = np.inf
    u, v = (rng.normal(size=n).astype(np.float32) for n in (70, 50))
    near, far, low, noise, high = limits = np.array([0.3, 2.5, -0.4, 0.1, 1.2], dtype=np.float32)
    raised = z * (u + v[:, None])
    with np.errstate(invalid="ignore"):
        highest = raised + noise * z
    inside = (z >= near) & (z <= far) & (raised > low) & (highest < high)
    found = kernels.pixels_between(z, u, v, limits)
    np.testing.assert_array_equal(found, np.flatnonzero(inside))
    K = np.array([60.0, 50.0, 34.5, 24.5])
    p_CQ = kernels.back_projected(z, found, K)
    row, column = np.divmod(found, 70)
    np.testing.assert_allclose(p_CQ[:, 0] / p_CQ[:, 2] * K[0] + K[2], column, atol=1e-5)
    np.testing.assert_allclose(p_CQ[:, 1] / p_CQ[:, 2] * K[1] + K[3], row, atol=1e-5)
    np.testing.assert_array_equal(p_CQ[:, 2], z.ravel()[found])
