"""The posture of a redundant arm along a path of its tool: the elbow goes round obstacles.

The tool's motion leaves a 7R arm one degree of freedom. The path's samples are the layers of
a grid, the values of one joint its columns; the six other joints follow by Newton's method
from the neighbouring posture, so that the arm stays in its branch of the inverse kinematics.
Viterbi's algorithm (A. J. Viterbi, IEEE Trans. Information Theory 13(2), 1967) finds the
cheapest way through the grid from the present posture, first on a coarse grid over the
joint's whole range, then on a fine one about that way. Where that way is not clear, the same
is done with nodes along the null space itself (`posture_trace_kernels`), which also leads
by the stretched shoulder, where that joint tells postures apart badly. The cost is, with s
normalised time, M the mass matrix at the posture q_0 that the null space rests in, and
[x]_+ = max(0, x),

    integral of (q - q_0)^T M (q - q_0)
        + w_d [(Delta_a - d) / (Delta_a - d_stop)]_+^2  and the same of the links' distance to
          each other and of the joints' distance to their limits
        + w_v dq/ds^T diag(M) dq/ds   over s,

and much more where d is less than d_stop, or a joint is asked for more than a share of its
speed limit. The first term alone is what a damped null space drawn to q_0 settles to, so
that an arm that nothing is near to stays where it would be without a plan.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import TypeAlias

import numpy as np

from drake_oa.common.messages import FloatArray, Frozen, IntArray, PlannedMotion
from drake_oa.common.numba_tools import kernel_arrays
from drake_oa.common.thinking import count
from drake_oa.posture import plan_kernels as kernels
from drake_oa.posture.arm_surroundings import ArmSurroundings
from drake_oa.posture.plan_kernels import Rules, ToolPath
from drake_oa.posture.trace_kernels import plan_traced
from drake_oa.robot.arm import ArmModel

_JOINTS = 7
_COARSE, _WINDOW = 57, 2
"""Columns of the coarse grid, 0.1 rad apart on the Panda, and how many of them the way may
leave in one layer."""
_LEAP = 0.21
"""By how much the joint may turn from one layer to the next [rad]: the elbow goes 6 cm, half
a link's thickness, so that it does not leap through anything."""
_LEAP_OF_ANY = 0.3
"""The same of any joint [rad]: more is another branch of the inverse kinematics."""
_RESERVES = (0.005, 0.02)
"""By how much more than the stop distance the samples keep, as between them it is less; the
second where the first turns out not to do [m]."""
_LOSS = 0.002
"""Who leaves what is too near comes nearer than before by no more than this [m]."""
_HURRIED = 1.02
"""Shares of the allowed speed up to this are no more than the start's own error."""
_FINE, _FINE_WINDOW = 9, 8
_TRACE, _NODES = 0.1, 256
"""How far apart the nodes of the coarse grid along the null space are [rad], and how many a
layer has at most."""
_FORBIDDEN, _SLOPE = 100.0, 300.0
_STEEP = 3000.0
"""The slope along the null space: rather a bit short for long than far short at one place."""


