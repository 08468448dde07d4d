"""One step of the whole action level, as the DmpIntegrator takes it.

Composes the movement primitive (`drake_oa.policy.dmp`), the coupling terms
(`drake_oa.policy.coupling`), the headings of the guidance (`drake_oa.policy.guidance`), temporal
scaling (section IV-E of the paper) and the holds that keep a motion safe. The step itself
is compiled (`drake_oa.policy.action_kernels`); what does not change from step to step is laid out
for it beforehand, in `ActionLevel` and `Surroundings`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from drake_oa.common.compiled import kernel_arrays
from drake_oa.common.messages import (
    PART,
    CouplingParameters,
    EllipsoidSet,
    FloatArray,
    Frozen,
    HoldCause,
    PolicyState,
    Route,
)
from drake_oa.geometry.ellipsoid import shape_matrix
from drake_oa.policy import action_kernels as kernels
from drake_oa.policy.action_kernels import Facts, Instant, Motion, Rules
from drake_oa.policy.config import Policy
from drake_oa.policy.coupling import ALPHA, HEADING, KAPPA, MAX_GUIDANCE_RATE, N_COLUMNS, NORMAL
from drake_oa.policy.dmp import Dmp, local_frame
from drake_oa.policy.guidance import Obstacles, guide

SCALED_TO_REST = "speed_scale is 0"
"""Note of a motion that is held because its speed is scaled to nothing from outside."""
_NO_EVASION = np.zeros(3)


@dataclass(frozen=True, eq=False)
class Segment(Frozen):
    """The motion between two steps of the policy.

    Attributes:
        motion: the policy at both ends and its course between them.
        hold: what holds the motion.
        note: the same in words; empty where nothing does.
        primitive: what it imitates; None: what the `ActionLevel` was made with.
    """

    motion: Motion
    hold: HoldCause = HoldCause.NONE
    note: str = ""
    primitive: Dmp | None = None

    @staticmethod
    def resting(state: PolicyState, primitive: Dmp | None = None) -> Segment:
        """A segment of no length: the policy at one instant."""
        p_WE, z_W, p_WS, p_WG, R_WL = kernel_arrays(
            state.p_WE, state.z_W, state.p_WS, state.p_WG, state.R_WL
        )
        now = Instant(p_WE, z_W, float(state.phase), float(state.speed), float(state.stamp))
        course = kernels.course_between(now, now, _NO_EVASION, _NO_EVASION)
        motion = Motion(now, now, float(state.tau), p_WS, p_WG, R_WL, _NO_EVASION, course)
        return Segment(motion, state.hold, state.note, primitive)

    @staticmethod
    def at_rest(p_WE: FloatArray) -> Segment:
        """A segment that stays at p_WE (3,) [m]."""
        return Segment.resting(PolicyState(p_WE=p_WE, p_WS=p_WE, p_WG=p_WE))

    def _policy(self, at: Instant) -> PolicyState:
        motion = self.motion
        return PolicyState(
            p_WE=at.p_WE,
            z_W=at.z_W,
            phase=at.phase,
            tau=motion.tau,
            p_WS=motion.p_WS,
            p_WG=motion.p_WG,
            R_WL=motion.R_WL,
            stamp=at.stamp,
            speed=at.speed,
            hold=self.hold,
            note=self.note,
        )

    @cached_property
    def state(self) -> PolicyState:
        """The policy at the beginning."""
        return self._policy(self.motion.begin)

    @cached_property
    def end(self) -> PolicyState:
        """The policy at the end."""
        return self._policy(self.motion.end)

    @property
    def phase(self) -> float:
        """Canonical phase k at the beginning."""
        return self.motion.begin.phase

    @property
    def v_WE(self) -> FloatArray:
        """(3,) velocity at the beginning [m/s]."""
        return self.motion.course.v

    def interpolate(self, time: float) -> FloatArray:
        """Computes position, velocity and acceleration at a time [s] of the segment.

        The velocity is linear in time; the position is its integral, corrected linearly so that
        it ends at the policy's position. Before the segment they are those of its beginning;
        after its end the velocity stays.

        Returns:
            (3, 3) rows p_WE [m], v_WE [m/s] and a_WE [m/s^2].
        """
        course = self.motion.course
        length = course.end - course.begin
        since = min(max(time - course.begin, 0.0), length)
        acceleration = course.acceleration
        position = course.p + since * (course.drift + 0.5 * since * acceleration)
        if length > 0.0 and time > course.end:
            position = position + (time - course.end) * course.v_end
            acceleration = np.zeros(3)
        return np.stack([position, course.v + since * course.acceleration, acceleration])


def initial_segment(dmp: Dmp, p_WS: FloatArray, p_WG: FloatArray, time: float) -> Segment:
    """At rest at the start, phase 1.

    Raises:
        ValueError: if start and goal coincide.
    """
    return Segment.resting(
        PolicyState(
            p_WE=p_WS,
            p_WS=p_WS,
            p_WG=p_WG,
            R_WL=local_frame(p_WS, p_WG),
            stamp=time,
            speed=1.0 / dmp.duration,
        )
    )


def rules_of(config: Policy) -> Rules:
    """Returns how coupling terms and holds act, as kernels take it."""
    return Rules(
        guidance_gain=float(config.guidance_gain),
        fade=float(config.fade),
        max_age=float(config.max_observation_age),
        hold_time=float(config.hold_time),
        printed=config.guidance == "printed",
        max_rate=MAX_GUIDANCE_RATE,
    )


class ActionLevel:
    """A movement primitive with its coupling terms, laid out for the kernel."""

    def __init__(self, dmp: Dmp, config: Policy | None = None) -> None:
        """Lays out what is constant.

        Args:
            dmp: the movement primitive, of three dimensions.
            config: how coupling terms and holds act; None: the defaults.

        Raises:
            ValueError: if the primitive does not have three dimensions.
        """
        if dmp.dimension != 3:
            raise ValueError(f"dmp must have 3 dimensions, not {dmp.dimension}")
        self._primitive = dmp.kernel
        self._rules = rules_of(config or Policy())

    def step(
        self,
        before: Segment,
        p_WG: FloatArray,
        around: Surroundings,
        time: float,
        step: float,
        speed_scale: float = 1.0,
        evasion: FloatArray | None = None,
    ) -> Segment:
        """Takes a step of the policy from the end of a segment.

        Args:
            before: where it is.
            p_WG: (3,) the goal now [m].
            around: obstacles and coupling terms.
            time: now [s].
            step: length of the step [s].
            speed_scale: share of full speed, 1 / (tau T), at which the motion is to go; it
                gets there at the rate of a hold. What is not in [0, 1] counts as the
                nearest of them, NaN as 0.
            evasion: (3,) velocity [m/s] by which p_WE is displaced besides its motion, z and
                phase being what they are; it changes linearly within the step. None,
                and what is not finite: not at all.

        Returns:
            The motion in this step.

        Raises:
            ValueError: if the goal has come to lie on the start, or the step is negative or not
                finite.
        """
        scale = min(float(speed_scale), 1.0) if speed_scale > 0.0 else 0.0
        if evasion is None or not math.isfinite(evasion.sum()):
            evasion = _NO_EVASION
        motion = before.motion
        if not np.array_equal(motion.p_WG, p_WG):
            goal, frame = kernel_arrays(p_WG, local_frame(motion.p_WS, p_WG))
            motion = motion._replace(p_WG=goal, R_WL=frame)
        motion, code = kernels.take_step(
            motion,
            self._primitive if before.primitive is None else before.primitive.kernel,
            self._rules,
            around.facts,
            around.obstacles,
            scale,
            evasion,
            float(time),
            float(step),
        )
        if code == kernels.BAD_STEP:
            raise ValueError(
                f"a step of {step} s at {motion.end.speed} 1/s is not finite and at least 0 in "
                "normalised time"
            )
        if code == kernels.FREE:
            if scale > 0.0:
                return Segment(motion, primitive=before.primitive)
            return Segment(motion, HoldCause.SPEED_SCALE, SCALED_TO_REST, before.primitive)
        cause = around.hold if code == kernels.FORBIDDEN else HoldCause.OBSTACLES
        return Segment(motion, cause, around.reason(code), before.primitive)


def restarted(
    before: Segment, p_WG: FloatArray, time: float, primitive: Dmp | None = None
) -> Segment:
    """A motion that rests, from where it is: its start moves there, and its phase back to 1.

    A segment that does not rest, or has not left its start and imitates the same, stays as it is.

    Args:
        before: where it is.
        p_WG: (3,) the goal [m].
        time: now [s].
        primitive: what it imitates; None: what the `ActionLevel` was made with.
    """
    state = before.end
    if state.speed > 0.0 and not np.array_equal(state.p_WE, state.p_WS):
        return before
    if np.array_equal(state.p_WE, state.p_WS) and primitive is before.primitive:
        return before
    if np.array_equal(state.p_WE, p_WG):
        return before
    return Segment.resting(
        PolicyState(
            p_WE=state.p_WE,
            p_WS=state.p_WE,
            p_WG=p_WG,
            R_WL=local_frame(state.p_WE, p_WG),
            stamp=time,
            hold=before.hold,
            note=before.note,
        ),
        primitive,
    )


def _obstacles_of(ellipsoids: EllipsoidSet | None) -> Obstacles:
    """Returns obstacles for the kernel, with terms that do not act and without a route."""
    shapes = EllipsoidSet() if ellipsoids is None else ellipsoids
    p_WO, R_WO, semi_axes = kernel_arrays(shapes.p_WO, shapes.R_WO, shapes.semi_axes)
    B = np.ascontiguousarray(shape_matrix(R_WO, semi_axes), dtype=float)
    count = len(p_WO)
    rows = np.zeros((count, N_COLUMNS)), np.zeros((count, 3)), np.zeros(count)
    return Obstacles(p_WO, R_WO, semi_axes, B, *rows)


NO_OBSTACLES = _obstacles_of(None)
"""No obstacles, for the kernel."""


def desired_headings(
    policy: PolicyState,
    ellipsoids: EllipsoidSet,
    direction_W: FloatArray,
    normal_W: FloatArray,
    remaining_clearance: FloatArray,
) -> FloatArray:
    """v_d for each obstacle; a zero row where the heading needs no guidance.

    Guidance is needed where the motion is on its way into the obstacle's clearance and
    the avoidance term would turn it to another side than the chosen one: with e the way
    to the centre and u the heading, the P-plane's normal e x u then leans away from the
    normal of the passing plane. v_d goes over from u to the supporting heading as it
    leans by up to 30 degrees below the right angle.

    Args:
        policy: position, scaled velocity and goal of the motion.
        ellipsoids: the M obstacles, dilated by the tool.
        direction_W: (M, 3) chosen unit directions omega_d.
        normal_W: (M, 3) normals of the passing planes, x_L x omega_d.
        remaining_clearance: (M,) distance to keep [m].

    Returns:
        (M, 3) unit headings or zero rows, in the world frame.
    """
    obstacles = _obstacles_of(ellipsoids)
    obstacles.terms[:, NORMAL : NORMAL + 3] = normal_W
    obstacles.direction[:] = direction_W
    obstacles.remaining_clearance[:] = remaining_clearance
    p_WG, R_WL = kernel_arrays(policy.p_WG, policy.R_WL)
    terms = obstacles.terms.copy()
    guide(tuple(policy.p_WE), tuple(policy.z_W), p_WG, R_WL, obstacles, terms)
    return terms[:, HEADING : HEADING + 3]


_UNSEEN = Facts(False, 0.0, False, -1.0, 0.0, False, False, False, False)


@dataclass(frozen=True, eq=False)
class Surroundings(Frozen):
    """What the policy goes by until it is seen or decided anew, laid out for the kernel.

    Attributes:
        ellipsoids: the obstacles; None: there is no perception.
        hold: what decision and route hold the motion for, if they do.
        note: the same in words.
        anew: whether a motion at rest is to begin anew from where it is.
        facts, obstacles: the same for the kernel, which changes none of the arrays.
    """

    ellipsoids: EllipsoidSet | None = None
    hold: HoldCause = HoldCause.NONE
    note: str = ""
    anew: bool = False
    facts: Facts = _UNSEEN
    obstacles: Obstacles = NO_OBSTACLES

    @staticmethod
    def of(
        ellipsoids: EllipsoidSet | None,
        coupling: CouplingParameters | None,
        route: Route | None,
    ) -> Surroundings:
        """Lays out what came on the ports.

        Args:
            ellipsoids: the M obstacles; None: there is no perception, and no coupling.
            coupling: parameters of the coupling terms, M rows; None: no coupling. Normals
                and tau that it gives go before the route's; where its `hold` is set, it
                holds the motion.
            route: sides to pass on, M rows; None: no guidance. The guidance leads along its
                headings, or where it has none, along those that pass on its sides from
                where the policy is (`drake_oa.policy.guidance`).

        Raises:
            ValueError: if coupling or route do not have one row an ellipsoid, or a
                parameter is out of its range or of another shape.
        """
        own, shapes = coupling is not None and coupling.verified, ellipsoids
        if own and coupling is not None:
            # Verified terms have their own obstacles, which lead headings and hold nothing.
            shapes = coupling.ellipsoids
            route = route if route is not None and len(route.direction_W) else None
        count = len(coupling) if own and coupling is not None else len(shapes or EllipsoidSet())
        hold, note = _hold(coupling, route)
        obstacles = _obstacles_of(shapes)
        couples = in_plane = False
        if count and ellipsoids is not None and coupling is not None:
            _check_rows(count, coupling, route)
            couples, in_plane = True, len(coupling.center_W) > 0 or route is not None
            terms = np.zeros((count, N_COLUMNS))
            obstacles = obstacles._replace(terms=terms)
            heading, normal = terms[:, HEADING : HEADING + 3], terms[:, NORMAL : NORMAL + 3]
            if route is not None:
                if len(route.heading_W):
                    heading[:] = route.heading_W
                else:
                    obstacles.direction[:] = route.direction_W
                    obstacles.remaining_clearance[:] = route.remaining_clearance
                normal[:] = route.normal_W
            if len(coupling.normal_W):
                given = np.asarray(coupling.normal_W.any(axis=1))
                normal[given], heading[given] = coupling.normal_W[given], 0.0
                obstacles.remaining_clearance[given[: len(shapes or ())]] = 0.0
            terms[:, :3] = coupling.center_W if len(coupling.center_W) else ellipsoids.p_WO
            terms[:, ALPHA : KAPPA + 1] = coupling.as_array()
            _check_ranges(terms)
        facts = Facts(
            looked_for=ellipsoids is not None,
            seen=0.0 if ellipsoids is None else float(ellipsoids.stamp),
            blocked=hold is not HoldCause.NONE,
            path_length=-1.0 if route is None else float(route.path_length),
            tau=0.0 if coupling is None else float(coupling.tau),
            couples=couples,
            in_plane=in_plane,
            original=coupling is not None and coupling.original,
            verified=own,
        )
        anew = coupling is not None and coupling.anew
        return Surroundings(ellipsoids, hold, note, anew, facts, obstacles)

    def reason(self, code: int) -> str:
        """What a reason to hold, as the kernel numbers them, says in words."""
        if code == kernels.FREE or self.ellipsoids is None:
            return ""
        cause = f" ({self.ellipsoids.note})" if self.ellipsoids.note else ""
        if code == kernels.UNOBSERVED:
            return f"no observation yet{cause}"
        if code == kernels.OUTDATED:
            return f"obstacles not seen since t = {self.ellipsoids.stamp:.2f} s{cause}"
        if code == kernels.FORBIDDEN:
            return self.note
        row, is_goal = divmod(code - kernels.INSIDE, 2)
        place = "goal" if is_goal else "tool"
        return f"{place} inside obstacle {self.ellipsoids.ids[row] % PART}"


def _hold(coupling: CouplingParameters | None, route: Route | None) -> tuple[HoldCause, str]:
    """What decision or route hold the motion for, and the same in words."""
    if coupling is not None and coupling.hold is not HoldCause.NONE:
        return coupling.hold, coupling.note
    if route is not None and route.blocked:
        return HoldCause.OBSTACLES, route.note
    return HoldCause.NONE, ""


def _check_rows(count: int, coupling: CouplingParameters, route: Route | None) -> None:
    rows = {"coupling_parameters": len(coupling)}
    for name in ("center_W", "normal_W"):
        given = len(getattr(coupling, name))
        if given:
            rows[f"coupling_parameters' {name}"] = given
    if route is not None:
        rows["route"] = len(route.heading_W) or len(route.direction_W)
        follows = len(route.heading_W) == 0
        for name in ("normal_W", "remaining_clearance") if follows else ("normal_W",):
            rows[f"route's {name}"] = len(getattr(route, name))
    for name, found in rows.items():
        if found != count:
            raise ValueError(f"{name} has {found} rows; there are {count} ellipsoids")


def _check_ranges(terms: FloatArray) -> None:
    finite = np.isfinite(terms).all(axis=1)
    if not finite.all():
        row = int(np.argmin(finite))
        raise ValueError(f"obstacle {row} has a value that is not finite: {terms[row].tolist()}")
    parameters = terms[:, ALPHA : KAPPA + 1]
    alpha, psi, kappa = parameters.T
    good = (alpha >= 0.0) & (psi > 0.0) & (kappa >= 0.0)
    if not good.all():
        row = int(np.argmin(good))
        raise ValueError(
            f"obstacle {row}: alpha, psi, kappa must be >= 0, > 0, >= 0, "
            f"not {parameters[row].tolist()}"
        )
