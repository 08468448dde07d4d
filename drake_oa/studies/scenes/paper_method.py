"""The methods `paper` and `original`: the paper's action level, as print and released code tell.

Action level: alpha_x 10, beta_x 2.5, alpha_k 0.5, 35 basis functions of local quadratics,
a straight demonstration at constant speed, semi-implicit Euler, the avoidance term about each
obstacle's centre, summed::

    a = tau^2 alpha_x (beta_x (g - x) - v) + f + sum_i R_i v theta'_i,   v += h a,   x += h v

`paper`: (eq. oa_complete) with the regressor chain's parameters at lambda' and Delta, in metres
whatever the baseline, asked again in each step. lambda' are the principal semi-axes of the
obstacle's section by the P-plane of (p_obs - p, v); lambda1' is the one within 45 degrees of the
baseline, as in the training set and the released code. (Taken along the way to the centre
instead, the two would change places whenever an obstacle is passed.) Where way and velocity span
no plane, the last plane stands in, at first the horizontal one, as in the released code. The
route is not guided: the paper's synthetic experiments have neither table nor workspace. The
networks are evaluated outside their trained range too; alpha and kappa below 0 count as 0.

`original`: Hoffmann's term (eq. oa_original) at its published gains. Nothing regulates it, and
it knows neither the obstacle's size nor the clearance asked for.

tau multiplies the spring within a fixed time, and is the length of the way through the
centres, plus twice the greatest width and the clearance, over the baseline: that is the
released code. The print has tau z' = ..., tau x' = z for tau T, with the way through the obstacles'
extreme points. With the authors' own network on the paper's novel scenes the print's law misses
the goal by 25-50 mm on average, where Table II has 0.4-0.6 mm: near the goal the coupling acts
on. The released law with the released tau, over 3 s (1,000 steps of 3 ms, as in the training
set), misses it by 2-5 mm, and by 0.3-3 mm if all centres stay 30 cm from start and goal, the
nearest of the combinations tried. The price is clearance, which a stronger spring takes: 0.114,
0.160, 0.179, 0.195 m on average at the four baselines, where the print's law and tau keep 0.150,
0.194, 0.211, 0.220 m and Table II has 0.144, 0.184, 0.196, 0.202 m.
"""

from __future__ import annotations

import math
from functools import cache
from itertools import pairwise
from time import perf_counter
from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from drake_oa.common.messages import FloatArray
from drake_oa.geometry.ellipsoid import plane_section
from drake_oa.policy.coupling import dead_zone_free_rate, original_rate
from drake_oa.regulation.regressor import ChainWeights, load_chain
from drake_oa.scenario.loading import package_file
from drake_oa.studies.scenes.methods import Motions, Setting
from drake_oa.studies.scenes.scenes import Scenes

ALPHA_X, BETA_X, ALPHA_K, N_BASIS = 10.0, 2.5, 0.5, 35
"""Constants of the released code."""
GAMMA, BETA = 1000.0, 20.0 / math.pi
"""Hoffmann's published gains [1/s] and [1/rad]."""

_PARALLEL = 1e-9
"""Sine of the angle below which two directions span no plane."""
_SAME = 1e-9
"""By how much lambda' has to change for the chain to be asked again [m]."""
_NARROWEST = 1e-6
"""Least psi [rad]."""
_LOST = 1e4
"""Speed at which a motion has diverged [m/s]: it is held where it is."""
_STILL = 1e-5
"""Speed below which the released code lets no coupling act [m/s]."""


class Steps(NamedTuple):
    """`number` steps of `length` seconds."""

    number: int
    length: float


STEPS = Steps(1000, 0.003)
"""Those that come nearest to the paper's Table II."""


def run(scenes: Scenes, setting: Setting) -> Motions:
    """The paper's method with the chains that the paper's recipe trained.

    Args:
        scenes: N scenes.
        setting: whether the chain is told Delta, and whether tau scales the spring.

    Raises:
        FileNotFoundError: if the weights are missing.
    """
    return regulated_motions(scenes, setting, paper_chain(setting.constrained))


