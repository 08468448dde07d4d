"""One step of the whole action level, as the DmpIntegrator takes it.

Composes the movement primitive (`drake_oa.policy.dmp`), the coupling terms
(`drake_oa.policy.coupling`), the headings of the guidance (`drake_oa.policy.guidance`), temporal
scaling (section IV-E of the paper) and the holds that keep a motion safe. The step itself
is compiled (`drake_oa.policy.action_kernels`); what does not change from step to step is laid out
for it beforehand, in `ActionLevel` and `Surroundings`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from drake_oa.common.messages import (
    PART,
    CouplingParameters,
    EllipsoidSet,
    FloatArray,
    Frozen,
    PolicyState,
    Route,
)
from drake_oa.geometry.ellipsoid import shape_matrix
from drake_oa.policy import action_kernels as kernels
from drake_oa.policy.coupling import MAX_GUIDANCE_RATE, CouplingTerms, GuidanceForm, check_form
from drake_oa.policy.dmp import Dmp, local_frame

SCALED_TO_REST = "speed_scale is 0"
"""Note of a motion that is held because its speed is scaled to nothing from outside."""
_NO_EVASION = np.zeros(3)


@dataclass(frozen=True)
class ActionParameters:
    """How the coupling terms and the holds act.

    Attributes:
        guidance: form of the guidance term.
        guidance_gain: largest alpha of the guidance term, per normalised time.
        fade: the coupling fades within this many baselines of the goal.
        max_observation_age: the motion is held when the obstacles were last seen
            longer ago than this [s].
        hold_time: time from full speed to a hold and back [s].

    Raises:
        ValueError: for an unknown form or a value out of range.
    """

    guidance: GuidanceForm = "counterphase"
    guidance_gain: float = 100.0
    fade: float = 0.3
    max_observation_age: float = 0.5
    hold_time: float = 0.25

    def __post_init__(self) -> None:
        check_form(self.guidance)
        for name, positive in (
            ("guidance_gain", False),
            ("fade", False),
            ("max_observation_age", True),
            ("hold_time", True),
        ):
            value = getattr(self, name)
            if not 0.0 <= value < math.inf or (positive and value == 0.0):
                kind = "positive" if positive else "not negative"
                raise ValueError(f"{name} must be finite and {kind}, not {value}")


@dataclass(frozen=True, eq=False)
class Segment(Frozen):
    """The motion between two steps of the policy.

    Attributes:
        motion: (52,) policy at both ends and interpolation between them, laid out as
            `drake_oa.policy.action_kernels` says.
        note: empty, or why the motion is being held.
    """

    motion: FloatArray
    note: str = ""

    def __post_init__(self) -> None:
        # Nobody else holds the array: no view is needed to lock it.
        self.motion.flags.writeable = False

    @staticmethod
    def resting(state: PolicyState) -> Segment:
        """A segment of no length: the policy at one instant."""
        motion = np.empty(kernels.N_MOTION)
        for begin in (0, kernels.END):
            motion[begin : begin + 3] = state.p_WE
            motion[begin + kernels.Z : begin + kernels.PHASE] = state.z_W
            motion[begin + kernels.PHASE] = state.phase
            motion[begin + kernels.SPEED] = state.speed
            motion[begin + kernels.STAMP] = state.stamp
        motion[kernels.TAU] = state.tau
        motion[kernels.START : kernels.GOAL] = state.p_WS
        motion[kernels.GOAL : kernels.FRAME] = state.p_WG
        motion[kernels.FRAME : kernels.V] = state.R_WL.ravel()
        v_WE = state.speed * state.z_W
        motion[kernels.V : kernels.V_END] = motion[kernels.V_END : kernels.DRIFT] = v_WE
        motion[kernels.DRIFT : kernels.ACCELERATION] = v_WE
        motion[kernels.ACCELERATION :] = 0.0
        return Segment(motion, state.note)

    @staticmethod
    def at_rest(p_WE: FloatArray) -> Segment:
        """A segment that stays at p_WE (3,) [m]."""
        return Segment.resting(PolicyState(p_WE=p_WE, p_WS=p_WE, p_WG=p_WE))

    def _policy(self, begin: int) -> PolicyState:
        motion = self.motion
        return PolicyState(
            p_WE=motion[begin : begin + 3],
            z_W=motion[begin + kernels.Z : begin + kernels.PHASE],
            phase=float(motion[begin + kernels.PHASE]),
            tau=float(motion[kernels.TAU]),
            p_WS=motion[kernels.START : kernels.GOAL],
            p_WG=motion[kernels.GOAL : kernels.FRAME],
            R_WL=motion[kernels.FRAME : kernels.V].reshape(3, 3),
            stamp=float(motion[begin + kernels.STAMP]),
            speed=float(motion[begin + kernels.SPEED]),
            note=self.note,
        )

    @cached_property
    def state(self) -> PolicyState:
        """The policy at the beginning."""
        return self._policy(0)

    @cached_property
    def end(self) -> PolicyState:
        """The policy at the end."""
        return self._policy(kernels.END)

    @property
    def phase(self) -> float:
        """Canonical phase k at the beginning."""
        return float(self.motion[kernels.PHASE])

    @property
    def v_WE(self) -> FloatArray:
        """(3,) velocity at the beginning [m/s]."""
        return self.motion[kernels.V : kernels.V_END]

    @property
    def v_WE_end(self) -> FloatArray:
        """(3,) velocity at the end [m/s]."""
        return self.motion[kernels.V_END : kernels.DRIFT]

    def interpolate(self, time: float, derivative: int) -> FloatArray:
        """Position, velocity or acceleration at a time [s] of the segment.

        The velocity is linear in time; the position is its integral, corrected
        linearly so that it ends where the policy says. Before it begins the segment
        stands for its beginning; after its end it goes on at its last velocity.

        Args:
            time: when [s].
            derivative: 0 position, 1 velocity, 2 acceleration.

        Returns:
            (3,) in the world frame.
        """
        return kernels.interpolate(self.motion, float(time), derivative)


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


class ActionLevel:
    """A movement primitive with its coupling terms, laid out for the kernel."""

    def __init__(self, dmp: Dmp, parameters: ActionParameters) -> None:
        """Lays out what is constant.

        Args:
            dmp: the movement primitive, of three dimensions.
            parameters: how coupling terms and holds act.

        Raises:
            ValueError: if the primitive does not have three dimensions.
        """
        if dmp.dimension != 3:
            raise ValueError(f"dmp must have 3 dimensions, not {dmp.dimension}")
        self._constants = np.zeros(kernels.N_CONSTANTS)
        for place, value in (
            (kernels.ALPHA_X, dmp.alpha_x),
            (kernels.BETA_X, dmp.beta_x),
            (kernels.ALPHA_K, dmp.alpha_k),
            (kernels.DURATION, dmp.duration),
            (kernels.GUIDANCE_GAIN, parameters.guidance_gain),
            (kernels.FADE, parameters.fade),
            (kernels.MAX_AGE, parameters.max_observation_age),
            (kernels.HOLD_TIME, parameters.hold_time),
            (kernels.PRINTED, parameters.guidance == "printed"),
            (kernels.MAX_RATE, MAX_GUIDANCE_RATE),
        ):
            self._constants[place] = value
        self._basis = np.vstack([dmp.centers, dmp.widths, dmp.weights])

    def step(
        self,
        before: Segment,
        p_WG: FloatArray,
        around: Surroundings,
        time: float,
        step: float,
        count: int = 1,
        speed_scale: float = 1.0,
        evasion: FloatArray | None = None,
    ) -> Segment:
        """Takes a step of the policy, or several, from the end of a segment.

        Args:
            before: where it is.
            p_WG: (3,) the goal now [m].
            around: what it goes by in all of the steps.
            time: now [s].
            step: length of a step [s].
            count: how many steps.
            speed_scale: share of full speed, 1 / (tau T), at which the motion is to go; it
                gets there at the rate of a hold. What is not in [0, 1] counts as the
                nearest of them, NaN as 0.
            evasion: (3,) velocity [m/s] by which p_WE is displaced besides its motion, z and
                phase being what they are; it changes linearly within the first step. None,
                and what is not finite: not at all.

        Returns:
            The motion in the last of the steps.

        Raises:
            ValueError: see `advance`; or if there is no step to take.
        """
        if count < 1:
            raise ValueError(f"count must be at least 1, not {count}")
        scale = min(float(speed_scale), 1.0) if speed_scale > 0.0 else 0.0
        gx, gy, gz = p_WG.tolist()
        if evasion is None or not math.isfinite(evasion.sum()):
            evasion = _NO_EVASION
        motion = np.empty(kernels.N_MOTION)
        code = kernels.take_steps(
            before.motion,
            gx,
            gy,
            gz,
            self._constants,
            self._basis,
            around.facts,
            around.parameters,
            around.clearance,
            around.blocks,
            around.R_WO,
            around.B,
            scale,
            evasion,
            time,
            step,
            count,
            motion,
        )
        if code < 0:
            if code == kernels.GOAL_MOVED:
                before = _toward(before, p_WG)
                return self.step(before, p_WG, around, time, step, count, scale, evasion)
            raise ValueError(
                f"a step of {step} s at {before.motion[kernels.END + kernels.SPEED]} 1/s is not "
                "finite and at least 0 in normalised time"
            )
        if code == kernels.FREE:
            return Segment(motion, "" if scale > 0.0 else SCALED_TO_REST)
        return Segment(motion, around.reason(code))


def begun_anew(before: Segment, p_WG: FloatArray, time: float) -> Segment:
    """A motion that rests, from where it is: its start moves there, and its phase back to 1.

    A segment that does not rest, or has not left its start, stays as it is.

    Args:
        before: where it is.
        p_WG: (3,) the goal [m].
        time: now [s].
    """
    state = before.end
    if state.speed > 0.0 or np.array_equal(state.p_WE, state.p_WS):
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
            note=before.note,
        )
    )


def _toward(before: Segment, p_WG: FloatArray) -> Segment:
    """The same segment, from the same start to another goal."""
    motion = before.motion.copy()
    frame = local_frame(motion[kernels.START : kernels.GOAL], p_WG)
    motion[kernels.GOAL : kernels.FRAME] = p_WG
    motion[kernels.FRAME : kernels.V] = frame.ravel()
    return Segment(motion, before.note)


def hold_reason(
    state: PolicyState,
    ellipsoids: EllipsoidSet | None,
    route: Route | None,
    coupling: CouplingParameters | None = None,
    *,
    time: float,
    max_observation_age: float,
) -> str:
    """Why the motion must not go on now, or "".

    It is held while nothing has been observed yet or the observation is too old;
    while the tool is inside an obstacle's ellipsoid, or the goal is; and while the
    rings forbid every side of an obstacle, or the note of the coupling parameters says that
    no motion that clears it was found.
    """
    around = Surroundings.of(ellipsoids, coupling, route)
    code = kernels.hold_code(
        np.array(state.p_WE, dtype=float),
        np.array(state.p_WG, dtype=float),
        around.facts,
        around.blocks,
        around.R_WO,
        float(time),
        max_observation_age,
    )
    return around.reason(code)


def advance(
    dmp: Dmp,
    state: PolicyState,
    p_WG: FloatArray,
    ellipsoids: EllipsoidSet | None,
    coupling: CouplingParameters | None,
    route: Route | None,
    *,
    time: float,
    step: float,
    parameters: ActionParameters,
) -> Segment:
    """Takes one step of the policy.

    Args:
        dmp: the movement primitive.
        state: where it is.
        p_WG: (3,) the goal now [m].
        ellipsoids: the M obstacles; None: there is no perception, and no coupling.
        coupling: parameters of the coupling terms, M rows; None: no coupling. Normals
            and tau that it gives go before the route's, and a note of its holds the motion.
        route: sides to pass on, M rows; None: no guidance. The guidance leads along its
            headings, or where it has none, along those that pass on its sides from
            where the policy is (`drake_oa.policy.guidance`).
        time: now [s].
        step: length of the step [s].
        parameters: how coupling terms and holds act.

    Returns:
        The motion until time + step.

    Raises:
        ValueError: if coupling or route do not have one row an ellipsoid, the goal
            has come to lie on the start, or the step is negative or not finite.
    """
    level = ActionLevel(dmp, parameters)
    around = Surroundings.of(ellipsoids, coupling, route)
    return level.step(Segment.resting(state), p_WG, around, float(time), float(step))


def goal_fade(state: PolicyState, fade: float) -> float:
    """How much of the coupling is left near the goal: (distance / (fade L))^4, at most 1.

    The coupling would keep turning the motion round the goal; alpha acts by its
    logarithm, hence the steep power.
    """
    to_G = state.p_WG - state.p_WE
    return kernels.goal_fade(float(to_G @ to_G), state.baseline, float(fade))


def _empty(*shape: int) -> FloatArray:
    return field(default_factory=lambda: np.zeros(shape))


@dataclass(frozen=True, eq=False)
class Surroundings(Frozen):
    """What the policy goes by until it is seen or decided anew, laid out for the kernel.

    Attributes:
        ellipsoids: the obstacles; None: there is no perception.
        blocked: empty, or why no way past the obstacles is known.
        anew: whether a motion at rest is to begin anew from where it is.
        p_WV: (3,) the point that it goes to in place of the goal [m]; (0,): none.
        facts, parameters, clearance, blocks, R_WO, B: as `action_kernels.take_steps`
            takes them.
    """

    ellipsoids: EllipsoidSet | None = None
    blocked: str = ""
    anew: bool = False
    p_WV: FloatArray = _empty(0)
    facts: FloatArray = _empty(kernels.N_FACTS)
    parameters: FloatArray = _empty(0, 3)
    clearance: FloatArray = _empty(0)
    blocks: FloatArray = _empty(kernels.N_BLOCKS, 0, 3)
    R_WO: FloatArray = _empty(0, 3, 3)
    B: FloatArray = _empty(0, 3, 3)

    def __post_init__(self) -> None:
        """Leaves the arrays unlocked: the kernel is compiled for such, and changes none."""

    @staticmethod
    def of(
        ellipsoids: EllipsoidSet | None,
        coupling: CouplingParameters | None,
        route: Route | None,
    ) -> Surroundings:
        """Lays out what came on the ports, see `advance`.

        Raises:
            ValueError: if coupling or route do not have one row an ellipsoid, or a
                parameter is out of its range or of another shape.
        """
        count = 0 if ellipsoids is None else len(ellipsoids)
        p_WV = np.zeros(0) if coupling is None else coupling.p_WV
        if p_WV.shape not in ((0,), (3,)) or not np.isfinite(p_WV).all():
            raise ValueError(
                f"coupling_parameters' p_WV must be 3 finite numbers [m] or none, not {p_WV}"
            )
        blocked = _blocked(coupling, route)
        facts = np.zeros(kernels.N_FACTS)
        facts[kernels.PATH_LENGTH] = -1.0 if route is None else route.path_length
        facts[kernels.GIVEN_TAU] = 0.0 if coupling is None else coupling.tau
        blocks = np.zeros((kernels.N_BLOCKS, count, 3))
        parameters, clearance = np.zeros((count, 3)), np.zeros(count)
        R_WO, B = np.zeros((count, 3, 3)), np.zeros((count, 3, 3))
        if ellipsoids is not None:
            facts[kernels.SEEN] = 1.0
            facts[kernels.OBSERVED] = ellipsoids.stamp
            facts[kernels.BLOCKED] = blocked != ""
            blocks[kernels.P_WO] = ellipsoids.p_WO
            blocks[kernels.SEMI_AXES] = ellipsoids.semi_axes
            R_WO[:] = ellipsoids.R_WO
            B[:] = shape_matrix(ellipsoids.R_WO, ellipsoids.semi_axes)
        if count and ellipsoids is not None and coupling is not None:
            _check_rows(count, coupling, route)
            facts[kernels.COUPLES] = 1.0
            facts[kernels.IN_PLANE] = len(coupling.center_W) > 0
            if route is not None:
                _lay_out_route(route, blocks, clearance)
            if len(coupling.normal_W):
                given = coupling.normal_W.any(axis=1)
                blocks[kernels.PASSING_NORMAL, given] = coupling.normal_W[given]
                blocks[kernels.DESIRED, given] = 0.0
                clearance[given] = 0.0
            about_route = facts[kernels.IN_PLANE] != 0.0
            blocks[kernels.ABOUT] = coupling.center_W if about_route else ellipsoids.p_WO
            for column, values in enumerate((coupling.alpha, coupling.psi, coupling.kappa)):
                parameters[:, column] = values
            _check_ranges(parameters, blocks)
        return Surroundings(
            ellipsoids=ellipsoids,
            blocked=blocked,
            anew=coupling is not None and coupling.anew,
            p_WV=p_WV,
            facts=facts,
            parameters=parameters,
            clearance=clearance,
            blocks=blocks,
            R_WO=R_WO,
            B=B,
        )

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
            return self.blocked
        row, is_goal = divmod(code - kernels.INSIDE, 2)
        place = "goal" if is_goal else "tool"
        return f"{place} inside obstacle {self.ellipsoids.ids[row] % PART}"


def _blocked(coupling: CouplingParameters | None, route: Route | None) -> str:
    if coupling is not None and coupling.note:
        return coupling.note
    return "" if route is None else route.note


def _check_rows(count: int, coupling: CouplingParameters, route: Route | None) -> None:
    rows = {"coupling_parameters": len(coupling)}
    for name in ("center_W", "normal_W"):
        given = len(getattr(coupling, name))
        if given:
            rows[f"coupling_parameters' {name}"] = given
    if route is not None:
        rows["route"] = len(route.heading_W) or len(route.direction_W)
        follows = len(route.heading_W) == 0
        for name in ("normal_W", "center_W", "clearance") if follows else ("normal_W",):
            rows[f"route's {name}"] = len(getattr(route, name))
    for name, found in rows.items():
        if found != count:
            raise ValueError(f"{name} has {found} rows; there are {count} ellipsoids")


def _check_ranges(parameters: FloatArray, blocks: FloatArray) -> None:
    least = parameters.min(axis=0)
    finite = np.isfinite(blocks).all() and np.isfinite(parameters).all()
    if not (finite and least[0] >= 0.0 and least[1] > 0.0 and least[2] >= 0.0):
        # They say what is wrong.
        CouplingTerms(
            p_WO=blocks[kernels.ABOUT],
            parameters=parameters,
            heading_W=blocks[kernels.DESIRED],
            normal_W=blocks[kernels.PASSING_NORMAL],
        )


def _lay_out_route(route: Route, blocks: FloatArray, clearance: FloatArray) -> None:
    if len(route.heading_W):
        blocks[kernels.DESIRED] = route.heading_W
    else:
        blocks[kernels.DIRECTION] = route.direction_W
        blocks[kernels.FOOT] = route.center_W
        clearance[:] = route.clearance
    blocks[kernels.PASSING_NORMAL] = route.normal_W
