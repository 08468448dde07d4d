"""Signals by name: offered, read, put between, replaced, left open."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import Adder, ConstantVectorSource, Gain, PassThrough

from drake_oa.common.signal_builder import SignalBuilder, connections


@pytest.fixture
def signals() -> SignalBuilder:
    return SignalBuilder(DiagramBuilder())


def source(value: float) -> ConstantVectorSource:
    return ConstantVectorSource([value])


def built(signals: SignalBuilder) -> Diagram:
    signals.connect()
    return signals.builder.Build()


def value(diagram: Diagram, name: str) -> float:
    context = diagram.CreateDefaultContext()
    return float(diagram.GetOutputPort(name).Eval(context)[0])


def test_what_is_put_between_changes_what_all_read(signals: SignalBuilder) -> None:
    signals.add("reader", PassThrough(1), inputs={"u": "x"}, outputs={"y": "read"})
    signals.interpose("x", "twice", Gain(2.0, 1))
    signals.add("in", source(3.0), outputs={"y0": "x"})
    signals.interpose("x", "tenfold", Gain(10.0, 1))
    signals.export("x", "read")
    diagram = built(signals)
    assert value(diagram, "x") == value(diagram, "read") == 60.0
    assert ("twice.y0", "tenfold.u0") in connections(diagram)


def test_a_signal_has_another_where_nobody_offers_it(signals: SignalBuilder) -> None:
    signals.set_fallback("solid", "seen")
    signals.add("in", source(3.0), outputs={"y0": "seen"})
    signals.add("reader", PassThrough(1), inputs={"u": "solid"}, outputs={"y": "read"})
    signals.interpose("solid", "twice", Gain(2.0, 1))
    signals.export("seen", "read")
    diagram = built(signals)
    assert (value(diagram, "seen"), value(diagram, "read")) == (3.0, 6.0)


def test_a_system_takes_the_place_of_another(signals: SignalBuilder) -> None:
    signals.add("in", source(3.0), outputs={"y0": "x"})
    signals.add("reader", PassThrough(1), inputs={"u": "x"}, outputs={"y": "read"})
    signals.replace("in", source(4.0))
    signals.export("read")
    assert value(built(signals), "read") == 4.0


def test_inputs_that_nobody_offers_stay_open(signals: SignalBuilder) -> None:
    signals.add("sum", Adder(2, 1), inputs={"u0": "x", "u1": None})
    signals.add("read", source(1.0), outputs={"y0": "x"})
    signals.log("x", "absent")
    assert connections(built(signals)) == [("read.y0", "log_x.data"), ("read.y0", "sum.u0")]
    assert "x" in signals
    assert "absent" not in signals


def test_ports_of_systems_that_are_there_take_part(signals: SignalBuilder) -> None:
    first = signals.builder.AddNamedSystem("first", source(2.0))
    last = signals.builder.AddNamedSystem("last", Gain(np.array([5.0])))
    signals.add_source("x", first.get_output_port())
    signals.interpose("x", "between", Gain(3.0, 1))
    signals.add_sink("x", last.get_input_port())
    signals.add_source("y", last.get_output_port())
    signals.export("y")
    assert value(built(signals), "y") == 30.0


def test_mistakes_are_named(signals: SignalBuilder) -> None:
    signals.add("in", source(3.0), outputs={"y0": "x"})
    with pytest.raises(ValueError, match="'x' has a source already"):
        signals.add("other", source(4.0), outputs={"y0": "x"})
    with pytest.raises(ValueError, match="'x' has a source already"):
        signals.add_source("x", source(1.0).get_output_port())
    with pytest.raises(ValueError, match="there is a system 'in' already"):
        signals.add("in", source(4.0), outputs={"y0": "z"})
    with pytest.raises(ValueError, match=r"no system 'absent'; there are in$"):
        signals.replace("absent", source(4.0))
    with pytest.raises(ValueError, match="'bad' cannot be put behind 'x': it offers y0, y1"):
        signals.interpose("x", "bad", _two())
    signals.interpose("nowhere", "lost", Gain(2.0, 1))
    with pytest.raises(ValueError, match="'lost' is put behind 'nowhere', which nothing offers"):
        signals.connect()


def _two() -> Diagram:
    builder = DiagramBuilder()
    for number in range(2):
        builder.ExportOutput(builder.AddSystem(source(1.0)).get_output_port(), f"y{number}")
    return builder.Build()
