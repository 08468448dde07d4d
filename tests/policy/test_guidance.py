"""Tests of the guidance heading past an obstacle."""

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st

from drake_oa.common.messages import CouplingParameters, EllipsoidSet, FloatArray, Route
from drake_oa.geometry.ellipsoid import signed_distance
from drake_oa.policy.action import CouplingInputs
from drake_oa.policy.coupling import HEADING
from drake_oa.policy.guidance import guide
from tests.builders import balls

UP = (0.0, 0.0, 1.0)
Triple = tuple[float, float, float]
BLOCK = balls((0.5, 0, 0), radius=(0.1, 0.2, 0.15))


def heading(p: Triple, z: Triple, ellipsoids: EllipsoidSet, side: Triple = UP) -> FloatArray:
    """Computes the heading (3,) of a motion along x past an ellipsoid at a clearance of 0.1 m."""
    route = Route(
        direction_W=np.array([side]),
        normal_W=np.cross([1.0, 0.0, 0.0], side)[None],
        remaining_clearance=np.full(1, 0.1),
    )
    rows = CouplingParameters(*np.ones((3, 1)))
    obstacles = CouplingInputs.of(ellipsoids, rows, route).obstacles
    guide(p, z, (1.0, 0.0, 0.0), (1.0, 0.0, 0.0), obstacles, obstacles.terms)
    return obstacles.terms[0, HEADING : HEADING + 3]


def test_guidance_leads_a_motion_that_would_pass_below_over_the_top() -> None:
    for p, z in (((0, 0, -0.01), (1, 0, 0)), ((0.0, 0, 0), (1, 0, -0.1))):
        v_d = heading(p, z, BLOCK)
        assert v_d[2] > 0.1
        assert abs(v_d[1]) < 1e-12
        assert abs(np.linalg.norm(v_d) - 1.0) < 1e-12
    # At rest the baseline is the heading.
    at_rest, moving = (heading((0, 0, -0.01), (x, 0, 0), BLOCK) for x in (0, 1))
    np.testing.assert_allclose(at_rest, moving)


def test_no_guidance_if_avoidance_turns_to_the_selected_side_or_the_obstacle_is_clear() -> None:
    # Also straight at the center, whatever the rounding.
    for height in (-1e-13, 0.0, 1e-13, 0.01):
        assert not heading((0, 0, height), (1, 0, 0), BLOCK).any()
    for center in ((0.5, 0.6, 0), (-0.5, 0, 0), (1.5, 0, 0)):
        assert not heading((0, 0, -0.01), (1, 0, 0), balls(center, radius=0.1)).any()


@given(
    offset=st.tuples(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1)),
    axes=st.tuples(*[st.floats(0.03, 0.2)] * 3),
    angle=st.floats(0.0, 6.28),
)
def test_the_heading_from_the_wrong_side_passes_at_the_clearance(
    offset: tuple[float, float], axes: Triple, angle: float
) -> None:
    side = np.array([0.0, np.cos(angle), np.sin(angle)])
    # E is within 60 degrees of the opposite side, so that guidance acts fully.
    assume(np.hypot(*offset) > 1e-3)
    assume(side[1:] @ offset < -0.51 * np.hypot(*offset))
    ellipsoids = balls((0.6, 0.0, 0.0), radius=axes)
    v_d = heading((0.0, *offset), (1, 0, 0), ellipsoids, tuple(side))
    ray = (0.0, *offset) + np.linspace(0.0, 2.0, 400)[:, None] * v_d
    distance = signed_distance(ray, ellipsoids.p_WO[0], ellipsoids.R_WO[0], ellipsoids.semi_axes[0])
    assert distance.min() >= 0.1 - 1e-9 or not v_d.any()
    assert distance.min() <= 0.25 or not v_d.any()
