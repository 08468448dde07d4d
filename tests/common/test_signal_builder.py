"""Tests of `SignalBuilder`: sources, readers, interposed and replaced systems, fallbacks."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import Adder, ConstantVectorSource, Demultiplexer, Gain, PassThrough

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


def test_interposed_systems_change_the_signal_for_all_readers(signals: SignalBuilder) -> None:
    signals.add("reader", PassThrough(1), inputs={"u": "x"}, outputs={"y": "read"})
    signals.interpose("x", "twice", Gain(2.0, 1))
    signals.add("in", source(3.0), outputs={"y0": "x"})
    signals.interpose("x", "tenfold", Gain(10.0, 1))
    signals.export("x", "read")
    diagram = built(signals)
    assert value(diagram, "x") == value(diagram, "read") == 60.0
    assert ("twice.y0", "tenfold.u0") in connections(diagram)


def test_readers_of_a_signal_without_source_read_its_fallback(signals: SignalBuilder) -> None:
    signals.set_fallback("absent", "x")
    signals.add("in", source(3.0), outputs={"y0": "x"})
    signals.add("reader", PassThrough(1), inputs={"u": "absent"}, outputs={"y": "read"})
    signals.interpose("absent", "twice", Gain(2.0, 1))
    signals.export("x", "read")
    diagram = built(signals)
    assert (value(diagram, "x"), value(diagram, "read")) == (3.0, 6.0)


def test_a_replaced_system_keeps_its_connections(signals: SignalBuilder) -> None:
    signals.add("in", source(3.0), outputs={"y0": "x"})
    signals.add("reader", PassThrough(1), inputs={"u": "x"}, outputs={"y": "read"})
    signals.replace("in", source(4.0))
    signals.export("read")
    assert value(built(signals), "read") == 4.0


def test_inputs_without_a_source_stay_unconnected(signals: SignalBuilder) -> None:
    signals.add("sum", Adder(3, 1), inputs={"u0": "x", "u1": None, "u2": "x"})
    signals.add("read", source(1.0), outputs={"y0": "x"})
    signals.log("x", "absent")
    signals.log("x")
    readers = ("log_x.data", "sum.u0", "sum.u2")
    assert connections(built(signals)) == [("read.y0", reader) for reader in readers]
    assert "x" in signals
    assert "absent" not in signals


def test_ports_of_systems_already_in_the_diagram_are_connected(signals: SignalBuilder) -> None:
    first = signals.builder.AddNamedSystem("first", source(2.0))
    last = signals.builder.AddNamedSystem("last", Gain(np.array([5.0])))
    signals.add_source("x", first.get_output_port())
    signals.interpose("x", "between", Gain(3.0, 1))
    signals.add_sink("x", last.get_input_port())
    signals.add_source("y", last.get_output_port())
    signals.export("y")
    assert value(built(signals), "y") == 30.0


def test_errors_name_system_and_signal(signals: SignalBuilder) -> None:
    signals.add("in", source(3.0), outputs={"y0": "x"})
    with pytest.raises(ValueError, match="'x' already has a source"):
        signals.add("other", source(4.0), outputs={"y0": "x"})
    with pytest.raises(ValueError, match="'x' already has a source"):
        signals.add_source("x", source(1.0).get_output_port())
    with pytest.raises(ValueError, match="there is already a system 'in'"):
        signals.add("in", source(4.0), outputs={"y0": "z"})
    with pytest.raises(ValueError, match=r"no system 'absent'; there are in$"):
        signals.replace("absent", source(4.0))
    with pytest.raises(ValueError, match=r"'bad' cannot be interposed on 'x': .* are y0, y1;"):
        signals.interpose("x", "bad", Demultiplexer(2, 1))
    for names in ({"inputs": {"a": "x"}}, {"outputs": {"a": "z"}}):
        with pytest.raises(ValueError, match=r"'p' has no port 'a'; valid ports: [uy]$"):
            signals.add("p", PassThrough(1), **names)
    with pytest.raises(ValueError, match="several output ports of a system are one signal"):
        signals.add("split", Demultiplexer(2, 1), outputs={"y0": "z", "y1": "z"})
    signals.add("b", source(1.0), outputs={"y0": "w"})
    with pytest.raises(ValueError, match="'w' already has a source"):
        signals.replace("in", source(4.0), outputs={"y0": "w"})
    assert "x" in signals
    signals.interpose("nowhere", "lost", Gain(2.0, 1))
    with pytest.raises(ValueError, match="'lost' is interposed on 'nowhere', which has no source"):
        signals.connect()
