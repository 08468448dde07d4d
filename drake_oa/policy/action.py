"""One time step of the policy: movement primitive, coupling terms, temporal scaling and holds.

The step combines the movement primitive (`drake_oa.policy.dmp`), the coupling terms
(`drake_oa.policy.coupling`), which turn the motion away from obstacles, and the guidance headings
(`drake_oa.policy.guidance`), which turn it to the selected side of an obstacle. The duration is
scaled with the length of the avoiding path, as in section IV-E of Pairet et al., RA-L 2019. A hold
stops the motion on its path while continuing would not be safe. The integration is compiled
(`drake_oa.policy.action_kernels`).
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


@dataclass(frozen=True, eq=False)
class Segment(Frozen):
    """Motion of the tool point between two consecutive steps of the policy.

    Attributes:
        state: state of the policy (position, scaled velocity, phase, speed ds/dt, and reason for
            holding the motion) at the beginning of the segment.
        end: state of the policy at the end of the segment.
        evasion_velocity: (2, 3) evasion velocity at the beginning and at the end of the segment, in
            the world frame [m/s]. It adds to the velocity of the movement primitive.
        primitive: movement primitive of the motion; None: that of the constructor of
            `DmpIntegrator`.
    """

    state: PolicyState
    end: PolicyState
    evasion_velocity: FloatArray = zeros(2, 3)
    primitive: Dmp | None = None

    @property
    def velocity(self) -> FloatArray:
        """Velocities (2, 3) v_WE at both ends of the segment, with the evasion velocity [m/s]."""
        scaled = (state.speed * state.z_W for state in (self.state, self.end))
        return np.array([*scaled]) + self.evasion_velocity

    def interpolate(self, time: float) -> FloatArray:
        """Computes position, velocity and acceleration of the tool point at a time of the segment.

        The velocity is linear in time. The position is the integral of the velocity, plus a term
        linear in time, so that it ends at the position in the state `end`. For times before the
        segment, the result is that at its beginning; after its end the velocity is constant.

        Args:
            time: time of the simulation [s].

        Returns:
            (3, 3) rows p_WE [m], v_WE [m/s] and a_WE [m/s^2] of the tool point in the world frame.
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


def make_segment(state: PolicyState, primitive: Dmp | None = None) -> Segment:
    """Returns a segment of zero length, which begins and ends at the same state of the policy.

    Args:
        state: state of the policy (position, scaled velocity, phase, speed ds/dt, and reason for
            holding the motion).
        primitive: movement primitive of the motion; None: that of the constructor of
            `DmpIntegrator`.
    """
    return Segment(state, state, primitive=primitive)


def take_step(
    before: Segment,
    p_WG: FloatArray,
    inputs: CouplingInputs,
    time: float,
    step: float,
    *,
    dmp: Dmp,
    config: Policy,
    speed_scale: float = 1.0,
    evasion_velocity: FloatArray | None = None,
) -> Segment:
    """Computes the motion of the tool point in the next time step of the policy.

    Args:
        before: motion in the previous step, from the end of which the motion continues.
        p_WG: (3,) current goal in the world frame [m]. While it is not finite, the motion is held
            (stopped on its path), and the previous goal remains.
        inputs: obstacles, coupling terms (turning rates that avoid them), and a hold or a temporal
            scaling that other layers request.
        time: current time [s].
        step: length of the step [s].
        dmp: movement primitive of three dimensions, used if the segment has none.
        config: constants of coupling terms and holds.
        speed_scale: requested fraction of the full speed ds/dt = 1 / (tau T), with normalized time
            s, demonstrated duration T and temporal scaling tau. ds/dt approaches
            speed_scale / (tau T); its change during the time `config.hold_time` is at most 1 / T. A
            motion at its start begins with at most ds/dt = speed_scale / T. Values are clipped to
            [0, 1]; NaN counts as 0.
        evasion_velocity: (3,) velocity in the world frame at the end of the step [m/s], added to
            that of the primitive to evade moving obstacles. It displaces p_WE, without effect on
            scaled velocity and phase, and is linear in time within the step. None or not finite: 0.

    Returns:
        Segment of the motion in this step.

    Raises:
        ValueError: if start and goal coincide, or the step is negative or not finite.
    """
    state, dmp = before.end, before.primitive or dmp
    hold, note = HoldReason.GOAL, "the input port goal is not finite"
    if math.isfinite(p_WG.sum()):
        if not np.array_equal(state.p_WG, p_WG):
            state = replace(state, p_WG=p_WG, R_WL=local_frame(state.p_WS, p_WG))
        hold, note = inputs.hold_at(state, time, config.max_observation_age)
    baseline = state.baseline
    is_held = hold is not HoldReason.NONE
    scale = min(float(speed_scale), 1.0) if speed_scale > 0.0 and not is_held else 0.0
    if scale == 0.0 and not is_held:
        hold, note = HoldReason.SPEED_SCALE, f"speed_scale is {max(speed_scale, 0.0):g}"
    tau = inputs.tau or state.tau
    if not inputs.tau and inputs.path_length is not None:
        # The baseline is 0 until the first finite goal.
        tau = max(1.0, inputs.path_length / (baseline or 1.0))
    # A motion that is held at its start must not move at all.
    speed = min(state.speed, scale / dmp.duration) if state.phase == 1.0 else state.speed
    max_change = step / (dmp.duration * config.hold_time)
    after = speed + min(max(scale / (tau * dmp.duration) - speed, -max_change), max_change)
    ds = 0.5 * (speed + after) * step
    if not 0.0 <= ds < math.inf:
        raise ValueError(
            f"step: {step} s at a speed of {speed} 1/s is {ds} of normalized time; it must be "
            "finite and at least 0"
        )
    motion = np.empty((2, 2, 3))
    motion[:] = np.array([state.p_WE, state.z_W])[:, None]
    if ds > 0.0:
        middle = np.array([state.phase * math.exp(-0.5 * dmp.alpha_k * ds)])
        spread, fade = baseline * state.R_WL, config.fade * baseline
        setup = dmp.setup(middle, ds, state.p_WG, spread, fade=fade)
        advance(setup, inputs.obstacles, inputs.obstacles.terms, math.inf, *motion)
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


