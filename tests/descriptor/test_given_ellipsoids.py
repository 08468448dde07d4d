"""Ellipsoids that are known beforehand."""

import numpy as np
import pytest
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder, LeafSystem

from drake_oa.common.messages import EllipsoidSet
from drake_oa.descriptor.given_ellipsoids import GivenEllipsoidSource

ONE = EllipsoidSet(
    stamp=np.inf,
    p_WO=np.zeros((1, 3)),
    R_WO=np.eye(3)[None],
    semi_axes=np.ones((1, 3)),
    v_WO=np.zeros((1, 3)),
    ids=np.zeros(1, dtype=np.int64),
)


class Reader(LeafSystem):
    """Counts how often something computed from the ellipsoids is computed."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0
        port = self.DeclareAbstractInputPort("ellipsoids_W", Value(EllipsoidSet()))
        self.DeclareAbstractOutputPort(
            "seen", lambda: Value(EllipsoidSet()), self._calc, prerequisites_of_calc={port.ticket()}
        )

    def _calc(self, context: Context, output: AbstractValue) -> None:
        self.count += 1
        output.set_value(self.GetInputPort("ellipsoids_W").Eval(context))


def test_what_is_computed_from_it_is_computed_once() -> None:
    builder = DiagramBuilder()
    source = builder.AddSystem(GivenEllipsoidSource(ONE))
    reader = builder.AddSystem(Reader())
    builder.Connect(source.get_output_port(), reader.get_input_port())
    builder.ExportOutput(reader.get_output_port())
    diagram = builder.Build()
    simulator = Simulator(diagram)
    for time in (0.0, 0.1, 0.2):
        simulator.AdvanceTo(time)
        assert diagram.get_output_port().Eval(simulator.get_context()) is ONE
    assert reader.count == 1


def test_anything_else_is_refused() -> None:
    with pytest.raises(TypeError, match="must be an EllipsoidSet, not a list"):
        GivenEllipsoidSource([])  # type: ignore[arg-type]
