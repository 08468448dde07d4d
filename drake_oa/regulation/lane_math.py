"""Elementary functions without branches or calls, for loops over lanes in either precision.

A loop that calls the C library is not made one over vectors; with these it is. Those in
float64 are for `drake_oa.regulation.rollout_kernels`.

Numba's cache does not notice a change in an imported module: after one here, and in any
module that kernels import from, touch those that import it.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numba
import numpy as np
from numba import types
from numba.extending import intrinsic, overload
from numpy.typing import NDArray

from drake_oa.common.messages import FloatArray

Single = np.float32

FAST = {"contract", "reassoc", "nsz", "arcp", "nnan", "ninf"}
"""Liberties of the float32 kernels."""

STRICT = {"contract", "nsz", "arcp"}
"""Liberties of the float64 ones: infinities and NaN keep their meaning."""

# Left to itself the compiler keeps the larger ones apart, and the loop over lanes scalar.
forced_single = numba.njit(cache=True, fastmath=FAST, error_model="numpy", forceinline=True)
forced_double = numba.njit(cache=True, fastmath=STRICT, error_model="numpy", forceinline=True)

ZERO, ONE, TWO, HALF = Single(0.0), Single(1.0), Single(2.0), Single(0.5)
ROOT_HALF, TINY = Single(math.sqrt(0.5)), Single(1e-30)


@intrinsic
def widest_vectors(typing_context):  # type: ignore[no-untyped-def]
    """Lets the calling function use vectors of 512 bits where the processor has them.

    By itself the compiler stops at 256 on most of these; 512 took 0.6 of the time.
    """

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        # The set's own add() refuses attributes that llvmlite does not list.
        set.add(builder.function.attributes, '"prefer-vector-width"="512"')
        return context.get_dummy_value()

    return types.void(), generate


def _polynomial(
    function: Callable[[FloatArray], NDArray[np.float64]], low: float, high: float, terms: int
) -> tuple[float, ...]:
    """Coefficients, constant first, of the interpolation at Chebyshev's points."""
    fit = np.polynomial.Chebyshev.interpolate(function, terms - 1, domain=[low, high])
    power = fit.convert(kind=np.polynomial.Polynomial, domain=[-1, 1], window=[-1, 1])
    return tuple(float(c) for c in power.coef)


def _single(coefficients: tuple[float, ...]) -> tuple[np.float32, ...]:
    return tuple(Single(c) for c in coefficients)


def _atan_series(q: FloatArray) -> FloatArray:
    """atan(sqrt(q)) / sqrt(q)."""
    return np.asarray(np.arctan(np.sqrt(q)) / np.sqrt(q))


def _sine_series(q: FloatArray) -> FloatArray:
    """sin(sqrt(q)) / sqrt(q)."""
    return np.asarray(np.sinc(np.sqrt(q) / np.pi))


def _atanh_series(q: FloatArray) -> FloatArray:
    """atanh(sqrt(q)) / sqrt(q) for small q."""
    return np.asarray(sum(q**k / (2 * k + 1) for k in range(14)))


# --- float32 -----------------------------------------------------------------------------

# Each over the range to which its function reduces the argument; atan, sin and cos in
# the square of the argument, log1p and sin divided by the argument.
_ATAN = _single(_polynomial(_atan_series, 0.0, 1.0, 8))
_EXP2 = _single(_polynomial(np.exp2, 0.0, 1.0, 7))
_LOG1P = _single(
    _polynomial(lambda r: np.log1p(r) / r, math.sqrt(0.5) - 1.0, math.sqrt(2.0) - 1.0, 10)
)
_SIN = _single(_polynomial(_sine_series, 0.0, (np.pi / 2.0) ** 2, 6))
_COS = _single(_polynomial(lambda q: np.cos(np.sqrt(q)), 0.0, (np.pi / 2.0) ** 2, 6))
_A0, _A1, _A2, _A3, _A4, _A5, _A6, _A7 = _ATAN
_E0, _E1, _E2, _E3, _E4, _E5, _E6 = _EXP2
_L0, _L1, _L2, _L3, _L4, _L5, _L6, _L7, _L8, _L9 = _LOG1P
_S0, _S1, _S2, _S3, _S4, _S5 = _SIN
_C0, _C1, _C2, _C3, _C4, _C5 = _COS

PI, _HALF_PI = Single(math.pi), Single(0.5 * math.pi)
_LOG2_E, _LN_2 = Single(1.0 / math.log(2.0)), Single(math.log(2.0))
_SMALLEST_POWER = Single(-60.0)
_EXPONENT_BIAS, _MANTISSA_BITS, _ONE_I = np.int32(127), np.int32(23), np.int32(1)
# Bits of sqrt(1/2): from there the exponent of a number in [sqrt(1/2), sqrt(2)) is 0.
_BITS_ROOT_HALF = np.int32(int(ROOT_HALF.view(np.int32)))
_MANTISSA_MASK = np.int32(-(1 << 23))


