"""The compiled coupling terms against the readable ones."""

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numba import njit

from drake_oa.common.messages import FloatArray
from drake_oa.policy import coupling as kernels
from drake_oa.policy.coupling import GuidanceForm
from tests.reference.coupling import CouplingTerms
from tests.reference.coupling import rotate as reference_rotate

FORMS: tuple[GuidanceForm, ...] = ("counterphase", "printed")
seeds = st.integers(0, 2**32 - 1)
finite = st.floats(allow_nan=False, allow_infinity=False)
nonnegative = st.floats(0.0, allow_infinity=False)
vectors = st.tuples(finite, finite, finite)
small = st.tuples(*[st.integers(-1, 1)] * 3).map(lambda v: np.array(v, dtype=float))


def both_turns(
    rows: FloatArray,
    p: FloatArray,
    z: FloatArray,
    step: float,
    form: GuidanceForm,
    in_plane: bool,
    max_rate: float = 1000.0,
) -> tuple[FloatArray, FloatArray]:
    """The compiled turn and the readable one."""
    readable = CouplingTerms(
        p_WO=rows[:, 0:3],
        parameters=rows[:, 3:6],
        heading_W=rows[:, 6:9],
        normal_W=rows[:, 9:12],
        guidance_alpha=rows[:, 12],
        form=form,
        in_plane=in_plane,
        max_rate=max_rate,
    )
    compiled = kernels.turn_step(rows, in_plane, form == "printed", max_rate, *p, *z, step)
    return np.array(compiled), readable.turn(p, z, step)


def random_rows(rng: np.random.Generator, count: int, log_strength: float) -> FloatArray:
    """Random terms, the strongest of exp(log_strength)."""
    rows = rng.normal(size=(count, kernels.N_COLUMNS))
    rows[:, 3:6] = np.exp(rng.uniform([-3, -3, -2], [log_strength, 1, 6], size=(count, 3)))
    rows[:, 6:9] *= rng.integers(0, 2, size=(count, 1))
    rows[:, 12] = np.exp(rng.uniform(-3, log_strength, size=count)) * rng.integers(0, 2, size=count)
    return rows


@settings(max_examples=300)
@given(
    seed=seeds,
    count=st.integers(0, 6),
    step=st.floats(1e-6, 1.0),
    stiff=st.booleans(),
    form=st.sampled_from(FORMS),
    in_plane=st.booleans(),
)
@example(4719, 6, math.exp(0.5), True, "counterphase", False)
def test_the_compiled_turn_is_the_readable_one(
    seed: int, count: int, step: float, stiff: bool, form: GuidanceForm, in_plane: bool
) -> None:
    rng = np.random.default_rng(seed)
    rows = random_rows(rng, count, 14.0 if stiff else 3.0)
    p, z = rng.normal(size=(2, 3))
    compiled, readable = both_turns(rows, p, z, step, form, in_plane)
    # Divisors reach 1e4 where terms are strong, and with them the condition number of the
    # composition: the readable turn itself changes by some 1e-12 with the last bit of its input.
    np.testing.assert_allclose(compiled, readable, rtol=0.0, atol=1e-11 if stiff else 1e-12)


@settings(max_examples=300)
@given(
    places=st.lists(st.tuples(small, small, small), min_size=1, max_size=3),
    p=small,
    z=small,
    alpha=st.sampled_from([0.0, 1.0, 1e5]),
    kappa=st.sampled_from([0.0, 3.0]),
    guide=st.sampled_from([0.0, 1.0, 1e5]),
    step=st.sampled_from([0.0, 1e-3, 1.0]),
    form=st.sampled_from(FORMS),
    in_plane=st.booleans(),
)
def test_they_agree_where_directions_coincide_vanish_or_oppose(
    places: list[tuple[FloatArray, FloatArray, FloatArray]],
    p: FloatArray,
    z: FloatArray,
    alpha: float,
    kappa: float,
    guide: float,
    step: float,
    form: GuidanceForm,
    in_plane: bool,
) -> None:
    rows = np.array(
        [
            [*center, alpha, 0.6, kappa, *heading, *normal, guide]
            for center, heading, normal in places
        ]
    )
    compiled, readable = both_turns(rows, p, z, step, form, in_plane)
    np.testing.assert_allclose(compiled, readable, rtol=0.0, atol=1e-12)