def run_original(scenes: Scenes, setting: Setting) -> Motions:
    """Hoffmann's term in N scenes; of the setting, only whether tau scales the spring counts."""
    return constant_motions(scenes, setting, np.array((GAMMA, BETA, 0.0)), original=True)


@cache
def paper_chain(constrained: bool) -> ChainWeights:
    """RC(lambda', Delta) or RC(lambda') as shipped, trained by the paper's recipe.

    Raises:
        FileNotFoundError: if the weights are missing.
        ValueError: if the file is none of `save_chain`.
    """
    name = "paper_chain" if constrained else "paper_chain_unconstrained"
    return load_chain(package_file(f"package://drake_oa/weights/{name}.safetensors"))


def regulated_motions(
    scenes: Scenes, setting: Setting, chain: ChainWeights, steps: Steps = STEPS
) -> Motions:
    """The paper's method with a given chain of 2 or 3 inputs, in metres."""
    parameters = np.zeros((*scenes.center.shape[:2], 3))
    return _motions(scenes, setting, steps, parameters, chain)


def constant_motions(
    scenes: Scenes,
    setting: Setting,
    parameters: FloatArray,
    *,
    original: bool = False,
    steps: Steps = STEPS,
) -> Motions:
    """The same action level with given parameters.

    Args:
        scenes: N scenes.
        setting: of it, only whether tau scales the spring.
        parameters: (3,), or (N, M, 3): alpha [rad/s], psi [rad] and kappa [1/m^2]; for the
            original term gamma [1/s], beta [1/rad] and a value without a meaning.
        original: whether the term is that of (eq. oa_original).
        steps: of the policy.
    """
    full = np.broadcast_to(parameters, (*scenes.center.shape[:2], 3)).copy()
    return _motions(scenes, setting, steps, full, None, original)


def spring_scale(scenes: Scenes) -> FloatArray:
    """(N,) tau, from the obstacles as they stand at t = 0; 1 without obstacles.

    For several obstacles the spectral norms of the matrices of centres from start and to goal
    take the place of the distances, as in the released code.
    """
    there, goal = scenes.present[..., None], scenes.goal[:, None]
    if not there.any():
        return np.ones(len(scenes))
    ways = (np.where(there, scenes.center, 0.0), np.where(there, goal - scenes.center, 0.0))
    length = sum(np.linalg.norm(way, 2, axis=(1, 2)) for way in ways)
    widest = 2.0 * np.where(there, scenes.semi_axes, 0.0).max(axis=(1, 2))
    tau = (length + 2.0 * (widest + scenes.clearance)) / scenes.baseline
    return np.where(there.any(axis=(1, 2)), tau, 1.0)


@cache
def released_forcing(steps: Steps = STEPS) -> FloatArray:
    """(S,) forcing term of the released code for a straight demonstration over 1 m [m/s^2].

    The demonstration runs at constant speed over all steps. Its force is fitted by a
    quadratic in the phase for each of the basis functions, which are Gaussians of the
    mean and variance of the phase in equal parts of its range.
    """
    k = (1.0 - ALPHA_K * steps.length) ** np.arange(steps.number)
    speed = 1.0 / ((steps.number - 1) * steps.length)
    force = ALPHA_X * (speed - BETA_X * (1.0 - np.linspace(0.0, 1.0, steps.number)))
    edges = np.linspace(k.min(), k.max(), N_BASIS + 1)
    parts = [k[(k >= a) & (k < b)] for a, b in pairwise(edges)]
    mean = np.array([part.mean() for part in parts])[:, None]
    variance = np.array([part.var(ddof=1) + 1e-8 for part in parts])[:, None]
    basis = np.exp(-0.5 * (k - mean) ** 2 / variance) / np.sqrt(variance)
    basis /= basis.sum(axis=0)
    powers = np.column_stack((np.ones(steps.number), k, k * k))
    fitted = np.zeros(steps.number)
    for share in basis:
        root = np.sqrt(share)
        fit = np.linalg.lstsq(powers * root[:, None], force * root, rcond=None)[0]
        fitted += share * (powers @ fit)
    return fitted


