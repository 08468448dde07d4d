"""The float32 roll-outs: rows by themselves, and against those without a compiled kernel."""

import numpy as np
import pytest

from drake_oa.benchmark.rollout_baselines import numpy_rollouts, torch_rollouts
from drake_oa.benchmark.rollout_timings import paper_sample, time_rollouts
from drake_oa.training.planar_rollout import (
    STEPS,
    planar_rollouts,
    released_forcing,
    released_rollouts,
)


@pytest.mark.parametrize("rows", [1, 63, 64, 65, 2048, 2049])
def test_rows_do_not_depend_on_their_neighbours(rows):
    semi_axes, parameters = paper_sample(2049, seed=4)
    parameters[::2, 2] *= 0.05
    whole = planar_rollouts(semi_axes, parameters, steps=100)
    some = planar_rollouts(semi_axes[-rows:], parameters[-rows:], steps=100)
    np.testing.assert_array_equal(some.clearance, whole.clearance[-rows:])
    np.testing.assert_array_equal(some.path_length, whole.path_length[-rows:])


def test_no_rows_are_no_outcome():
    assert planar_rollouts(np.zeros((0, 2)), np.zeros((0, 3))).clearance.size == 0
    assert released_rollouts(np.zeros((0, 2)), np.zeros((0, 3))).clearance.size == 0


@pytest.mark.parametrize("baseline", [numpy_rollouts, torch_rollouts])
def test_baselines_do_the_same_work(baseline):
    if baseline is torch_rollouts:
        pytest.importorskip("torch")
    semi_axes, parameters = paper_sample(600, seed=2)
    single = [np.ascontiguousarray(a, np.float32) for a in (semi_axes, parameters)]
    got = baseline(*single, released_forcing(STEPS).astype(np.float32), block=256)
    ours = released_rollouts(semi_axes, parameters, between=False)
    np.testing.assert_array_equal(got[0] == 0.0, ours.contact)
    calm = ~ours.contact & (ours.goal_error < 0.02)
    assert calm.sum() > 30
    # Theirs is the warm-started estimate of the distance.
    np.testing.assert_allclose(got[0][calm], ours.clearance[calm], atol=2e-3)
    np.testing.assert_allclose(got[2][calm], ours.path_length[calm], atol=1e-3)


def test_timings_say_what_they_ran():
    timings = time_rollouts(rows=2000, baseline_rows=200, repeats=1)
    assert (timings.rows, timings.baseline_rows) == (2000, 200)
    assert 0.05 < timings.kept < 0.15
    assert min(timings.kernel, timings.numpy, timings.project, timings.project_double) > 0.0
    assert timings.paper == pytest.approx(timings.kernel * 12.5)


def test_timings_need_rows():
    with pytest.raises(ValueError, match="rows >= baseline_rows > 0"):
        time_rollouts(rows=10, baseline_rows=20)
