"""Methods `paper` and `original` on the action level of Pairet et al. and their released code.

Both avoid obstacles by a coupling term, which turns the motion away from the obstacle's center. The
action level (equations of motion) is that of `drake_oa.training.released_law`. Paper and released
code leave open how the temporal scaling tau is computed and when a motion ends. The interpretation
that agrees best with the paper's Table II: tau is an estimated path length, divided by the baseline
(distance from start to goal). This path length is that of the two lines from start to obstacle
center and from there to the goal, plus twice the sum of the obstacle's largest semi-axis and the
requested clearance Delta. A motion continues after the demonstrated duration T until it is within
0.4 mm of the goal, until 2 T at most.

`paper`: coupling term (eq. 8) whose parameters the regressor chain computes in each step from
lambda' and Delta. lambda' are the principal semi-axes of the obstacle's section with the P-plane,
which is spanned by p_obs - p and v (obstacle's center p_obs, position p and velocity v of the
motion). lambda1' is the semi-axis within 45 degrees of the line from start to goal, as in the
training set and the released code. (With p_obs - p instead of this line, lambda1' and lambda2'
would be exchanged whenever an obstacle is passed.) If p_obs - p and v span no plane, the previous
P-plane is used, initially the horizontal one, as in the released code. Passing sides are not
selected, as the paper's synthetic experiments have neither table nor workspace. Negative alpha and
kappa are replaced by 0.

`original`: Hoffmann's coupling term (eq. 7) at its published gains. It depends neither on the
obstacle's size nor on the requested clearance.
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

GAMMA = 1000.0
"""Published gain gamma of Hoffmann's coupling term, which avoids an obstacle by turning [1/s]."""
BETA = 20.0 / math.pi
"""Published decay beta of Hoffmann's coupling term [1/rad].

It acts on the angle between the heading and the direction of the obstacle's center."""

_PARALLEL = 1e-9
"""Distance up to which an obstacle's center counts as on the line from start to goal [m].

The initial P-plane is then horizontal."""
_MAX_NORMAL_CHANGE = 1e-9
"""Minimum change of the P-plane's normal that requires a new evaluation of the chain [-].

The P-plane contains the velocity and the direction of the obstacle's center. The regressor chain is
evaluated in a step if a component of the plane's unit normal differs by more than this value from
that at the last evaluation."""
_HALF_LENGTH = 1e3
"""Semi-axis, normal to the P-plane, of the ellipsoid that replaces an obstacle in `sections` [m].

Clearances in the P-plane are distances to this ellipsoid."""

ARRIVED = 4e-4
"""Distance to the goal below which a motion ends after its demonstrated duration [m]."""
LONGEST = 2
"""Maximum duration of a motion as a multiple of its demonstrated duration [-]."""

SHIPPED = ("paper_chain", "paper_chain_unconstrained", "paper_chain_running")
"""Names of the shipped regressor chains that were trained by the recipe of Pairet et al.

The first and the third chain have the requested clearance Delta as an input; the second does not.
The first two were trained on motions by the equations in the authors' released code, the third on
motions by the equations of this package (`drake_oa.policy`)."""


def run(scenes: Scenes, setting: Setting) -> Motions:
    """Computes motions by the method of Pairet et al., RA-L 2019, with a shipped regressor chain.

    The chain predicts the parameters of the coupling term, which turns a motion away from an
    obstacle.

    Args:
        scenes: N scenes.
        setting: `constrained`: whether the chain has the requested clearance Delta as an input;
            `scale_time`: whether spring and damper are multiplied by tau^2, with the temporal
            scaling tau (else tau = 1).

    Raises:
        FileNotFoundError: if a weights file is missing.
    """
    chain = paper_chain(SHIPPED[0] if setting.constrained else SHIPPED[1])
    return released_motions(scenes, setting, np.zeros(3), chain=chain)


def run_original(scenes: Scenes, setting: Setting) -> Motions:
    """Computes motions with Hoffmann's coupling term, which turns them away from an obstacle.

    Args:
        scenes: N scenes.
        setting: setting, of which only `scale_time` is used: whether spring and damper are
            multiplied by tau^2, with the temporal scaling tau (else tau = 1).
    """
    return released_motions(scenes, setting, np.array((GAMMA, BETA, 0.0)), original=True)


