"""The route as a verified motion takes it, for whoever shows it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import Context, LeafSystem

from drake_oa.common.messages import (
    CouplingParameters,
    Route,
)
from drake_oa.common.ports import read_value


class TakenRoute(LeafSystem):
    """Puts the side of a verified motion into the route that the cost rings decided.

    .. pydrake_system::

      name: TakenRoute
      input_ports:
      - route
      - coupling_parameters
      output_ports:
      - route_taken

    - route: abstract `Route`, M rows: `CostRingSelector`'s, with its rings.
    - coupling_parameters: abstract `CouplingParameters`, M rows:
      `VerifiedRegressorChain`'s, whose side need not be the rings'.
    - route_taken: abstract `Route`, M rows: direction and normal of the side that the
      motion is bent to, and a clearance of 0 for obstacles that do not bend it.

    There is no state.
    """

    def __init__(self) -> None:
        """Declares the ports."""
        super().__init__()
        self._route = self.DeclareAbstractInputPort("route", Value(Route()))
        self._coupling = self.DeclareAbstractInputPort(
            "coupling_parameters", Value(CouplingParameters())
        )
        self.DeclareAbstractOutputPort(
            "route_taken",
            lambda: Value(Route()),
            self._calc_route,
            prerequisites_of_calc={self._route.ticket(), self._coupling.ticket()},
        )

    def _calc_route(self, context: Context, output: AbstractValue) -> None:
        route = read_value(self, self._route, context, Route)
        coupling = read_value(self, self._coupling, context, CouplingParameters)
        output.set_value(taken_route(route, coupling))


def taken_route(route: Route, coupling: CouplingParameters) -> Route:
    """The route with the side that coupling in given planes takes, see `TakenRoute`.

    Raises:
        ValueError: if the two do not have the same rows.
    """
    if len(route.ids) != len(coupling):
        raise ValueError(
            f"route has {len(route.ids)} rows, coupling_parameters {len(coupling)}: they must be "
            "of the same obstacles"
        )
    bent = coupling.alpha > 0.0
    direction_W, normal_W = np.array(route.direction_W), np.array(route.normal_W)
    normal_W[bent] = coupling.normal_W[bent]
    # The normal is x_L x omega.
    direction_W[bent] = np.cross(coupling.normal_W[bent], route.R_WL[:, 0])
    least = np.finfo(float).tiny
    return replace(
        route,
        direction_W=direction_W,
        normal_W=normal_W,
        clearance=np.where(bent, np.maximum(route.clearance, least), 0.0),
    )
