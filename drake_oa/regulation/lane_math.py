"""Elementary functions without branches or calls, for loops over lanes, in float64.

A loop that calls the C library is not made one over vectors; with these it is.

Numba's cache does not notice a change in an imported module: after one here, and in any
module that kernels import from, touch those that import it.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numba
import numpy as np
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from drake_oa.common.messages import FloatArray

STRICT = {"contract", "nsz", "arcp"}
"""Liberties of the loops over lanes: infinities and NaN keep their meaning."""

# Left to itself the compiler keeps the larger ones apart, and the loop over lanes scalar.
_forced = numba.njit(cache=True, fastmath=STRICT, error_model="numpy", forceinline=True)


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


def _atan_series(q: FloatArray) -> FloatArray:
    """atan(sqrt(q)) / sqrt(q)."""
    return np.asarray(np.arctan(np.sqrt(q)) / np.sqrt(q))


def _sine_series(q: FloatArray) -> FloatArray:
    """sin(sqrt(q)) / sqrt(q)."""
    return np.asarray(np.sinc(np.sqrt(q) / np.pi))


def _atanh_series(q: FloatArray) -> FloatArray:
    """atanh(sqrt(q)) / sqrt(q) for small q."""
    return np.asarray(sum(q**k / (2 * k + 1) for k in range(14)))


# Each over the range to which its function reduces the argument; atan, sin and cos in the square
# of the argument, log1p by atanh, in the square of its argument; atan, log1p and sin divided by it.
_A = _polynomial(_atan_series, 0.0, 1.0, 16)
_E = _polynomial(np.exp2, -0.5, 0.5, 10)
_L = _polynomial(_atanh_series, 0.0, (3.0 - math.sqrt(8.0)) ** 2, 7)
_S = _polynomial(_sine_series, 0.0, (np.pi / 2.0) ** 2, 8)
_C = _polynomial(lambda q: np.cos(np.sqrt(q)), 0.0, (np.pi / 2.0) ** 2, 8)
_A0, _A1, _A2, _A3, _A4, _A5, _A6, _A7 = _A[:8]
_A8, _A9, _A10, _A11, _A12, _A13, _A14, _A15 = _A[8:]
_E0, _E1, _E2, _E3, _E4, _E5, _E6, _E7, _E8, _E9 = _E
_L0, _L1, _L2, _L3, _L4, _L5, _L6 = _L
_S0, _S1, _S2, _S3, _S4, _S5, _S6, _S7 = _S
_C0, _C1, _C2, _C3, _C4, _C5, _C6, _C7 = _C

TINY = 1e-300
_LOG2_E, _LN_2 = 1.0 / math.log(2.0), math.log(2.0)
# Added, it leaves a number's nearest integer in the low bits of the sum.
_ROUNDER = 1.5 * 2.0**52
_BITS_ROOT_HALF = np.int64(np.float64(math.sqrt(0.5)).view(np.int64))
_BITS_2_52 = np.int64(np.float64(2.0**52).view(np.int64))
_EXPONENT = np.int64(~((1 << 52) - 1))
_MANTISSA_BITS, _BIAS = np.int64(52), np.int64(1023)


@_forced
def angle(sine: float, cosine: float) -> float:
    """atan2(sine, cosine) for sine >= 0: in [0, pi], to 1e-12; 0 where both are 0."""
    size = abs(cosine)
    above = sine > size
    large = sine if above else size
    small = size if above else sine
    r = small / (large + TINY)
    q = r * r
    q2 = q * q
    q4 = q2 * q2
    low = (_A0 + q * _A1) + q2 * (_A2 + q * _A3)
    low = low + q4 * ((_A4 + q * _A5) + q2 * (_A6 + q * _A7))
    high = (_A8 + q * _A9) + q2 * (_A10 + q * _A11)
    high = high + q4 * ((_A12 + q * _A13) + q2 * (_A14 + q * _A15))
    p = r * (low + q4 * q4 * high)
    p = 0.5 * math.pi - p if above else p
    return math.pi - p if cosine < 0.0 else p


@_forced
def exponential(exponent: float) -> float:
    """exp(exponent), to 1e-11 of it, between 2^-80 and 2^1000; these beyond."""
    power = exponent * _LOG2_E
    # Not less: the squares of what comes of it keep out of the denormal numbers.
    power = power if power > -80.0 else -80.0
    power = power if power < 1000.0 else 1000.0
    shifted = np.float64(power + _ROUNDER)
    f = power - (shifted - _ROUNDER)
    f2 = f * f
    f4 = f2 * f2
    p = (_E0 + f * _E1) + f2 * (_E2 + f * _E3)
    p = p + f4 * ((_E4 + f * _E5) + f2 * (_E6 + f * _E7) + f4 * (_E8 + f * _E9))
    bits = np.int64((shifted.view(np.int64) + _BIAS) << _MANTISSA_BITS)
    return p * bits.view(np.float64)


@_forced
def log1p_positive(value: float) -> float:
    """log(1 + value) for finite value >= 0, to 1e-11 of it."""
    total = np.float64(1.0 + value)
    bits = total.view(np.int64)
    shifted = bits - _BITS_ROOT_HALF
    mantissa = np.int64(bits - (shifted & _EXPONENT)).view(np.float64)
    power = np.int64((shifted >> _MANTISSA_BITS) | _BITS_2_52).view(np.float64) - 2.0**52
    # Where the exponent is 0, value itself: 1 + value has lost its last digits.
    r = value if power == 0.0 else mantissa - 1.0
    s = r / (2.0 + r)
    q = s * s
    q2 = q * q
    p = (_L0 + q * _L1) + q2 * (_L2 + q * _L3) + q2 * q2 * ((_L4 + q * _L5) + q2 * _L6)
    return 2.0 * s * p + power * _LN_2


@_forced
def half_sine_cosine(half: float) -> tuple[float, float]:
    """sin and cos for |half| <= pi / 2, to 1e-11."""
    q = half * half
    q2 = q * q
    q4 = q2 * q2
    sine = (_S0 + q * _S1) + q2 * (_S2 + q * _S3)
    sine = sine + q4 * (_S4 + q * _S5 + q2 * (_S6 + q * _S7))
    cosine = (_C0 + q * _C1) + q2 * (_C2 + q * _C3)
    cosine = cosine + q4 * (_C4 + q * _C5 + q2 * (_C6 + q * _C7))
    return half * sine, cosine