@dataclass(frozen=True)
class PostureParameters:
    """What a plan keeps, and its prices.

    Attributes:
        link_clearance: asked distance Delta_a of the links to obstacles and table [m].
        stop_distance: below this distance a posture is forbidden, d_stop [m].
        self_clearance, self_stop: the same of the links to each other [m].
        limit_clearance, limit_stop: the same of the joints to their limits [rad].
        speed_share: share of the joints' velocity limits that may be used.
        near_weight, self_weight, limit_weight: prices of each at its stop.
        motion_weight: price of moving, w_v.
        roll_joint: the joint, counted from 1, whose value tells the postures of a 7R arm apart.

    Raises:
        ValueError: for a value out of range.
    """

    link_clearance: float = 0.1
    stop_distance: float = 0.035
    self_clearance: float = 0.03
    self_stop: float = 0.005
    limit_clearance: float = 0.3
    limit_stop: float = 0.1
    speed_share: float = 0.8
    near_weight: float = 30.0
    self_weight: float = 30.0
    limit_weight: float = 3.0
    motion_weight: float = 0.02
    roll_joint: int = 3

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not 0.0 <= value < math.inf:
                raise ValueError(f"{item.name} must be finite and not negative, not {value}")
        for asked, stop in (
            ("link_clearance", "stop_distance"),
            ("self_clearance", "self_stop"),
            ("limit_clearance", "limit_stop"),
        ):
            if not getattr(self, asked) > getattr(self, stop) + _RESERVES[0] * (
                asked == "link_clearance"
            ):
                raise ValueError(
                    f"{asked} {getattr(self, asked)} must be more than {stop} {getattr(self, stop)}"
                )
        if not 0.0 < self.speed_share <= 1.0:
            raise ValueError(f"speed_share must be in (0, 1], not {self.speed_share}")
        if not 1 <= self.roll_joint <= _JOINTS:
            raise ValueError(f"roll_joint must be in [1, {_JOINTS}], not {self.roll_joint}")

    @property
    def redundant(self) -> int:
        """Where the roll joint is among the arm's."""
        return self.roll_joint - 1

    def rules(self, padding: float) -> Rules:
        """As the kernels take them."""
        return Rules(
            stop=self.stop_distance,
            asked=self.link_clearance,
            padding=padding,
            self_stop=self.self_stop,
            self_asked=self.self_clearance,
            limit_stop=self.limit_stop,
            limit_asked=self.limit_clearance,
            speed_share=self.speed_share,
            near_weight=self.near_weight,
            self_weight=self.self_weight,
            limit_weight=self.limit_weight,
            motion_weight=self.motion_weight,
            forbidden=_FORBIDDEN,
            slope=_SLOPE,
            leap=_LEAP,
            reserve=_RESERVES[0],
            leap_of_any=_LEAP_OF_ANY,
        )


@dataclass(frozen=True, eq=False)
class PosturePlan(Frozen):
    """Postures of the arm along a path of T samples.

    Attributes:
        s: (T,) normalised times, increasing.
        q: (T, n) postures [rad]; (0, n): none puts the tool on all of the path.
        distance: (T,) of the links to obstacles and table [m], no more than the clearance
            that is asked.
        obstacle: (T,) row of the nearest obstacle; -1: the table, or none is so near.
        apart: (T,) of the links to each other [m], no more than is asked.
        limit: (T,) of the joints to their limits [rad].
        hurry: largest share of a joint's allowed speed that is needed; inf without postures.
        short: what is missing of the stop distance, of the obstacles or the links
            themselves [m]; 0: the arm can go.
        free: how many samples from the first on nothing is missing of.
    """

    s: FloatArray = field(default_factory=lambda: np.zeros(0))
    q: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    distance: FloatArray = field(default_factory=lambda: np.zeros(0))
    obstacle: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    apart: FloatArray = field(default_factory=lambda: np.zeros(0))
    limit: FloatArray = field(default_factory=lambda: np.zeros(0))
    hurry: float = math.inf
    short: float = 0.0
    free: int = 0

    def __len__(self) -> int:
        return len(self.q)

    @property
    def works(self) -> bool:
        """Whether the arm can follow the path by it."""
        return len(self.q) > 0 and self.short == 0.0 and self.hurry <= _HURRIED


PlanMotion: TypeAlias = Callable[[FloatArray, PlannedMotion], PosturePlan]
"""Plans the posture along a motion, from a posture (n,) on."""