@settings(max_examples=300)
@given(
    p=vectors,
    z=vectors,
    center=vectors,
    alpha=nonnegative,
    psi=st.floats(0.0, exclude_min=True, allow_infinity=False),
    kappa=nonnegative,
    heading=vectors,
    normal=vectors,
    guide=nonnegative,
    step=st.floats(0.0, 1e3),
    form=st.sampled_from(FORMS),
    in_plane=st.booleans(),
)
@example(*([(0.0,) * 3] * 3), 1.0, 1.0, 1.0, (0.0,) * 3, (0.0,) * 3, 1.0, 0.1, "printed", True)
@example(
    *((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
    *(1e308, 1e-308, 0.0, (-1.0, 0.0, 0.0), (5e-324, 0.0, 0.0), 1e308, 1e3, "printed", False),
)
def test_no_finite_input_yields_anything_but_a_finite_turn(
    p: tuple[float, ...],
    z: tuple[float, ...],
    center: tuple[float, ...],
    alpha: float,
    psi: float,
    kappa: float,
    heading: tuple[float, ...],
    normal: tuple[float, ...],
    guide: float,
    step: float,
    form: GuidanceForm,
    in_plane: bool,
) -> None:
    row = [*center, alpha, psi, kappa, *heading, *normal, guide]
    again = [*center[::-1], alpha, psi, kappa, *heading[::-1], *normal, guide]
    rows = np.array([row, again])
    turn = kernels.turn_step(rows, in_plane, form == "printed", 1000.0, *p, *z, step)
    assert np.isfinite(turn).all()
    assert np.linalg.norm(turn) <= np.pi * (1.0 + 1e-12)


@settings(max_examples=200)
@given(seed=seeds, log_angle=st.floats(-20.0, 8.0))
def test_the_compiled_rotation_is_the_readable_one(seed: int, log_angle: float) -> None:
    z, w = np.random.default_rng(seed).normal(size=(2, 3))
    w *= math.exp(log_angle)
    compiled = np.array(kernels.rotate(*z, *w))
    # A large angle is known to its last bit only.
    close = 1e-12 * max(1.0, float(np.linalg.norm(w)) / 1e3)
    np.testing.assert_allclose(compiled, reference_rotate(z, w), rtol=0.0, atol=close)
    assert kernels.rotate(*z, 0.0, 0.0, 0.0) == tuple(z)


@pytest.mark.parametrize("scale", [5e-324, 1e-200, 1.0, 1e200, 1e308])
def test_lengths_neither_overflow_nor_vanish(scale: float) -> None:
    assert kernels.norm(0.0, scale, 0.0) == scale
    x, y, z = 0.3 * scale, -0.4 * scale, 0.5 * scale
    assert kernels.norm(x, y, z) == pytest.approx(math.hypot(x, y, z), rel=1e-15)


def test_the_pieces_can_be_called_from_another_kernel() -> None:
    @njit
    def one_turn(theta: float, step: float) -> float:
        explicit, divisor = kernels.limited_avoidance(200.0, theta, 0.6, step)
        return explicit / divisor

    row = np.array([[0.5, 0, 0, 200.0 * math.e, 0.6, 4.0, 0, 0, 0, 0, 0, 0, 0]])
    z = (math.cos(0.3), math.sin(0.3), 0.0)
    turn = kernels.turn_step(row, False, False, 1e3, 0.0, 0.0, 0.0, *z, 0.01)
    u = 0.3 / 0.6
    explicit, divisor = kernels.limited_avoidance(200.0 * math.exp(-u * u), 0.3, 0.6, 0.01)
    assert turn[2] == pytest.approx(explicit / divisor, rel=1e-12)
    assert one_turn(0.3, 0.01) > 0.0
