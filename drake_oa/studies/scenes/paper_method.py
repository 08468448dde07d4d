"""The methods `paper` and `original`: the paper's action level, as print and released code tell.

The action level is that of `drake_oa.training.released_law`, with the avoidance term about each
obstacle's center. What print and released code leave open is a `Reading`.

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
from dataclasses import replace
from functools import cache
from time import perf_counter

import numpy as np
from threadpoolctl import threadpool_limits

from drake_oa.common.compiled import kernel_arrays
from drake_oa.common.messages import FloatArray
from drake_oa.geometry.ellipsoid import plane_section
from drake_oa.policy.config import Policy
from drake_oa.policy.coupling import ALPHA, KAPPA, N_COLUMNS, NORMAL, PSI
from drake_oa.policy.dmp import imitate, minimum_jerk
from drake_oa.policy.rollout import roll_out_tool
from drake_oa.regulation.regressor import ChainWeights, load_chain
from drake_oa.scenario.shipped import package_file
from drake_oa.studies.scenes.reading import READING, Reading
from drake_oa.studies.scenes.scenes import DURATION, Motions, Scenes, Setting, posed_scenes
from drake_oa.training.released_law import (
    ALPHA_X,
    BETA_X,
    STEPS,
    Law,
    Motion,
    Steps,
    advance,
    released_forcing,
)

GAMMA, BETA = 1000.0, 20.0 / math.pi
"""Hoffmann's published gains [1/s] and [1/rad]."""

_PARALLEL = 1e-9
"""Sine of the angle below which two directions span no plane."""
_SAME = 1e-9
"""Change of a plane's unit normal from which on the chain is evaluated again."""
_ENDLESS = 1e3
"""Half the length of a cylinder [m]."""

ARRIVED = 4e-4
"""How near to the goal a motion ends that goes on until it has arrived [m]."""
LONGEST = 2
"""How long it goes on at most, in durations."""


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
    return released_motions(scenes, setting, np.zeros(3), reading=reading, chain=chain)


def run_original(scenes: Scenes, setting: Setting) -> Motions:
    """Hoffmann's term in N scenes; of the setting, only whether tau scales the spring counts."""
    return released_motions(scenes, setting, np.array((GAMMA, BETA, 0.0)), original=True)


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
def released_motions(
    scenes: Scenes,
    setting: Setting,
    parameters: FloatArray,
    *,
    original: bool = False,
    reading: Reading = READING,
    chain: ChainWeights | None = None,
) -> Motions:
    """Rolls out all scenes together; motions that have ended stay at rest.

    Args:
        scenes: N scenes.
        setting: of it, only whether tau scales the spring.
        parameters: (3,), or (N, M, 3): alpha [rad/s], psi [rad] and kappa [1/m^2]; for the
            original term gamma [1/s], beta [1/rad] and a value without a meaning.
        original: whether the term is that of (eq. 7).
        reading: of the action level, not the running law.
        chain: gives the parameters in every step; None: they are constant.
    """
    steps = STEPS[reading.steps]
    begin = perf_counter()
    N = len(scenes)
    tau = time_scale(scenes, reading) if setting.scale_time else np.ones(N)
    printed = reading.law == "printed"
    # tau^2 times the spring, or tau times the duration: the forces outside it count 1 / tau^2.
    factor = 1.0 / tau if printed else tau
    h = steps.length * (tau if printed else np.ones(N))
    baseline, center, drift = kernel_arrays(scenes.baseline, scenes.center, scenes.velocity)
    law = Law(
        baseline=baseline,
        center=center,
        drift=drift,
        stiffness=ALPHA_X * BETA_X * factor**2,
        damping=ALPHA_X * (factor if printed else factor**2),
        outside=factor**2 if printed else np.ones(N),
        step=h,
        original=original,
    )
    last = _last_step(reading, steps, tau)
    forcing = np.zeros(int(last.max(initial=1)))
    forcing[: steps.number] = released_forcing(steps)[: len(forcing)]
    motion = Motion.at_rest(N, center.shape[1], len(forcing))
    seen = np.zeros((*scenes.present.shape, 3))
    parameters = np.broadcast_to(parameters, seen.shape).copy()
    done = 0
    while done < len(forcing) and not motion.over.all():
        if chain is not None:
            turned = np.abs(motion.normal - seen).max(axis=2) > _SAME
            n, m = np.nonzero(turned & (motion.distance > 0.0))
            seen[n, m] = normal = motion.normal[n, m]
            to_O = scenes.center[n, m] + (done * h[n, None]) * scenes.velocity[n, m]
            to_O -= motion.path[n, done]
            axes = section_axes(to_O, normal, scenes.R[n, m], scenes.semi_axes[n, m])
            L = scenes.baseline[n]
            parameters[n, m] = _asked(chain, axes, scenes.clearance[n], L, reading)
        advance(0, 1, done, forcing[done : done + 1], law, parameters, motion)
        done += 1
        motion.over[:] |= done >= last
        if reading.time == "until-arrived" and done >= steps.number:
            missing = np.linalg.norm(motion.path[:, done] - scenes.goal, axis=1)
            motion.over[:] |= missing <= ARRIVED
    seconds = perf_counter() - begin
    path, velocity = motion.path[:, : done + 1], motion.velocity[:, : done + 1]
    return Motions(path, velocity, done * h, seconds)


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
    terms[:, PSI] = np.maximum(np.abs(found[:, 1]), 1e-6)
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