def plan_posture(
    arm: ArmModel,
    around: ArmSurroundings,
    q: FloatArray,
    s: FloatArray,
    p_WE: FloatArray,
    *,
    seconds: float,
    age: float = 0.0,
    R_WE: FloatArray | None = None,
    posture: FloatArray | None = None,
    parameters: PostureParameters | None = None,
    thorough: bool = True,
) -> PosturePlan:
    """Plans the arm's posture along a path.

    Args:
        arm: an arm of seven joints.
        around: what it must not touch.
        q: (7,) where it is, with the tool about at the first sample [rad].
        s: (T,) normalised times of the samples, increasing.
        p_WE: (T, 3) positions of the tool point [m], a few centimetres apart.
        seconds: duration of a unit of s, tau T [s].
        age: for how long the obstacles have moved since they were seen [s].
        R_WE: (T, 3, 3) or (3, 3) orientations; None: the arm's.
        posture: (T, 7) or (7,) q_0, what the null space rests in [rad]; None: the arm's.
        parameters: what is kept; None: the defaults.
        thorough: whether to look further where the first grid has no way that is clear.

    Returns:
        The plan; it is the best that there is where none keeps everything.

    Raises:
        ValueError: for an arm of another number of joints, wrong shapes, values that are
            not finite, or times that do not increase.
    """
    parameters = parameters or PostureParameters()
    q, s, path = (np.asarray(a, dtype=float) for a in (q, s, p_WE))
    R = np.asarray(arm.R_WE if R_WE is None else R_WE, dtype=float)
    _check(arm, q, s, path, R, seconds)
    T = len(s)
    if T < 2:
        return PosturePlan(s=s, q=q[None][:T])
    R = np.broadcast_to(R, (T, 3, 3))
    rest = np.broadcast_to(arm.posture if posture is None else posture, (T, _JOINTS))
    ages = age + (s - s[0]) * seconds
    rules = parameters.rules(around.padding)
    start = np.clip(q, arm.lower + rules.limit_stop, arm.upper - rules.limit_stop)
    joint = parameters.redundant
    low, high = start[joint], start[joint]
    low = min(low, arm.lower[joint] + parameters.limit_stop)
    high = max(high, arm.upper[joint] - parameters.limit_stop)
    # One column goes through where the arm is, so that it may stay there.
    step = (high - low) / (_COARSE - 1)
    columns = start[joint] + step * np.arange(-_COARSE, _COARSE + 1)
    columns = columns[(columns >= low - 1e-9) & (columns <= high + 1e-9)]
    values = np.broadcast_to(columns, (T, len(columns)))
    way = np.empty((T, _JOINTS))
    p_WE, R_WE, at, aged, drawn = kernel_arrays(path, R, s, ages, rest)
    tool = ToolPath(p_WE, R_WE, at, aged, drawn, float(seconds))
    among = around.arrays

    def search(values: FloatArray, guess: FloatArray, window: int) -> float:
        grid = kernel_arrays(values, start, guess)
        cost, measured = kernels.plan_rows(
            tool, *grid, window, joint, arm.arrays, among, rules, way
        )
        count(postures=measured)
        return float(cost)

    def traced(guess: FloatArray, step: float, most: int) -> float:
        cost, measured = plan_traced(
            tool, *kernel_arrays(start, guess), step, most, _NODES, arm.arrays, among, rules, way
        )
        count(postures=measured)
        return float(cost)

    nothing, fine = np.zeros((0, _JOINTS)), step * np.linspace(-1.0, 1.0, _FINE)
    best = PosturePlan(s=s, q=nothing, short=math.inf)
    for by_trace in (False, True) if thorough else (False,):
        if by_trace:
            rules = rules._replace(leap=_LEAP_OF_ANY, slope=_STEEP)
        for reserve in _RESERVES if thorough else _RESERVES[:1]:
            rules = rules._replace(reserve=reserve)
            cost = traced(nothing, _TRACE, _NODES) if by_trace else search(values, nothing, _WINDOW)
            if not math.isfinite(cost):
                break
            guess = way.copy()
            if by_trace:
                traced(guess, 2.0 * _TRACE / (_FINE - 1), _FINE // 2)
            else:
                search(guess[:, joint, None] + fine, guess, _FINE_WINDOW)
            way[0] = q
            plan = _described(arm, around, s, way, seconds, ages, rules)
            if plan.short < best.short:
                best = plan
            if (
                best.short == 0.0
                or parameters.link_clearance <= parameters.stop_distance + _RESERVES[1]
            ):
                break
        if best.short == 0.0:
            break
    return best


def reviewed(
    plan: PosturePlan,
    arm: ArmModel,
    around: ArmSurroundings,
    *,
    s: float,
    seconds: float,
    age: float = 0.0,
    parameters: PostureParameters | None = None,
) -> PosturePlan:
    """The same postures, from s on, among other obstacles; arguments as of `plan_posture`."""
    parameters = parameters or PostureParameters()
    left = plan.s >= s
    if not len(plan) or not left.any():
        return PosturePlan(s=plan.s[left], q=plan.q[: len(plan.q)][left[: len(plan.q)]])
    times, way = np.array(plan.s[left]), np.array(plan.q[left])
    ages = age + (times - s) * seconds
    rules = parameters.rules(around.padding)
    return _described(arm, around, times, way, seconds, ages, rules)


def _described(
    arm: ArmModel,
    around: ArmSurroundings,
    s: FloatArray,
    way: FloatArray,
    seconds: float,
    ages: FloatArray,
    rules: Rules,
) -> PosturePlan:
    count(postures=2 * len(s) - 1)
    kept, nearest = np.empty((len(s), 3)), np.empty(len(s), dtype=np.int64)
    among = around.arrays
    kernels.measure_way(
        np.ascontiguousarray(way),
        np.ascontiguousarray(ages),
        arm.arrays,
        among,
        rules,
        kept,
        nearest,
    )
    distance, apart, limit = (np.array(column) for column in kept.T)
    if len(s) > 1:
        halfway = np.empty((len(s) - 1, 3))
        between = 0.5 * (way[1:] + way[:-1]), 0.5 * (ages[1:] + ages[:-1])
        unused = np.empty(len(s) - 1, dtype=np.int64)
        kernels.measure_way(*between, arm.arrays, among, rules, halfway, unused)
        # Each sample answers for the way to it.
        distance[2:] = np.minimum(distance[2:], halfway[1:, kernels.DISTANCE])
        apart[2:] = np.minimum(apart[2:], halfway[1:, kernels.SELF])
    hurry = 0.0
    if len(s) > 1:
        rate = np.abs(np.diff(way, axis=0)) / (np.diff(s)[:, None] * seconds)
        hurry = float((rate / (arm.speed * rules.speed_share)).max())
    # Where the arm is now cannot be chosen; from too near it has to be left.
    first = 1 if len(s) > 1 else 0
    left = _leaving(distance, rules.stop)
    lacks = np.zeros(len(s))
    lacks[left:] = rules.stop - distance[left:]
    lacks[first:] = np.maximum(lacks[first:], rules.self_stop - apart[first:])
    short = max(float(lacks.max()), 0.0)
    free = int((lacks > 0.0).argmax()) if short else len(s)
    return PosturePlan(s, np.array(way), distance, nearest, apart, limit, hurry, short, free)


def _leaving(distance: FloatArray, stop: float) -> int:
    """How many samples from the first on lead away from within the stop distance.

    At least the first one, where there are more; the last is never among them.
    """
    count = 1 if len(distance) > 1 else 0
    while (
        0 < count < len(distance) - 1
        and distance[count] < stop
        and distance[count] >= distance[:count].max() - _LOSS
    ):
        count += 1
    return count


def _check(
    arm: ArmModel, q: FloatArray, s: FloatArray, path: FloatArray, R: FloatArray, seconds: float
) -> None:
    if len(arm.posture) != _JOINTS:
        raise ValueError(f"arm must have {_JOINTS} joints, not {len(arm.posture)}")
    T = len(s)
    shapes = (q.shape, s.shape, path.shape)
    if shapes != ((_JOINTS,), (T,), (T, 3)) or R.shape not in ((3, 3), (T, 3, 3)):
        raise ValueError(
            f"q, s, p_WE and R_WE must be ({_JOINTS},), (T,), (T, 3) and (3, 3) or (T, 3, 3), not "
            f"{', '.join(map(str, (*shapes, R.shape)))}"
        )
    if not (np.isfinite(q).all() and np.isfinite(path).all() and np.isfinite(R).all()):
        raise ValueError("q, p_WE and R_WE must be finite")
    if not (np.isfinite(s).all() and (np.diff(s) > 0.0).all()):
        raise ValueError(f"s must be finite and increase, not {s}")
    if not 0.0 < seconds < math.inf:
        raise ValueError(f"seconds must be positive and finite, not {seconds}")
