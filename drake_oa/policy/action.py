"""One step of the whole action level, as the DmpIntegrator takes it.

Composes the movement primitive (`drake_oa.policy.dmp`), the coupling terms
(`drake_oa.policy.coupling`), the headings of the guidance (`drake_oa.policy.guidance`), temporal
scaling (section IV-E of the paper) and the holds that keep a motion safe. The step's integration
is compiled (`drake_oa.policy.action_kernels`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from drake_oa.common.compiled import kernel_arrays
from drake_oa.common.messages import (
    PART_ID_STRIDE,
    CouplingParameters,
    EllipsoidSet,
    FloatArray,
    Frozen,
    HoldReason,
    PolicyState,
    Route,
    zeros,
)
from drake_oa.geometry.ellipsoid import signed_distance
from drake_oa.policy.action_kernels import advance
from drake_oa.policy.config import Policy
from drake_oa.policy.coupling import ALPHA, KAPPA, N_COLUMNS, NORMAL
from drake_oa.policy.dmp import Dmp, local_frame
from drake_oa.policy.guidance import NO_OBSTACLES, Obstacles

SCALED_TO_REST = "speed_scale is 0"
"""Note of a motion that is held because its speed is scaled to nothing from outside."""


@dataclass(frozen=True, eq=False)
class Segment(Frozen):
    """The motion between two steps of the policy.

    Attributes:
        state: the policy at the beginning.
        end: the policy at the end.
        evasion_velocity: (2, 3) velocities at both that displace it besides [m/s].
        primitive: what it imitates; None: the one of `take_step`.
    """

    state: PolicyState
    end: PolicyState
    evasion_velocity: FloatArray = zeros(2, 3)
    primitive: Dmp | None = None

    @property
    def velocity(self) -> FloatArray:
        """(2, 3) velocities at the beginning and at the end [m/s]."""
        scaled = (state.speed * state.z_W for state in (self.state, self.end))
        return np.array([*scaled]) + self.evasion_velocity

    def interpolate(self, time: float) -> FloatArray:
        """Computes position, velocity and acceleration at a time [s] of the segment.

        The velocity is linear in time; the position is its integral, corrected linearly so that
        it ends at the policy's position. Before the segment they are those of its beginning;
        after its end the velocity stays.

        Returns:
            (3, 3) rows p_WE [m], v_WE [m/s] and a_WE [m/s^2].
        """
        (v, v_end), begin, end = self.velocity, self.state, self.end
        length = end.stamp - begin.stamp
        if not length > 0.0:
            return np.stack([end.p_WE, v_end, np.zeros(3)])
        if time > end.stamp:
            return np.stack([end.p_WE + (time - end.stamp) * v_end, v_end, np.zeros(3)])
        since = max(time - begin.stamp, 0.0)
        a = (v_end - v) / length
        drift = v + (end.p_WE - begin.p_WE) / length - 0.5 * (v + v_end)
        return np.stack([begin.p_WE + since * (drift + 0.5 * since * a), v + since * a, a])


def resting(state: PolicyState, primitive: Dmp | None = None) -> Segment:
    """A segment of no length: the policy at one instant."""
    return Segment(state, state, primitive=primitive)


def take_step(
    before: Segment,
    p_WG: FloatArray,
    around: CouplingInputs,
    time: float,
    step: float,
    *,
    dmp: Dmp,
    config: Policy,
    speed_scale: float = 1.0,
    evasion_velocity: FloatArray | None = None,
) -> Segment:
    """Takes a step of the policy from the end of a segment.

    Args:
        before: where it is.
        p_WG: (3,) the goal now [m].
        around: obstacles and coupling terms.
        time: now [s].
        step: length of the step [s].
        dmp: the movement primitive, of three dimensions, unless the segment has its own.
        config: how coupling terms and holds act.
        speed_scale: share of full speed, 1 / (tau T), at which the motion is to go; it
            gets there at the rate of a hold. What is not in [0, 1] counts as the
            nearest of them, NaN as 0.
        evasion_velocity: (3,) velocity [m/s] by which p_WE is displaced besides its motion, z and
            phase being what they are; it changes linearly within the step. None,
            and what is not finite: not at all.

    Returns:
        The motion in this step.

    Raises:
        ValueError: if the goal has come to lie on the start, or the step is negative or not
            finite.
    """
    state, dmp = before.end, before.primitive or dmp
    if not np.array_equal(state.p_WG, p_WG):
        state = replace(state, p_WG=p_WG, R_WL=local_frame(state.p_WS, p_WG))
    baseline = state.baseline
    hold, note = around.hold_at(state, time, config.max_observation_age)
    held = hold is not HoldReason.NONE
    scale = min(float(speed_scale), 1.0) if speed_scale > 0.0 and not held else 0.0
    if scale == 0.0 and not held:
        hold, note = HoldReason.SPEED_SCALE, SCALED_TO_REST
    tau = around.tau or state.tau
    if not around.tau and around.path_length is not None:
        tau = max(1.0, around.path_length / baseline)
    # What is held before it has begun does not begin.
    speed = 0.0 if held and state.phase == 1.0 else state.speed
    most = step / (dmp.duration * config.hold_time)
    after = speed + min(max(scale / (tau * dmp.duration) - speed, -most), most)
    ds = 0.5 * (speed + after) * step
    if not 0.0 <= ds < math.inf:
        raise ValueError(
            f"a step of {step} s at {speed} 1/s is not finite and at least 0 in normalized time"
        )
    motion = np.empty((2, 2, 3))
    motion[:] = np.array([state.p_WE, state.z_W])[:, None]
    if ds > 0.0:
        middle = np.array([state.phase * math.exp(-0.5 * dmp.alpha_k * ds)])
        spread, fade = baseline * state.R_WL, config.fade * baseline
        course = dmp.course(middle, ds, state.p_WG, spread, fade=fade)
        advance(course, around.obstacles, around.obstacles.terms, math.inf, *motion)
    if evasion_velocity is None or not math.isfinite(evasion_velocity.sum()):
        evasion_velocity = np.zeros(3)
    evasions = np.array([before.evasion_velocity[1], evasion_velocity])
    begin = replace(state, tau=tau, speed=speed, stamp=time, hold=hold, note=note)
    end = replace(
        begin,
        p_WE=motion[0, 1] + step * evasions.mean(axis=0),
        z_W=motion[1, 1],
        phase=state.phase * math.exp(-dmp.alpha_k * ds),
        speed=after,
        stamp=time + step,
    )
    return Segment(begin, end, evasions, before.primitive)


def restarted(
    before: Segment, p_WG: FloatArray, time: float, primitive: Dmp | None = None
) -> Segment:
    """A motion that rests, from where it is: its start moves there, and its phase back to 1.

    A segment that does not rest, or has not left its start and imitates the same, stays as it is.

    Args:
        before: where it is.
        p_WG: (3,) the goal [m].
        time: now [s].
        primitive: what it imitates; None: the one of `take_step`.
    """
    state = before.end
    has_left = not np.array_equal(state.p_WE, state.p_WS)
    stays = state.speed > 0.0 if has_left else primitive is before.primitive
    if stays or np.array_equal(state.p_WE, p_WG):
        return before
    return resting(
        PolicyState(
            p_WE=state.p_WE,
            p_WS=state.p_WE,
            p_WG=p_WG,
            R_WL=local_frame(state.p_WE, p_WG),
            stamp=time,
            hold=state.hold,
            note=state.note,
        ),
        primitive,
    )


@dataclass(frozen=True, eq=False)
class CouplingInputs(Frozen):
    """Inputs of the policy until the next observation or decision.

    Attributes:
        ellipsoids: the obstacles; None: there is no perception.
        obstacles: obstacles and coupling terms that act.
        hold: what decision and route hold the motion for, if they do.
        note: the same in words.
        tau: requested temporal scaling; 0: none.
        path_length: of the route [m]; None: there is no route.
        verified: whether roll-outs have verified the terms, so that no ellipsoid holds them.
        restart: whether a motion at rest is to begin anew from where it is.
    """

    ellipsoids: EllipsoidSet | None = None
    obstacles: Obstacles = NO_OBSTACLES
    hold: HoldReason = HoldReason.NONE
    note: str = ""
    tau: float = 0.0
    path_length: float | None = None
    verified: bool = False
    restart: bool = False

    @staticmethod
    def of(
        ellipsoids: EllipsoidSet | None,
        coupling: CouplingParameters | None,
        route: Route | None,
    ) -> CouplingInputs:
        """Combines the values of the ports.

        Args:
            ellipsoids: the M obstacles; None: there is no perception, and no coupling.
            coupling: parameters of the coupling terms, M rows; None: no coupling. Normals
                and tau that it gives go before the route's; where its `hold` is set, it
                holds the motion.
            route: sides to pass on, M rows; None: no guidance. The guidance leads along headings
                that pass on its sides from where the policy is (`drake_oa.policy.guidance`).

        Raises:
            ValueError: if coupling or route do not have one row an ellipsoid, or a
                parameter is out of its range.
        """
        found = CouplingInputs(ellipsoids)
        is_own = coupling is not None and coupling.verified
        if is_own and route is not None and not len(route.direction_W):
            route = None
        if route is not None:
            hold = HoldReason.OBSTACLES if route.blocked else HoldReason.NONE
            found = replace(found, hold=hold, note=route.note, path_length=route.path_length)
        if coupling is None:
            return found
        if coupling.hold is not HoldReason.NONE:
            found = replace(found, hold=coupling.hold, note=coupling.note)
        found = replace(
            found, tau=coupling.tau, verified=coupling.verified, restart=coupling.restart
        )
        # Verified terms have their own obstacles, which lead headings and hold nothing.
        shapes = coupling.ellipsoids if coupling.verified else ellipsoids
        if ellipsoids is None or shapes is None:
            return found
        return replace(found, obstacles=_coupled(shapes, coupling, route))

    def hold_at(self, state: PolicyState, time: float, max_age: float) -> tuple[HoldReason, str]:
        """Returns why the motion must not go on now, and the same in words.

        It is held while nothing has been observed yet or the observation is too old; while no way
        past the obstacles is known; and while the tool is inside an obstacle's ellipsoid, or the
        goal is, unless the motion was verified.

        Args:
            state: the policy.
            time: now [s].
            max_age: age of the observation above which it is held [s].
        """
        seen = self.ellipsoids
        if seen is None:
            return HoldReason.NONE, ""
        cause = f" ({seen.note})" if seen.note else ""
        if seen.stamp == -math.inf:
            return HoldReason.OBSTACLES, f"no observation yet{cause}"
        if time - seen.stamp > max_age:
            return (
                HoldReason.OBSTACLES,
                f"obstacles not seen since t = {seen.stamp:.2f} s{cause}",
            )
        if self.hold is not HoldReason.NONE:
            return self.hold, self.note
        if len(seen) and not self.verified:
            ends = np.stack([state.p_WE, state.p_WG])[:, None]
            distance = signed_distance(ends, seen.p_WO, seen.R_WO, seen.semi_axes)
            for place, row in zip(("tool", "goal"), distance <= 0.0, strict=True):
                if row.any():
                    return (
                        HoldReason.OBSTACLES,
                        f"{place} inside obstacle {seen.ids[row.argmax()] % PART_ID_STRIDE}",
                    )
        return HoldReason.NONE, ""


def _coupled(shapes: EllipsoidSet, coupling: CouplingParameters, route: Route | None) -> Obstacles:
    """Returns the obstacles with their coupling terms; raises as `CouplingInputs.of`."""
    count = len(coupling) if coupling.verified else len(shapes)
    found = {"coupling_parameters": len(coupling), "center_W": len(coupling.center_W) or count}
    found["normal_W"] = len(coupling.normal_W) or count
    if route is not None:
        found["route"] = len(route.direction_W)
    for name, rows in found.items():
        if rows != count:
            raise ValueError(f"{name} has {rows} rows; there are {count} ellipsoids")
    terms, sides, clearance = np.zeros((count, N_COLUMNS)), np.zeros((count, 3)), np.zeros(count)
    terms[:, :3] = coupling.center_W if len(coupling.center_W) else shapes.p_WO
    terms[:, ALPHA : KAPPA + 1] = coupling.as_array()
    normal = terms[:, NORMAL:]
    if route is not None:
        normal[:], sides[:] = route.normal_W, route.direction_W
        clearance[:] = route.remaining_clearance
    if len(coupling.normal_W):
        given = np.asarray(coupling.normal_W.any(axis=1))
        normal[given], clearance[given] = coupling.normal_W[given], 0.0
    alpha, psi, kappa = coupling.as_array().T
    good = np.isfinite(terms).all(axis=1) & (alpha >= 0.0) & (psi > 0.0) & (kappa >= 0.0)
    if not good.all():
        row = int(good.argmin())
        raise ValueError(
            f"obstacle {row}: alpha, psi, kappa must be >= 0, > 0, >= 0 and all finite, "
            f"not {terms[row].tolist()}"
        )
    p_WO, R_WO, semi_axes = kernel_arrays(shapes.p_WO, shapes.R_WO, shapes.semi_axes)
    return Obstacles(p_WO, R_WO, semi_axes, terms, sides, clearance)
