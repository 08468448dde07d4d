"""The methods `paper` and `original`: the paper's action level, as print and released code tell.

Action level: alpha_x 10, beta_x 2.5, alpha_k 0.5, 35 basis functions of local quadratics,
a straight demonstration at constant speed, semi-implicit Euler, the avoidance term about each
obstacle's centre, summed. What print and released code leave open is a `Reading`.

`paper`: (eq. 8) with the regressor chain's parameters at lambda' and Delta, asked again
in each step. lambda' are the principal semi-axes of the obstacle's section by the P-plane of
(p_obs - p, v); lambda1' is the one within 45 degrees of the baseline, as in the training set and
the released code. (Taken along the way to the centre instead, the two would change places whenever
an obstacle is passed.) Where way and velocity span no plane, the last plane stands in, at first
the horizontal one, as in the released code. The route is not guided: the paper's synthetic
experiments have neither table nor workspace. Alpha and kappa below 0 count as 0.

`original`: Hoffmann's term (eq. 7) at its published gains. Nothing regulates it, and
it knows neither the obstacle's size nor the clearance asked for.

What each reading comes to beside the print: `drake-oa evaluate table2 --ablation`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from time import perf_counter
from typing import Literal, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from drake_oa.common.messages import FloatArray
from drake_oa.geometry.ellipsoid import plane_section
from drake_oa.policy.config import Policy
from drake_oa.policy.coupling import (
    ALPHA,
    KAPPA,
    N_COLUMNS,
    NORMAL,
    PSI,
    dead_zone_free_rate,
    original_rate,
)
from drake_oa.policy.dmp import imitate, minimum_jerk
from drake_oa.policy.rollout import roll_out_tool
from drake_oa.regulation.regressor import ChainWeights, load_chain
from drake_oa.scenario.shipped import package_file
from drake_oa.studies.scenes.scenes import DURATION, Motions, Scenes, Setting, posed_scenes

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
_ENDLESS = 1e3
"""Half the length of a cylinder [m]."""
_STILL = 1e-5
"""Speed below which the released code lets no coupling act [m/s]."""


class Steps(NamedTuple):
    """`number` steps of `length` seconds."""

    number: int
    length: float


STEPS = {"training": Steps(1000, 0.003), "demo": Steps(500, 0.005)}
"""In which the motions of the training set advance, and those of the released demo program."""
ARRIVED = 4e-4
"""How near to the goal a motion ends that goes on until it has arrived [m]."""
LONGEST = 2
"""How long it goes on at most, in durations."""


@dataclass(frozen=True, kw_only=True)
class Reading:
    """What the paper's print and the released code leave open; the default agrees best.

    With T the demonstrated duration and C the coupling terms:

    Attributes:
        law: released: a = tau^2 alpha_x (beta_x (g - x) - v) + f + C, the released code;
            printed: tau z' = alpha_x (beta_x (g - x) - z) + f + C, tau x' = z; running: the
            running system's primitive and exact turns (one obstacle a scene).
        tau: length of the avoiding path over the baseline. widths: through the centre, and twice
            the greatest width and Delta, the released code; semi-axes: the same with the greatest
            semi-axis; extreme: through the extreme points of the sections, the print.
        time: when a motion ends. fixed: after T; tau: after tau T; until-arrived: after T as
            soon as it has arrived, after 2 T at the latest (printed: tau T and 2 tau T).
        chain: on which action level its training set went, that of the released code or the
            running system's.
        scale: in what the chain is asked: metres, in its trained range or not; or baselines, and
            then, as the running system asks, at the nearest input of that range.
        steps: training: 1,000 of 3 ms, as in the training set; demo: 500 of 5 ms, as in the
            released demo program.
    """

    law: Literal["released", "printed", "running"] = "released"
    tau: Literal["widths", "semi-axes", "extreme"] = "semi-axes"
    time: Literal["fixed", "tau", "until-arrived"] = "until-arrived"
    chain: Literal["released", "running"] = "released"
    scale: Literal["metres", "baselines"] = "metres"
    steps: Literal["training", "demo"] = "training"


READING = Reading()
"""That agrees best with the paper's Table II."""