@forced_single
def angle_single(sine: Single, cosine: Single) -> Single:
    """atan2(sine, cosine) for sine >= 0, of any length: in [0, pi], to 1e-6."""
    size = abs(cosine)
    above = sine > size
    large = sine if above else size
    small = size if above else sine
    r = small / (large + TINY)
    q = r * r
    p = _A3 + q * (_A4 + q * (_A5 + q * (_A6 + q * _A7)))
    p = r * (_A0 + q * (_A1 + q * (_A2 + q * p)))
    p = _HALF_PI - p if above else p
    return PI - p if cosine < ZERO else p


@forced_single
def exp_negative_single(exponent: Single) -> Single:
    """exp(exponent) for exponent <= 0, to 1e-6 of it; 2^-60 below that."""
    power = exponent * _LOG2_E
    power = power if power > _SMALLEST_POWER else _SMALLEST_POWER
    whole = np.int32(np.int32(power) - _ONE_I)
    f = power - Single(whole)
    p = _E0 + f * (_E1 + f * (_E2 + f * (_E3 + f * (_E4 + f * (_E5 + f * _E6)))))
    bits = np.int32((whole + _EXPONENT_BIAS) << _MANTISSA_BITS)
    return p * bits.view(np.float32)


@forced_single
def log1p_positive_single(value: Single) -> Single:
    """log(1 + value) for 0 <= value < 1e30, to 1e-6 of it."""
    shifted = Single(ONE + value).view(np.int32)
    bits = np.int32((shifted - _BITS_ROOT_HALF) & _MANTISSA_MASK)
    mantissa = np.int32(shifted - bits).view(np.float32)
    # Where the exponent is 0, value itself: 1 + value has lost its last digits.
    r = value if bits == np.int32(0) else mantissa - ONE
    p = _L4 + r * (_L5 + r * (_L6 + r * (_L7 + r * (_L8 + r * _L9))))
    p = r * (_L0 + r * (_L1 + r * (_L2 + r * (_L3 + r * p))))
    return p + Single(bits >> _MANTISSA_BITS) * _LN_2


@forced_single
def sine_cosine_single(turn: Single) -> tuple[Single, Single]:
    """sin and cos for |turn| <= pi, to 1e-6."""
    half = HALF * turn
    q = half * half
    sine = half * (_S0 + q * (_S1 + q * (_S2 + q * (_S3 + q * (_S4 + q * _S5)))))
    cosine = _C0 + q * (_C1 + q * (_C2 + q * (_C3 + q * (_C4 + q * _C5))))
    return TWO * sine * cosine, ONE - TWO * sine * sine


# --- float64 -----------------------------------------------------------------------------

# As above, but log1p by atanh, in the square of its argument and divided by it.
_DA = _polynomial(_atan_series, 0.0, 1.0, 16)
_DE = _polynomial(np.exp2, -0.5, 0.5, 10)
_DL = _polynomial(_atanh_series, 0.0, (3.0 - math.sqrt(8.0)) ** 2, 7)
_DS = _polynomial(_sine_series, 0.0, (np.pi / 2.0) ** 2, 8)
_DC = _polynomial(lambda q: np.cos(np.sqrt(q)), 0.0, (np.pi / 2.0) ** 2, 8)
_DA0, _DA1, _DA2, _DA3, _DA4, _DA5, _DA6, _DA7 = _DA[:8]
_DA8, _DA9, _DA10, _DA11, _DA12, _DA13, _DA14, _DA15 = _DA[8:]
_DE0, _DE1, _DE2, _DE3, _DE4, _DE5, _DE6, _DE7, _DE8, _DE9 = _DE
_DL0, _DL1, _DL2, _DL3, _DL4, _DL5, _DL6 = _DL
_DS0, _DS1, _DS2, _DS3, _DS4, _DS5, _DS6, _DS7 = _DS
_DC0, _DC1, _DC2, _DC3, _DC4, _DC5, _DC6, _DC7 = _DC

TINY_DOUBLE = 1e-300
_LOG2_E_DOUBLE, _LN_2_DOUBLE = 1.0 / math.log(2.0), math.log(2.0)
# Added, it leaves a number's nearest integer in the low bits of the sum.
_ROUNDER = 1.5 * 2.0**52
_BITS_ROOT_HALF_DOUBLE = np.int64(np.float64(math.sqrt(0.5)).view(np.int64))
_BITS_2_52 = np.int64(np.float64(2.0**52).view(np.int64))
_EXPONENT_DOUBLE = np.int64(~((1 << 52) - 1))
_MANTISSA_BITS_DOUBLE, _BIAS_DOUBLE = np.int64(52), np.int64(1023)