def section_axes(
    to_O: FloatArray, normal: FloatArray, R: FloatArray, semi_axes: FloatArray
) -> FloatArray:
    """(K, 2) lambda1', lambda2' of K ellipsoids' sections through their centres [m].

    lambda1' is the one within 45 degrees of the baseline's (the x axis') projection into the
    plane, or of the way to the centre where the plane is square to it.

    Args:
        to_O: (K, 3) ways to the centres, in the planes [m].
        normal: (K, 3) unit normals of the planes.
        R: (K, 3, 3) principal axes in the columns.
        semi_axes: (K, 3) [m].
    """
    along = np.array((1.0, 0.0, 0.0)) - normal[:, :1] * normal
    square = np.linalg.norm(along, axis=1) <= _PARALLEL
    along[square] = to_O[square]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return plane_section(R, semi_axes, along, np.cross(normal, along)).semi_axes


# Small matrices: more threads only wait for each other.
@threadpool_limits.wrap(limits=1)
def _motions(
    scenes: Scenes,
    setting: Setting,
    steps: Steps,
    parameters: FloatArray,
    chain: ChainWeights | None,
    original: bool = False,
) -> Motions:
    """Rolls out all scenes together; `parameters` (N, M, 3) are the chain's if there is one."""
    forcing, h = released_forcing(steps), steps.length
    begin = perf_counter()
    N, there = len(scenes), scenes.present
    center, drift, semi_axes = (
        np.where(there[..., None], values, 1.0)
        for values in (scenes.center, scenes.velocity, scenes.semi_axes)
    )
    tau = spring_scale(scenes) if setting.scale_time else np.ones(N)
    spring = (ALPHA_X * tau**2)[:, None]
    normal, seen = np.zeros_like(center), np.full((*there.shape, 2), -1.0)
    normal[..., 2] = 1.0
    path, velocity = np.zeros((2, N, steps.number + 1, 3))
    x, v, lost = np.zeros((N, 3)), np.zeros((N, 3)), np.zeros(N, bool)
    for step, force in enumerate(forcing):
        to_O = center + step * h * drift - x[:, None]
        d, speed = np.linalg.norm(to_O, axis=2), np.linalg.norm(v, axis=1)[:, None]
        acts = there & (speed >= _STILL) & (d > 0.0)
        r = np.cross(to_O, v[:, None])
        size = np.linalg.norm(r, axis=2)
        spans = acts & (size > _PARALLEL * d * speed)
        normal[spans] = r[spans] / size[spans, None]
        if chain is not None and acts.any():
            n, m = np.nonzero(acts)
            axes = section_axes(to_O[n, m], normal[n, m], scenes.R[n, m], semi_axes[n, m])
            moved = np.abs(axes - seen[n, m]).max(axis=1) > _SAME
            n, m, axes = n[moved], m[moved], axes[moved]
            seen[n, m] = axes
            inputs = np.column_stack([axes, scenes.clearance[n]])[:, : len(chain.lower)]
            parameters[n, m] = chain.evaluate(inputs)
        alpha, psi, kappa = np.moveaxis(parameters, 2, 0)
        cosine = np.einsum("nmi,ni->nm", to_O, v) / np.where(acts, d * speed, 1.0)
        theta = np.arccos(np.clip(cosine, -1.0, 1.0))
        if original:
            rate = original_rate(theta, alpha, psi)
        else:
            width = np.maximum(np.abs(psi), _NARROWEST)
            rate = dead_zone_free_rate(
                theta, d, np.maximum(alpha, 0.0), width, np.maximum(kappa, 0.0)
            )
        push = np.cross(normal, v[:, None]) * np.where(acts, rate, 0.0)[..., None]
        a = spring * (BETA_X * (scenes.goal - x) - v) + push.sum(axis=1)
        a[:, 0] += scenes.baseline * force
        v = v + h * a
        lost |= ~(np.abs(v).sum(axis=1) < _LOST)
        v[lost] = 0.0
        x = x + h * v
        path[:, step + 1], velocity[:, step + 1] = x, v
    seconds = perf_counter() - begin
    return Motions(path, velocity, np.full(N, steps.number * h), seconds)