def run(scenes: Scenes, setting: Setting, reading: Reading = READING) -> Motions:
    """The paper's method with the chains that the paper's recipe trained.

    Args:
        scenes: N scenes.
        setting: whether the chain is told Delta, and whether tau scales the spring.
        reading: of print and released code.

    Raises:
        FileNotFoundError: if the weights are missing.
        ValueError: for a chain that is not shipped, or several obstacles with the running law.
    """
    chain = paper_chain(setting.constrained, reading.chain)
    if reading.law == "running":
        return _running_motions(scenes, setting, chain, reading)
    parameters = np.zeros((*scenes.center.shape[:2], 3))
    return _motions(scenes, setting, reading, parameters, chain)


def run_original(scenes: Scenes, setting: Setting) -> Motions:
    """Hoffmann's term in N scenes; of the setting, only whether tau scales the spring counts."""
    return constant_motions(scenes, setting, np.array((GAMMA, BETA, 0.0)), original=True)


@cache
def paper_chain(constrained: bool, trained_on: str = "released") -> ChainWeights:
    """RC(lambda', Delta) or RC(lambda') as shipped, trained by the paper's recipe.

    Raises:
        FileNotFoundError: if the weights are missing.
        ValueError: if there is no such chain, or the file is none of `save_chain`.
    """
    name = SHIPPED.get((constrained, trained_on))
    if name is None:
        raise ValueError("no chain RC(lambda'), without Delta, went on the running action level")
    return load_chain(package_file(f"package://drake_oa/weights/{name}.safetensors"))


SHIPPED = {
    (True, "released"): "paper_chain",
    (False, "released"): "paper_chain_unconstrained",
    (True, "running"): "paper_chain_running",
}
"""Whether it is told Delta and what its training set went on -> the shipped file's name."""


def constant_motions(
    scenes: Scenes,
    setting: Setting,
    parameters: FloatArray,
    *,
    original: bool = False,
    reading: Reading = READING,
) -> Motions:
    """The same action level with given parameters.

    Args:
        scenes: N scenes.
        setting: of it, only whether tau scales the spring.
        parameters: (3,), or (N, M, 3): alpha [rad/s], psi [rad] and kappa [1/m^2]; for the
            original term gamma [1/s], beta [1/rad] and a value without a meaning.
        original: whether the term is that of (eq. 7).
        reading: of it, not the running law, and neither chain nor scale.
    """
    full = np.broadcast_to(parameters, (*scenes.center.shape[:2], 3)).copy()
    return _motions(scenes, setting, reading, full, None, original)


def time_scale(scenes: Scenes, reading: Reading = READING) -> FloatArray:
    """(N,) tau, from the obstacles as they stand at t = 0; 1 without obstacles.

    For several obstacles the spectral norms of the matrices of centres from start and to goal
    take the place of the distances, as in the released code.
    """
    there, goal = scenes.present[..., None], scenes.goal[:, None]
    if not there.any():
        return np.ones(len(scenes))
    if reading.tau == "extreme":
        length = _way_past(scenes)
    else:
        ways = (np.where(there, scenes.center, 0.0), np.where(there, goal - scenes.center, 0.0))
        length = sum(np.linalg.norm(way, 2, axis=(1, 2)) for way in ways)
        widest = np.where(there, scenes.semi_axes, 0.0).max(axis=(1, 2))
        widest = 2.0 * widest if reading.tau == "widths" else widest
        length = length + 2.0 * (widest + scenes.clearance)
    return np.where(there.any(axis=(1, 2)), length / scenes.baseline, 1.0)