def restart(
    before: Segment, p_WG: FloatArray, time: float, primitive: Dmp | None = None
) -> Segment:
    """Restarts a motion of the tool point that is at rest, with its current position as the start.

    The new motion has the phase 1 and the goal `p_WG`. A motion is at rest while its rate ds/dt of
    normalized time is 0. There is no restart in three cases: the motion has left its start and is
    not at rest, the tool point is at `p_WG`, or the motion is still at its start and already has
    the primitive `primitive`.

    Args:
        before: motion in the previous step, at the end of which the motion restarts.
        p_WG: (3,) goal in the world frame [m].
        time: current time [s].
        primitive: movement primitive of the new motion; None: that of the constructor of
            `DmpIntegrator`.

    Returns:
        Segment of zero length at the start of the new motion; `before` without a restart.
    """
    state = before.end
    has_left = not np.array_equal(state.p_WE, state.p_WS)
    stays = state.speed > 0.0 if has_left else primitive is before.primitive
    if stays or np.array_equal(state.p_WE, p_WG):
        return before
    return make_segment(
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
    """Obstacles, coupling terms, hold and temporal scaling, combined from the policy's input ports.

    Coupling terms turn the motion away from obstacles. The policy uses the same object in each step
    until its inputs change.

    Attributes:
        ellipsoids: ellipsoids of the perceived obstacles; None: the input port ellipsoids_W is not
            connected.
        obstacles: obstacles with their coupling terms, as arrays for the compiled kernels.
        hold: reason for holding (stopping) the motion that the message with the coupling parameters
            or the route contains; NONE: neither holds the motion.
        note: explanation of `hold`.
        tau: requested temporal scaling of the demonstrated duration; 0: none is requested.
        path_length: length of the path past all obstacles on their selected sides [m], which scales
            the duration if `tau` is 0; None: no sides are selected.
        verified: whether the coupling terms belong to a motion that `MotionVerifier` has selected
            by roll-outs (simulations). Such a motion is not held if the tool or the goal is inside
            an ellipsoid.
        restart: whether a motion at rest restarts from its current position.
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
        ellipsoids: EllipsoidSet | None, coupling: CouplingParameters | None, route: Route | None
    ) -> CouplingInputs:
        """Combines the values of three input ports of the policy into one object.

        Args:
            ellipsoids: M obstacles; None: the input port ellipsoids_W is not connected. Then only
                coupling terms act that roll-outs (simulations) have verified, because the message
                with these terms also contains their centers.
            coupling: parameters of M coupling terms; None: no coupling terms. The normals of the
                planes of rotation, the temporal scaling, and the reason for holding the motion
                (stopping it on its path) in this message take precedence over those that result
                from the route.
            route: sides on which the M obstacles are passed. Guidance, a coupling term, turns the
                motion toward these sides. The length of the path past the obstacles determines the
                temporal scaling. While every side of an obstacle is forbidden, the motion is held.
                None: no guidance.

        Raises:
            ValueError: if coupling or route do not have one row per ellipsoid, alpha or kappa is
                negative, psi is not positive, or a parameter is not finite.
        """
        combined = CouplingInputs(ellipsoids)
        is_verified = coupling is not None and coupling.verified
        if is_verified and route is not None and not len(route.direction_W):
            route = None
        if route is not None:
            hold = HoldReason.OBSTACLES if route.blocked else HoldReason.NONE
            combined = replace(combined, hold=hold, note=route.note, path_length=route.path_length)
        if coupling is None:
            return combined
        if coupling.hold is not HoldReason.NONE:
            combined = replace(combined, hold=coupling.hold, note=coupling.note)
        combined = replace(
            combined, tau=coupling.tau, verified=coupling.verified, restart=coupling.restart
        )
        # The ellipsoids of verified terms determine guidance headings only, and hold nothing.
        shapes = coupling.ellipsoids if coupling.verified else ellipsoids
        if shapes is None:
            return combined
        if route is not None and not len(route.direction_W) and route.baseline == 0.0:
            # No side is selected before the first finite goal.
            route = None
        return replace(combined, obstacles=_coupled(shapes, coupling, route))

    def hold_at(self, state: PolicyState, time: float, max_age: float) -> tuple[HoldReason, str]:
        """Returns the reason for holding the motion at a time, and an explanation of this reason.

        The motion is held in the following cases. The first that applies determines the reason. If
        none applies, the reason is NONE and the explanation empty. If the input port ellipsoids_W
        is not connected, only the second case can apply.

        - There is no observation of the obstacles yet, or the last one is older than `max_age`.
        - The message with the coupling parameters or the route contains a hold, for example because
          no path past the obstacles is known.
        - The tool or the goal is inside an ellipsoid, and roll-outs have not verified the motion.

        Args:
            state: state of the policy, whose tool position and goal are tested.
            time: current time [s].
            max_age: maximum age of the last observation of the obstacles [s].
        """
        obstacles = self.ellipsoids
        if obstacles is None:
            return self.hold, self.note
        cause = f" ({obstacles.note})" if obstacles.note else ""
        if obstacles.stamp == -math.inf:
            return HoldReason.OBSTACLES, f"no observation yet{cause}"
        if time - obstacles.stamp > max_age:
            return (
                HoldReason.OBSTACLES,
                f"obstacles not seen since t = {obstacles.stamp:.2f} s{cause}",
            )
        if self.hold is not HoldReason.NONE:
            return self.hold, self.note
        if len(obstacles) and not self.verified:
            ends = np.stack([state.p_WE, state.p_WG])[:, None]
            distance = signed_distance(ends, obstacles.p_WO, obstacles.R_WO, obstacles.semi_axes)
            for place, row in zip(("tool", "goal"), distance <= 0.0, strict=True):
                if row.any():
                    track = obstacles.ids[row.argmax()] % PART_ID_STRIDE
                    return HoldReason.OBSTACLES, f"{place} inside obstacle {track}"
        return HoldReason.NONE, ""


def _coupled(shapes: EllipsoidSet, coupling: CouplingParameters, route: Route | None) -> Obstacles:
    """Assembles obstacles and coupling terms to arrays for the compiled kernels of the policy.

    Args:
        shapes: ellipsoids of the obstacles.
        coupling: parameters of the coupling terms, which turn the motion away from obstacles.
        route: sides on which the obstacles are passed; None: no guidance toward a side.

    Raises:
        ValueError: if coupling or route do not have one row per ellipsoid, alpha or kappa is
            negative, psi is not positive, or a parameter is not finite.
    """
    count = len(coupling) if coupling.verified else len(shapes)
    sizes = {"coupling_parameters": len(coupling), "normal_W": len(coupling.normal_W) or count}
    sizes["center_W"] = len(coupling.center_W) or len(shapes)
    if route is not None:
        sizes["route"] = len(route.direction_W)
    for name, rows in sizes.items():
        if rows != count:
            raise ValueError(
                f"{name} has {rows} rows; it must have {count}, the number of "
                + ("verified coupling terms" if coupling.verified else "ellipsoids")
            )
    terms, sides, clearance = np.zeros((count, N_COLUMNS)), np.zeros((count, 3)), np.zeros(count)
    terms[:, :3] = coupling.center_W if len(coupling.center_W) else shapes.p_WO
    terms[:, ALPHA : KAPPA + 1] = coupling.as_array()
    normal = terms[:, NORMAL:]
    if route is not None:
        normal[:], sides[:] = route.normal_W, route.direction_W
        clearance[:] = route.remaining_clearance
    if len(coupling.normal_W):
        nonzero = np.asarray(coupling.normal_W.any(axis=1))
        normal[nonzero], clearance[nonzero] = coupling.normal_W[nonzero], 0.0
    is_valid = np.isfinite(terms)
    is_valid[:, ALPHA : KAPPA + 1] &= terms[:, ALPHA : KAPPA + 1] >= (0.0, 1e-300, 0.0)
    if not is_valid.all():
        row, column = np.argwhere(~is_valid)[0]
        names = np.repeat(("center_W", "alpha", "psi", "kappa", "", "normal_W"), (3, 1, 1, 1, 3, 3))
        raise ValueError(
            f"coupling term {row}: {names[column]} = {terms[row, column]}; alpha and kappa must "
            "be at least 0, psi above 0, and all values finite"
        )
    p_WO, R_WO, semi_axes = kernel_arrays(shapes.p_WO, shapes.R_WO, shapes.semi_axes)
    return Obstacles(p_WO, R_WO, semi_axes, terms, sides, clearance)