@cache
def paper_chain(name: str) -> ChainWeights:
    """Loads a shipped regressor chain, which predicts the parameters of a coupling term.

    Args:
        name: name of the chain, one of `SHIPPED`.

    Raises:
        FileNotFoundError: if the weights file is missing.
        ValueError: if the file was not written by `save_chain`.
    """
    return load_chain(package_file(f"package://drake_oa/weights/{name}.safetensors"))


def time_scale(scenes: Scenes) -> FloatArray:
    """Computes the temporal scaling tau of the motion in each of N scenes, (N,) [-].

    tau = (|center| + |goal - center| + 2 (largest semi-axis + Delta)) / baseline, with the
    requested clearance Delta, the distance `baseline` from start to goal, and the start at zero.
    """
    to_O, to_goal = scenes.center, scenes.goal - scenes.center
    way = np.linalg.norm(to_O, axis=1) + np.linalg.norm(to_goal, axis=1)
    return (way + 2.0 * (scenes.semi_axes.max(axis=1) + scenes.clearance)) / scenes.baseline


def sections(scenes: Scenes) -> Scenes:
    """Replaces each obstacle by a long ellipsoid with the same section in the initial P-plane.

    The initial P-plane contains the line from start to goal and the obstacle's center; for a center
    on this line it is horizontal. In this plane the distance to the ellipsoid is the distance to
    the section, so that clearances are measured in the plane.
    """
    out = scenes.center * (0.0, 1.0, 1.0)
    size = np.linalg.norm(out, axis=1, keepdims=True)
    out = np.where(size <= _PARALLEL, (0.0, 1.0, 0.0), out / np.where(size > 0.0, size, 1.0))
    e1 = np.tile((1.0, 0.0, 0.0), (len(out), 1))
    semi_axes, axes = plane_section(scenes.R, scenes.semi_axes, e1, out)
    first, second = np.moveaxis(axes, 1, 0)
    R = np.stack([first, second, np.cross(first, second)], axis=2)
    semi_axes = np.column_stack([semi_axes, np.full(len(out), _HALF_LENGTH)])
    return replace(scenes, R=R, semi_axes=semi_axes)


# With small matrices, additional BLAS threads would only wait for each other.
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
    """Rolls out (simulates) motions by the equations in the released code of Pairet et al.

    The motions in all scenes are simulated at once; those that have ended stay at rest.

    Args:
        scenes: N scenes.
        setting: setting, of which only `scale_time` is used: whether spring and damper are
            multiplied by tau^2, with the temporal scaling tau (else tau = 1).
        parameters: (3,) constant parameters alpha [rad/s], psi [rad] and kappa [1/m^2] of the
            coupling term; for the original term gamma [1/s], beta [1/rad] and an unused value.
        original: whether the coupling term is Hoffmann's, (7) of Pairet et al., RA-L 2019, instead
            of (8).
        chain: regressor chain that computes the parameters during the motion; None: they are
            constant.
        steps: number and length of the time steps of the demonstration.

    Returns:
        Motions from rest, until all have ended.
    """
    tau = time_scale(scenes) if setting.scale_time else np.ones(len(scenes))
    motions = ReleasedMotions(scenes.baseline, scenes.center, tau, steps=steps, original=original)
    previous = np.zeros_like(scenes.center)
    parameters = np.tile(parameters, (len(scenes), 1))
    path, velocity = [motions.position], [motions.velocity]
    while motions.number < LONGEST * steps.number and not motions.is_over.all():
        if chain is not None:
            has_turned = np.abs(motions.normal - previous).max(axis=1) > _MAX_NORMAL_CHANGE
            n = np.flatnonzero(has_turned & (motions.distance > 0.0))
            previous[n] = normal = motions.normal[n]
            to_O = scenes.center[n] - path[-1][n]
            # lambda1' is the semi-axis within 45 degrees of the baseline.
            plane = np.moveaxis(plane_axes(np.array((1.0, 0.0, 0.0)), to_O, normal), 1, 0)
            axes, _ = plane_section(scenes.R[n], scenes.semi_axes[n], *plane)
            inputs = np.column_stack([axes, scenes.clearance[n]])[:, : len(chain.lower)]
            parameters[n] = np.maximum(chain.evaluate(inputs), (0.0, -np.inf, 0.0))
        motions.advance(parameters)
        if motions.number >= steps.number:
            error = np.linalg.norm(motions.position - scenes.goal, axis=1)
            motions.is_over |= error <= ARRIVED
        path.append(motions.position)
        velocity.append(motions.velocity)
    duration = np.full(len(scenes), motions.number * steps.length)
    return Motions(np.stack(path, 1), np.stack(velocity, 1), duration)