def sections(scenes: Scenes) -> Scenes:
    """The same scenes with cylinders over the obstacles' sections in the obstacles' place.

    The planes are those in which the motion sets out; in them the distance to a cylinder is that
    to the section.
    """
    _, out, _ = _start_sections(scenes)
    there = scenes.present
    e1 = np.broadcast_to((1.0, 0.0, 0.0), out.shape)
    cut = plane_section(scenes.R[there], scenes.semi_axes[there], e1[there], out[there])
    R, semi_axes = scenes.R.copy(), scenes.semi_axes.copy()
    R[there] = np.stack([cut.axes[:, 0], cut.axes[:, 1], np.cross(*np.moveaxis(cut.axes, 1, 0))], 2)
    semi_axes[there] = np.column_stack([cut.semi_axes, np.full(len(cut.semi_axes), _ENDLESS)])
    return replace(scenes, R=R, semi_axes=semi_axes)


def _way_past(scenes: Scenes) -> FloatArray:
    """(N,) start, extreme points of the sections toward the baseline, goal: its length [m]."""
    axes, out, _ = _start_sections(scenes)
    goal = scenes.goal[:, None]
    points = np.where(scenes.present[..., None], scenes.center - axes[..., 1:] * out, goal)
    points = np.take_along_axis(points, np.argsort(points[..., :1], axis=1), axis=1)
    way = np.concatenate([np.zeros_like(goal), points, goal], axis=1)
    return np.asarray(np.linalg.norm(np.diff(way, axis=1), axis=2).sum(axis=1))


def _start_sections(scenes: Scenes) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sections by the planes in which the motion sets out, along the baseline.

    Returns:
        (N, M, 2) lambda', (N, M, 3) directions from the baseline to the centres, and (N, M, 3)
        normals; of a centre on the baseline the plane is the horizontal one.
    """
    out = np.where(scenes.present[..., None], scenes.center, 0.0)
    out[..., 0] = 0.0
    size = np.linalg.norm(out, axis=2, keepdims=True)
    ahead = size <= _PARALLEL
    out = np.where(ahead, (0.0, 1.0, 0.0), out / np.where(ahead, 1.0, size))
    normal = np.cross((1.0, 0.0, 0.0), out)
    axes = np.ones((*out.shape[:2], 2))
    there = scenes.present
    axes[there] = section_axes(
        scenes.center[there], normal[there], scenes.R[there], scenes.semi_axes[there]
    )
    return axes, out, normal


@cache
def released_forcing(steps: Steps) -> FloatArray:
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


def _asked(
    chain: ChainWeights, axes: FloatArray, clearance: FloatArray, L: FloatArray, reading: Reading
) -> FloatArray:
    """(K, 3) alpha [rad/s], psi, kappa [1/m^2] for K sections lambda' (K, 2) [m]."""
    unit = L if reading.scale == "baselines" else np.ones(len(L))
    inputs = np.column_stack([axes, clearance]) / unit[:, None]
    inputs = inputs[:, : len(chain.lower)]
    if reading.scale == "baselines":
        inputs = np.clip(inputs, chain.lower, chain.upper)
    found = chain.evaluate(inputs)
    duration = DURATION if reading.chain == "running" else 1.0
    return np.asarray(
        found / np.column_stack([np.full(len(L), duration), np.ones(len(L)), unit**2])
    )


