"""The abstract state, and with it the output ports, that all perception sources share."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue, Value
from pydrake.perception import PointCloud
from pydrake.systems.framework import AbstractStateIndex, Context, LeafSystem, State

from drake_oa.common.messages import Frozen, ObstacleClouds
from drake_oa.perception.obstacle_memory import ObstacleMemory

_logger = logging.getLogger("drake_oa")


@dataclass(frozen=True, eq=False)
class _Points(Frozen):
    points_W: NDArray[np.floating] = field(default_factory=lambda: np.zeros((0, 3)))


@dataclass(frozen=True)
class PerceptionState:
    """Where a perception source keeps what it last saw, in its Context.

    Attributes:
        obstacles: index of the ObstacleClouds.
        points: index of the points to view.
        memory: index of the ObstacleMemory that the obstacles were taken from; an empty
            one where a source needs none.
    """

    obstacles: AbstractStateIndex
    points: AbstractStateIndex
    memory: AbstractStateIndex

    @staticmethod
    def declare(system: LeafSystem) -> PerceptionState:
        """Declares the state, and the output ports ``obstacles_W`` and ``cloud`` on it."""
        indices = PerceptionState(
            system.DeclareAbstractState(Value(ObstacleClouds())),
            system.DeclareAbstractState(Value(_Points())),
            system.DeclareAbstractState(Value(ObstacleMemory())),
        )
        system.DeclareStateOutputPort("obstacles_W", indices.obstacles)
        system.DeclareAbstractOutputPort(
            "cloud",
            lambda: Value(PointCloud(0)),
            indices.calc_cloud,
            prerequisites_of_calc={system.abstract_state_ticket(indices.points)},
        )
        return indices

    def calc_cloud(self, context: Context, output: AbstractValue) -> None:
        """The points as a PointCloud. It is made on demand: a Context that held it would
        copy it at every step of every system."""
        values: Any = context.get_abstract_state()
        points_W = values.get_value(int(self.points)).get_value().points_W
        cloud = PointCloud(len(points_W))
        cloud.mutable_xyzs()[:] = points_W.T
        output.set_value(cloud)

    def read(self, context: Context) -> ObstacleMemory:
        """What is remembered in a Context."""
        values: Any = context.get_abstract_state()
        memory: ObstacleMemory = values.get_value(int(self.memory)).get_value()
        return memory

    def write(
        self, state: State, memory: ObstacleMemory, points_W: NDArray[np.floating] | None
    ) -> None:
        """Stores the memory and, unless it is None, the cloud to view, (N, 3) [m]."""
        values: Any = state.get_mutable_abstract_state()
        values.get_mutable_value(int(self.obstacles)).set_value(memory.obstacles)
        values.get_mutable_value(int(self.memory)).set_value(memory)
        if points_W is not None:
            values.get_mutable_value(int(self.points)).set_value(_Points(points_W))


def log_change(system: LeafSystem, before: str, now: str, time: float) -> None:
    """Reports once when the note of a source changes from ``before`` to ``now``."""
    if now == before:
        return
    name = system.get_name() or type(system).__name__
    if now:
        _logger.warning("%s at %.3f s: %s; the last obstacles are kept", name, time, now)
    else:
        _logger.info("%s at %.3f s: sees again", name, time)
