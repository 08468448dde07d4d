"""What the verification is timed against is the same motion."""

import math
from dataclasses import asdict

import numpy as np
import pytest

from drake_oa.benchmark.verification_timings import (
    CANDIDATES,
    CLEARANCE,
    MID_MOTION,
    OBSTACLES,
    candidate_rollouts,
    candidates,
    readable_rollout,
    time_verification,
    under_way,
)
from drake_oa.policy.coupling_kernels import N_COLUMNS
from drake_oa.regulation.regressor import load_chain
from drake_oa.regulation.verification import SearchParameters
from drake_oa.scenario.loading import package_file
from drake_oa.studies.scenes.suites import draw_scenes
from drake_oa.studies.scenes.verified import WEIGHTS, spatial_scenes

PARAMETERS = SearchParameters(steps=100)


def test_the_readable_reference_takes_the_same_motion() -> None:
    scene = spatial_scenes(draw_scenes("clutter", 1, 0), CLEARANCE)
    assert np.isfinite(scene.p_WO).all()
    assert scene.p_WO.shape[1] == OBSTACLES
    middle = under_way(scene, np.zeros((1, N_COLUMNS)), PARAMETERS)
    assert middle.s == MID_MOTION
    assert 0.0 < middle.p_WE[0, 0] < scene.baseline[0]
    terms = candidates(middle, load_chain(package_file(WEIGHTS)), PARAMETERS)
    assert len(terms) == CANDIDATES
    found = candidate_rollouts(middle, terms, PARAMETERS)
    for i in range(4):
        path, clearance = readable_rollout(middle, terms[i, 0], PARAMETERS)
        assert len(path) - 1 == found.steps[i]
        length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
        assert found.path_length[i] == pytest.approx(length, abs=1e-6)
        if clearance > 0.0:
            assert found.clearance[i] == pytest.approx(clearance, abs=1e-4)
        else:
            assert found.clearance[i] <= 0.0


def test_all_times_are_measured() -> None:
    found = time_verification(scenes=1, repeats=1, readable_rows=1)
    assert all(math.isfinite(value) for value in asdict(found).values())
    assert found.first_rollouts >= 1
    assert found.first <= found.first_worst
    assert found.frame <= found.frame_worst


@pytest.mark.parametrize(
    "counts", [{"scenes": 0}, {"repeats": 0}, {"readable_rows": 0}, {"readable_rows": 65}]
)
def test_nothing_to_time_is_refused(counts: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="must be"):
        time_verification(**counts)
