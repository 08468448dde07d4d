"""The motion that MotionVerifier selects: its key, its command, its prediction, and the memory of
the search."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from drake_oa.common.messages import (
    CouplingParameters,
    EllipsoidSet,
    FloatArray,
    Frozen,
    HoldCause,
    IntArray,
    PlannedMotion,
    PolicyState,
    Route,
)
from drake_oa.planning.search import SOURCES
from drake_oa.planning.solid_scene import SolidScene
from drake_oa.policy.coupling import ALPHA, KAPPA, N_COLUMNS, NORMAL
from drake_oa.policy.demonstration import Demonstration
from drake_oa.regulation.proposals import N_GENES


@dataclass(frozen=True, eq=False)
class MotionKey(Frozen):
    """Motion and scene for which a motion was selected.

    Attributes:
        p_WS, p_WG: (3,) start and goal [m]; NaN: none yet.
        scene: the solids.
    """

    p_WS: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    p_WG: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    scene: SolidScene = field(default_factory=SolidScene)

    def fits(self, policy: PolicyState, p_WG: FloatArray) -> bool:
        """Returns whether it is the motion under way."""
        return np.array_equal(self.p_WS, policy.p_WS) and np.array_equal(self.p_WG, p_WG)


@dataclass(frozen=True, eq=False)
class MotionCommand(Frozen):
    """Selected motion as the action level executes it.

    Attributes:
        source: row of `SOURCES`; -1: nothing was selected.
        terms: (K, 13) coupling terms, see `coupling.turn_step`; (0, 13): the nominal motion.
        ellipsoids: K obstacles that lead the headings of the terms; empty: none does.
        route: sides of these obstacles.
        tau: temporal scaling; 0: nothing was selected.
        demonstration: motion to imitate; empty: the task's.
        restart: whether the motion is to restart with this demonstration where the arm rests.
        note: "" or the reason for which the motion must not continue.
    """

    source: int = -1
    terms: FloatArray = field(default_factory=lambda: np.zeros((0, N_COLUMNS)))
    ellipsoids: EllipsoidSet = field(default_factory=EllipsoidSet)
    route: Route = field(default_factory=Route)
    tau: float = 0.0
    demonstration: Demonstration = field(default_factory=Demonstration)
    restart: bool = False
    note: str = ""

    def coupling(self) -> CouplingParameters:
        """Returns the command as DmpIntegrator reads it."""
        rows = self.terms
        alpha, psi, kappa = np.ascontiguousarray(rows[:, ALPHA : KAPPA + 1].T)
        return CouplingParameters(
            alpha,
            psi,
            kappa,
            in_range=np.ones(len(rows), dtype=bool),
            center_W=rows[:, :3],
            normal_W=np.zeros((0, 3)) if len(self.ellipsoids) else rows[:, NORMAL : NORMAL + 3],
            tau=self.tau,
            hold=HoldCause.OBSTACLES if self.note else HoldCause.NONE,
            note=self.note,
            anew=self.restart,
            verified=True,
            ellipsoids=self.ellipsoids,
        )


@dataclass(frozen=True, eq=False)
class MotionPrediction(Frozen):
    """Whole-arm motion that is expected from the selected motion.

    Attributes:
        motion: of the arm, from when it was computed.
        min_distances: (3,) of tool and links to the solids, and of the arm to itself [m].
        shortfall: of the requested clearance [m].
        limiting_obstacle: label of the solid with the largest shortfall.
        can_follow: whether the arm can follow the tool's motion to the goal.
        lowered: reduction of the requested clearance, as start or goal leave no more [m].
        goal_note: "" or the reason for which there is no feasible posture at the goal.
        touches: label of the solid that the arm touches; "": none.
        sides: sides of the obstacles with their costs, and the one of the motion; for a viewer.
    """

    motion: PlannedMotion = field(default_factory=PlannedMotion)
    min_distances: FloatArray = field(default_factory=lambda: np.full(3, np.inf))
    shortfall: float = 0.0
    limiting_obstacle: str = ""
    can_follow: bool = True
    lowered: float = 0.0
    goal_note: str = ""
    touches: str = ""
    sides: Route = field(default_factory=Route)


@dataclass(frozen=True, eq=False)
class SearchMemory(Frozen):
    """State of the search, from which the next one continues.

    Attributes:
        genes: (7,) of the motion in use; NaN: it has none.
        elites: (k, 7) genes of the best candidates.
        rounds: number of rounds so far.
        is_provisional: whether the motion is the first feasible one, and better ones are searched.
        last_plan: time of the last search for a path in the joints [s].
        travelled: length of the path that the motion has covered [m].
        p_WE: (3,) its end [m].
        counts: (5,) numbers of candidates that the last search rolled out, by source.
    """

    genes: FloatArray = field(default_factory=lambda: np.full(N_GENES, np.nan))
    elites: FloatArray = field(default_factory=lambda: np.zeros((0, N_GENES)))
    rounds: int = 0
    is_provisional: bool = False
    last_plan: float = -math.inf
    travelled: float = 0.0
    p_WE: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    counts: IntArray = field(default_factory=lambda: np.zeros(len(SOURCES), dtype=np.int64))

    def travelled_to(self, policy: PolicyState) -> float:
        """Returns the length of the path that the motion has covered by now [m]."""
        if not np.isfinite(self.p_WE).all():
            return math.dist(policy.p_WE, policy.p_WS)
        return self.travelled + math.dist(policy.p_WE, self.p_WE)


@dataclass(frozen=True, eq=False)
class SelectedMotion(Frozen):
    """Result of a decision of `MotionSearch`."""

    key: MotionKey = field(default_factory=MotionKey)
    command: MotionCommand = field(default_factory=MotionCommand)
    prediction: MotionPrediction = field(default_factory=MotionPrediction)
    memory: SearchMemory = field(default_factory=SearchMemory)

    def changed(self, **parts: Mapping[str, Any]) -> SelectedMotion:
        """Returns it with changed fields, given by the name of their part."""
        new = {name: replace(getattr(self, name), **fields) for name, fields in parts.items()}
        return replace(self, **new)