# Small matrices: more threads only wait for each other.
@threadpool_limits.wrap(limits=1)
def _motions(
    scenes: Scenes,
    setting: Setting,
    reading: Reading,
    parameters: FloatArray,
    chain: ChainWeights | None,
    original: bool = False,
) -> Motions:
    """Rolls out all scenes together; `parameters` (N, M, 3) are the chain's if there is one.

    What has ended stays where it is.
    """
    steps = STEPS[reading.steps]
    begin = perf_counter()
    N, there = len(scenes), scenes.present
    center, drift, semi_axes = (
        np.where(there[..., None], values, 1.0)
        for values in (scenes.center, scenes.velocity, scenes.semi_axes)
    )
    tau = time_scale(scenes, reading) if setting.scale_time else np.ones(N)
    printed = reading.law == "printed"
    h = steps.length * (tau if printed else np.ones(N))[:, None]
    last = _last_step(reading, steps, tau)
    forcing = np.zeros(int(last.max(initial=1)))
    forcing[: steps.number] = released_forcing(steps)[: len(forcing)]
    # tau^2 times the spring, or tau times the duration: the forces outside it count 1 / tau^2.
    factor = 1.0 / tau[:, None] if printed else tau[:, None]
    stiffness = ALPHA_X * BETA_X * factor**2
    damping = ALPHA_X * (factor if printed else factor**2)
    outside = factor**2 if printed else 1.0
    normal, seen = np.zeros_like(center), np.full((*there.shape, 2), -1.0)
    normal[..., 2] = 1.0
    path, velocity = np.zeros((2, N, len(forcing) + 1, 3))
    x, v, over = np.zeros((N, 3)), np.zeros((N, 3)), np.zeros(N, bool)
    step = 0
    for step, force in enumerate(forcing, start=1):
        to_O = center + (step - 1) * h[..., None] * drift - x[:, None]
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
            L = scenes.baseline[n]
            parameters[n, m] = _asked(chain, axes, scenes.clearance[n], L, reading)
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
        outer = push.sum(axis=1)
        outer[:, 0] += scenes.baseline * force
        v = v + h * (stiffness * (scenes.goal - x) - damping * v + outside * outer)
        over |= ~(np.abs(v).sum(axis=1) < _LOST)
        v[over] = 0.0
        x = x + h * v
        path[:, step], velocity[:, step] = x, v
        over |= step >= last
        if reading.time == "until-arrived" and step >= steps.number:
            over |= np.linalg.norm(x - scenes.goal, axis=1) <= ARRIVED
        if over.all():
            break
    seconds = perf_counter() - begin
    return Motions(path[:, : step + 1], velocity[:, : step + 1], step * h[:, 0], seconds)


def _last_step(reading: Reading, steps: Steps, tau: FloatArray) -> FloatArray:
    """(N,) steps until each motion ends at the latest."""
    if reading.time == "until-arrived":
        return np.full(len(tau), LONGEST * steps.number)
    # Steps of the print's law are tau times as long.
    lasting = (tau if reading.time == "tau" else 1.0) / (tau if reading.law == "printed" else 1.0)
    return np.asarray(np.ceil(steps.number * np.broadcast_to(lasting, tau.shape) - 1e-9))


def _running_motions(
    scenes: Scenes, setting: Setting, chain: ChainWeights, reading: Reading
) -> Motions:
    """The same chain where the running system's action level goes."""
    if scenes.center.shape[1] != 1 or not scenes.present.all():
        raise ValueError("the running law is for scenes of one obstacle")
    begin, N, number = perf_counter(), len(scenes), STEPS["training"].number
    (axes,), _, (normal,) = (np.moveaxis(values, 1, 0) for values in _start_sections(scenes))
    found = _asked(chain, axes, scenes.clearance, scenes.baseline, reading)
    terms = np.zeros((N, N_COLUMNS))
    terms[:, :3], terms[:, NORMAL : NORMAL + 3] = scenes.center[:, 0], -normal
    terms[:, ALPHA] = np.maximum(found[:, 0], 0.0) * DURATION
    terms[:, PSI] = np.maximum(np.abs(found[:, 1]), _NARROWEST)
    terms[:, KAPPA] = np.maximum(found[:, 2], 0.0)
    seconds = DURATION * (time_scale(scenes, reading) if setting.scale_time else np.ones(N))
    horizon = float(LONGEST) if reading.time == "until-arrived" else 1.0
    dmp = imitate(*minimum_jerk(np.zeros(3), (1.0, 0.0, 0.0), duration=DURATION))
    path, velocity = np.empty((2, N, round(horizon * number) + 1, 3))
    for row, scene in enumerate(posed_scenes(scenes, scenes.clearance)):
        rolled = roll_out_tool(
            scene,
            terms[row, None, None],
            dmp=dmp,
            policy=Policy(period=DURATION / number, fade=0.0),
            latest=horizon,
            tolerance=ARRIVED,
        )
        taken = int(rolled.steps[0])
        path[row] = rolled.path[0, np.minimum(np.arange(path.shape[1]), taken)]
        velocity[row, :taken] = rolled.velocity[0, :taken] / seconds[row]
        velocity[row, taken:] = 0.0
    return Motions(path, velocity, seconds * horizon, perf_counter() - begin)