@forced_double
def angle_double(sine: float, cosine: float) -> float:
    """atan2(sine, cosine) for sine >= 0: in [0, pi], to 1e-12; 0 where both are 0."""
    size = abs(cosine)
    above = sine > size
    large = sine if above else size
    small = size if above else sine
    r = small / (large + TINY_DOUBLE)
    q = r * r
    q2 = q * q
    q4 = q2 * q2
    low = (_DA0 + q * _DA1) + q2 * (_DA2 + q * _DA3)
    low = low + q4 * ((_DA4 + q * _DA5) + q2 * (_DA6 + q * _DA7))
    high = (_DA8 + q * _DA9) + q2 * (_DA10 + q * _DA11)
    high = high + q4 * ((_DA12 + q * _DA13) + q2 * (_DA14 + q * _DA15))
    p = r * (low + q4 * q4 * high)
    p = 0.5 * math.pi - p if above else p
    return math.pi - p if cosine < 0.0 else p


@forced_double
def exponential_double(exponent: float) -> float:
    """exp(exponent), to 1e-11 of it, between 2^-80 and 2^1000; these beyond."""
    power = exponent * _LOG2_E_DOUBLE
    # Not less: the squares of what comes of it keep out of the denormal numbers.
    power = power if power > -80.0 else -80.0
    power = power if power < 1000.0 else 1000.0
    shifted = np.float64(power + _ROUNDER)
    f = power - (shifted - _ROUNDER)
    f2 = f * f
    f4 = f2 * f2
    p = (_DE0 + f * _DE1) + f2 * (_DE2 + f * _DE3)
    p = p + f4 * ((_DE4 + f * _DE5) + f2 * (_DE6 + f * _DE7) + f4 * (_DE8 + f * _DE9))
    bits = np.int64((shifted.view(np.int64) + _BIAS_DOUBLE) << _MANTISSA_BITS_DOUBLE)
    return p * bits.view(np.float64)


@forced_double
def log1p_positive_double(value: float) -> float:
    """log(1 + value) for finite value >= 0, to 1e-11 of it."""
    total = np.float64(1.0 + value)
    bits = total.view(np.int64)
    shifted = bits - _BITS_ROOT_HALF_DOUBLE
    mantissa = np.int64(bits - (shifted & _EXPONENT_DOUBLE)).view(np.float64)
    power = np.int64((shifted >> _MANTISSA_BITS_DOUBLE) | _BITS_2_52).view(np.float64) - 2.0**52
    # Where the exponent is 0, value itself: 1 + value has lost its last digits.
    r = value if power == 0.0 else mantissa - 1.0
    s = r / (2.0 + r)
    q = s * s
    q2 = q * q
    p = (_DL0 + q * _DL1) + q2 * (_DL2 + q * _DL3) + q2 * q2 * ((_DL4 + q * _DL5) + q2 * _DL6)
    return 2.0 * s * p + power * _LN_2_DOUBLE


@forced_double
def half_sine_cosine_double(half: float) -> tuple[float, float]:
    """sin and cos for |half| <= pi / 2, to 1e-11."""
    q = half * half
    q2 = q * q
    q4 = q2 * q2
    sine = (_DS0 + q * _DS1) + q2 * (_DS2 + q * _DS3)
    sine = sine + q4 * (_DS4 + q * _DS5 + q2 * (_DS6 + q * _DS7))
    cosine = (_DC0 + q * _DC1) + q2 * (_DC2 + q * _DC3)
    cosine = cosine + q4 * (_DC4 + q * _DC5 + q2 * (_DC6 + q * _DC7))
    return half * sine, cosine


# --- by the arguments' precision -----------------------------------------------------------


def angle(sine, cosine):  # type: ignore[no-untyped-def]
    """`angle_single` or `angle_double`; in compiled code only."""
    raise NotImplementedError


def exp_negative(exponent):  # type: ignore[no-untyped-def]
    """`exp_negative_single` or `exponential_double`; in compiled code only."""
    raise NotImplementedError


@overload(angle, inline="always")
def _angle(sine, cosine):  # type: ignore[no-untyped-def]
    if sine == types.float32:
        return lambda sine, cosine: angle_single(sine, cosine)
    return lambda sine, cosine: angle_double(sine, cosine)


@overload(exp_negative, inline="always")
def _exp_negative(exponent):  # type: ignore[no-untyped-def]
    if exponent == types.float32:
        return lambda exponent: exp_negative_single(exponent)
    return lambda exponent: exponential_double(exponent)
