"""One step of the whole action level, as the DmpIntegrator takes it.

Composes the movement primitive (`drake_oa.dmp`), the coupling terms
(`drake_oa.coupling`), temporal scaling (section IV-E of the paper) and the holds
that keep a motion safe.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from drake_oa.coupling import CouplingTerms, GuidanceForm, check_form
from drake_oa.dmp import Dmp, Turn, local_frame
from drake_oa.dmp import step as dmp_step
from drake_oa.ellipsoid_kernels import first_inside
from drake_oa.regressor import CouplingParameters
from drake_oa.values import EllipsoidSet, FloatArray, Frozen, PolicyState, Route


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
        state: the policy at the beginning.
        end: the policy at the end.
        v_WE: (3,) velocity at the beginning [m/s].
        v_WE_end: (3,) velocity at the end [m/s].
    """

    state: PolicyState = field(default_factory=PolicyState)
    end: PolicyState = field(default_factory=PolicyState)
    v_WE: FloatArray = field(default_factory=lambda: np.zeros(3))
    v_WE_end: FloatArray = field(default_factory=lambda: np.zeros(3))
    _coefficients: FloatArray = field(init=False, repr=False, default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        length = self.end.stamp - self.state.stamp
        p, q = self.state.p_WE, self.end.p_WE
        acceleration = slope = np.zeros(3)
        if length > 0.0:
            acceleration = (self.v_WE_end - self.v_WE) / length
            slope = (q - p) / length - 0.5 * (self.v_WE + self.v_WE_end)
        # Rows: position, its first derivative, velocity and acceleration at the beginning.
        coefficients = np.stack([p, self.v_WE + slope, self.v_WE, acceleration])
        object.__setattr__(self, "_coefficients", coefficients)
        super().__post_init__()

    @staticmethod
    def at_rest(p_WE: FloatArray) -> Segment:
        """A segment that stays at p_WE (3,) [m]."""
        state = PolicyState(p_WE=p_WE, p_WS=p_WE, p_WG=p_WE)
        return Segment(state, state)

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
        length = self.end.stamp - self.state.stamp
        since = min(max(time - self.state.stamp, 0.0), length)
        beyond = time - self.end.stamp if length > 0.0 else 0.0
        if derivative == 0:
            weights = (1.0, since, 0.0, 0.5 * since * since)
        elif derivative == 1:
            weights = (0.0, 0.0, 1.0, since)
        else:
            weights = (0.0, 0.0, 0.0, 0.0 if beyond > 0.0 else 1.0)
        value = np.dot(weights, self._coefficients)
        if beyond > 0.0 and derivative == 0:
            value = value + beyond * self.v_WE_end
        return np.asarray(value)


def initial_segment(dmp: Dmp, p_WS: FloatArray, p_WG: FloatArray, time: float) -> Segment:
    """At rest at the start, phase 1.

    Raises:
        ValueError: if start and goal coincide.
    """
    state = PolicyState(
        p_WE=p_WS,
        p_WS=p_WS,
        p_WG=p_WG,
        R_WL=local_frame(p_WS, p_WG),
        stamp=time,
        speed=1.0 / dmp.duration,
    )
    return Segment(state, state)


def hold_reason(
    state: PolicyState,
    ellipsoids: EllipsoidSet | None,
    route: Route | None,
    *,
    time: float,
    max_observation_age: float,
) -> str:
    """Why the motion must not go on now, or "".

    It is held while nothing has been observed yet or the observation is too old;
    while the tool is inside an obstacle's ellipsoid, or the goal is; and while the
    rings forbid every side of an obstacle.
    """
    if ellipsoids is None:
        return ""
    if ellipsoids.stamp == -math.inf:
        return "no observation yet" + (f" ({ellipsoids.note})" if ellipsoids.note else "")
    if time - ellipsoids.stamp > max_observation_age:
        cause = f" ({ellipsoids.note})" if ellipsoids.note else ""
        return f"obstacles not seen since t = {ellipsoids.stamp:.2f} s{cause}"
    if route is not None and route.note:
        return route.note
    for place, p in (("tool", state.p_WE), ("goal", state.p_WG)):
        row = first_inside(p, ellipsoids.p_WO, ellipsoids.R_WO, ellipsoids.semi_axes)
        if row >= 0:
            return f"{place} inside obstacle {ellipsoids.ids[row]}"
    return ""


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
        coupling: parameters of the coupling terms, M rows; None: no coupling.
        route: headings of the guidance terms, M rows; None: no guidance.
        time: now [s].
        step: length of the step [s].
        parameters: how coupling terms and holds act.

    Returns:
        The motion until time + step.

    Raises:
        ValueError: if coupling or route do not have one row an ellipsoid, or the goal
            has come to lie on the start.
    """
    if (p_WG != state.p_WG).any():
        state = replace(state, p_WG=p_WG, R_WL=local_frame(state.p_WS, p_WG))
    note = hold_reason(
        state,
        ellipsoids,
        route,
        time=time,
        max_observation_age=parameters.max_observation_age,
    )
    baseline = state.baseline
    tau = state.tau if route is None else max(1.0, route.path_length / baseline)
    speed = _ramp(state.speed, 0.0 if note else 1.0 / (tau * dmp.duration), step, dmp, parameters)
    begin = replace(state, tau=tau, stamp=time, note=note)
    p_WE, z_W, phase = dmp_step(
        dmp,
        state.p_WE,
        state.z_W,
        state.phase,
        0.5 * (state.speed + speed) * step,
        p_WG,
        frame=state.R_WL,
        baseline=baseline,
        turn=_turn(begin, ellipsoids, coupling, route, parameters),
    )
    end = replace(begin, p_WE=p_WE, z_W=z_W, phase=phase, speed=speed, stamp=time + step)
    return Segment(begin, end, state.speed * state.z_W, speed * z_W)


def _ramp(
    speed: float, target: float, step: float, dmp: Dmp, parameters: ActionParameters
) -> float:
    """ds/dt, led toward its target at no more than 1 / (T hold_time) a second."""
    most = step / (dmp.duration * parameters.hold_time)
    return speed + min(max(target - speed, -most), most)


def _turn(
    state: PolicyState,
    ellipsoids: EllipsoidSet | None,
    coupling: CouplingParameters | None,
    route: Route | None,
    parameters: ActionParameters,
) -> Turn | None:
    if ellipsoids is None or len(ellipsoids) == 0 or coupling is None:
        return None
    count = len(ellipsoids)
    for name, rows in (
        ("coupling_parameters", len(coupling)),
        ("route", count if route is None else len(route.heading_W)),
    ):
        if rows != count:
            raise ValueError(f"{name} has {rows} rows; there are {count} ellipsoids")
    terms = coupling.as_array()
    terms[:, 0] *= goal_fade(state, parameters.fade)
    about_route = len(coupling.center_W) > 0
    return CouplingTerms(
        p_WO=coupling.center_W if about_route else ellipsoids.p_WO,
        parameters=terms,
        heading_W=None if route is None else route.heading_W,
        normal_W=None if route is None else route.normal_W,
        guidance_alpha=np.minimum(terms[:, 0], parameters.guidance_gain),
        form=parameters.guidance,
        in_plane=about_route,
    ).turn


def goal_fade(state: PolicyState, fade: float) -> float:
    """How much of the coupling is left near the goal: (distance / (fade L))^4, at most 1.

    The coupling would keep turning the motion round the goal; alpha acts by its
    logarithm, hence the steep power.
    """
    to_G = state.p_WG - state.p_WE
    reach = fade * state.baseline
    return min(1.0, float(to_G @ to_G) / reach**2) ** 2 if reach > 0.0 else 1.0
