"""The methods `paper` and `original`: the paper's action level, as print and released code tell.

The action level is that of `drake_oa.training.released_law`, with the avoidance term about each
obstacle's center. Print and released code leave open how tau is computed and when a motion ends;
the reading here agrees best with the paper's Table II: tau counts the way through the center plus
twice the greatest semi-axis and Delta, and a motion goes on from T on until it is within 0.4 mm of
the goal, to 2 T at most.

`paper`: (eq. 8) with the regressor chain's parameters at lambda' and Delta, asked again
in each step. lambda' are the principal semi-axes of the obstacle's section by the P-plane of
(p_obs - p, v); lambda1' is the one within 45 degrees of the baseline, as in the training set and
the released code. (Taken along the way to the center instead, the two would change places whenever
an obstacle is passed.) Where way and velocity span no plane, the last plane stands in, at first
the horizontal one, as in the released code. The route is not guided: the paper's synthetic
experiments have neither table nor workspace. Alpha and kappa below 0 count as 0.

`original`: Hoffmann's term (eq. 7) at its published gains. Nothing regulates it, and
it knows neither the obstacle's size nor the clearance asked for.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
from threadpoolctl import threadpool_limits

from drake_oa.common.files import package_file
from drake_oa.common.messages import FloatArray
from drake_oa.evaluation.scenes.scenes import Motions, Scenes, Setting
from drake_oa.geometry.ellipsoid import plane_section
from drake_oa.inference.regressor import ChainWeights, load_chain, plane_axes
from drake_oa.training.released_law import STEPS, ReleasedMotions, Steps

GAMMA, BETA = 1000.0, 20.0 / math.pi
"""Hoffmann's published gains [1/s] and [1/rad]."""

_PARALLEL = 1e-9
"""Sine of the angle below which two directions span no plane."""
_SAME = 1e-9
"""Change of a plane's unit normal from which on the chain is evaluated again."""
_ENDLESS = 1e3
"""Half the length of a cylinder [m]."""

ARRIVED = 4e-4
"""Distance to the goal at which a motion ends from T on [m]."""
LONGEST = 2
"""Maximum duration of a motion, in T."""

SHIPPED = ("paper_chain", "paper_chain_unconstrained", "paper_chain_running")
"""Weights trained by the paper's recipe: with Delta, without it, and on the running system's action
level."""


def run(scenes: Scenes, setting: Setting) -> Motions:
    """Runs the paper's method with the chains that the paper's recipe trained.

    Args:
        scenes: N scenes.
        setting: whether the chain has the input Delta, and whether tau scales the spring.

    Raises:
        FileNotFoundError: if the weights are missing.
    """
    chain = paper_chain(SHIPPED[0] if setting.constrained else SHIPPED[1])
    return released_motions(scenes, setting, np.zeros(3), chain=chain)


def run_original(scenes: Scenes, setting: Setting) -> Motions:
    """Runs Hoffmann's term in N scenes; the setting decides only whether tau scales the spring."""
    return released_motions(scenes, setting, np.array((GAMMA, BETA, 0.0)), original=True)


@cache
def paper_chain(name: str) -> ChainWeights:
    """Loads one of the chains `SHIPPED`.

    Raises:
        FileNotFoundError: if the weights are missing.
        ValueError: if the file is none of `save_chain`.
    """
    return load_chain(package_file(f"package://drake_oa/weights/{name}.safetensors"))


def time_scale(scenes: Scenes) -> FloatArray:
    """Computes (N,) tau: the way through the center, past the greatest semi-axis and Delta."""
    to_O, to_goal = scenes.center, scenes.goal - scenes.center
    way = np.linalg.norm(to_O, axis=1) + np.linalg.norm(to_goal, axis=1)
    return (way + 2.0 * (scenes.semi_axes.max(axis=1) + scenes.clearance)) / scenes.baseline


def sections(scenes: Scenes) -> Scenes:
    """Returns the scenes with cylinders over the obstacles' sections in the obstacles' place.

    The planes are those in which the motion sets out, through the baseline and a center; of a
    center on the baseline the horizontal one. In them the distance to a cylinder is that to the
    section.
    """
    out = scenes.center * (0.0, 1.0, 1.0)
    size = np.linalg.norm(out, axis=1, keepdims=True)
    out = np.where(size <= _PARALLEL, (0.0, 1.0, 0.0), out / np.where(size > 0.0, size, 1.0))
    e1 = np.tile((1.0, 0.0, 0.0), (len(out), 1))
    semi_axes, axes = plane_section(scenes.R, scenes.semi_axes, e1, out)
    first, second = np.moveaxis(axes, 1, 0)
    R = np.stack([first, second, np.cross(first, second)], axis=2)
    semi_axes = np.column_stack([semi_axes, np.full(len(out), _ENDLESS)])
    return replace(scenes, R=R, semi_axes=semi_axes)


# Small matrices: more threads only wait for each other.
@threadpool_limits.wrap(limits=1)
def released_motions(
    scenes: Scenes,
    setting: Setting,
    parameters: FloatArray,
    *,
    original: bool = False,
    chain: ChainWeights | None = None,
    steps: Steps = STEPS,
) -> Motions:
    """Rolls out all scenes together; motions that have ended stay at rest.

    Args:
        scenes: N scenes.
        setting: of it, only whether tau scales the spring.
        parameters: (3,) alpha [rad/s], psi [rad] and kappa [1/m^2]; for the original term
            gamma [1/s], beta [1/rad] and a value without a meaning.
        original: whether the term is that of (eq. 7).
        chain: gives the parameters in every step; None: they are constant.
        steps: time steps.
    """
    tau = time_scale(scenes) if setting.scale_time else np.ones(len(scenes))
    motions = ReleasedMotions(scenes.baseline, scenes.center, tau, steps=steps, original=original)
    seen = np.zeros_like(scenes.center)
    parameters = np.tile(parameters, (len(scenes), 1))
    path, velocity = [motions.position], [motions.velocity]
    while motions.number < LONGEST * steps.number and not motions.is_over.all():
        if chain is not None:
            turned = np.abs(motions.normal - seen).max(axis=1) > _SAME
            n = np.flatnonzero(turned & (motions.distance > 0.0))
            seen[n] = normal = motions.normal[n]
            to_O = scenes.center[n] - path[-1][n]
            # lambda1' is the one within 45 degrees of the baseline.
            plane = np.moveaxis(plane_axes(np.array((1.0, 0.0, 0.0)), to_O, normal), 1, 0)
            axes, _ = plane_section(scenes.R[n], scenes.semi_axes[n], *plane)
            inputs = np.column_stack([axes, scenes.clearance[n]])[:, : len(chain.lower)]
            parameters[n] = np.maximum(chain.evaluate(inputs), (0.0, -np.inf, 0.0))
        motions.advance(parameters)
        if motions.number >= steps.number:
            missing = np.linalg.norm(motions.position - scenes.goal, axis=1)
            motions.is_over |= missing <= ARRIVED
        path.append(motions.position)
        velocity.append(motions.velocity)
    duration = np.full(len(scenes), motions.number * steps.length)
    return Motions(np.stack(path, 1), np.stack(velocity, 1), duration)
