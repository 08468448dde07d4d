"""What the policy goes by until it is seen or decided anew, laid out for its kernel."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from drake_oa.common.messages import (
    PART,
    CouplingParameters,
    EllipsoidSet,
    FloatArray,
    Frozen,
    Route,
)
from drake_oa.geometry.ellipsoid import shape_matrix
from drake_oa.policy import action_kernels as kernels
from drake_oa.policy.coupling import CouplingTerms


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
