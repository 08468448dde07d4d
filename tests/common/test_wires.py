"""Signals by name: offered, read, put between, replaced, left open."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import Adder, ConstantVectorSource, Gain, PassThrough

from drake_oa.common.wires import Wires, connections


@pytest.fixture
def wires() -> Wires:
    return Wires(DiagramBuilder())


def source(value: float) -> ConstantVectorSource:
    return ConstantVectorSource([value])


def built(wires: Wires) -> Diagram:
    wires.connect()
    return wires.builder.Build()


def value(diagram: Diagram, name: str) -> float:
    context = diagram.CreateDefaultContext()
    return float(diagram.GetOutputPort(name).Eval(context)[0])


def test_what_is_put_between_changes_what_all_read(wires: Wires) -> None:
    wires.add("reader", PassThrough(1), reads={"u": "x"}, offers={"y": "read"})
    wires.interpose("x", "twice", Gain(2.0, 1))
    wires.add("in", source(3.0), offers={"y0": "x"})
    wires.interpose("x", "tenfold", Gain(10.0, 1))
    wires.export("x", "read")
    diagram = built(wires)
    assert value(diagram, "x") == value(diagram, "read") == 60.0
    assert ("twice.y0", "tenfold.u0") in connections(diagram)


def test_a_signal_has_another_where_nobody_offers_it(wires: Wires) -> None:
    wires.otherwise("solid", "seen")
    wires.add("in", source(3.0), offers={"y0": "seen"})
    wires.add("reader", PassThrough(1), reads={"u": "solid"}, offers={"y": "read"})
    wires.interpose("solid", "twice", Gain(2.0, 1))
    wires.export("seen", "read")
    diagram = built(wires)
    assert (value(diagram, "seen"), value(diagram, "read")) == (3.0, 6.0)


def test_a_system_takes_the_place_of_another(wires: Wires) -> None:
    wires.add("in", source(3.0), offers={"y0": "x"})
    wires.add("reader", PassThrough(1), reads={"u": "x"}, offers={"y": "read"})
    wires.replace("in", source(4.0))
    wires.export("read")
    assert value(built(wires), "read") == 4.0


def test_inputs_that_nobody_offers_stay_open(wires: Wires) -> None:
    wires.add("sum", Adder(2, 1), reads={"u0": "x", "u1": None})
    wires.add("read", source(1.0), offers={"y0": "x"})
    wires.log("x", "absent")
    assert connections(built(wires)) == [("read.y0", "log_x.data"), ("read.y0", "sum.u0")]
    assert "x" in wires
    assert "absent" not in wires


def test_ports_of_systems_that_are_there_take_part(wires: Wires) -> None:
    first = wires.builder.AddNamedSystem("first", source(2.0))
    last = wires.builder.AddNamedSystem("last", Gain(np.array([5.0])))
    wires.offer("x", first.get_output_port())
    wires.interpose("x", "between", Gain(3.0, 1))
    wires.take("x", last.get_input_port())
    wires.offer("y", last.get_output_port())
    wires.export("y")
    assert value(built(wires), "y") == 30.0


def test_mistakes_are_named(wires: Wires) -> None:
    wires.add("in", source(3.0), offers={"y0": "x"})
    with pytest.raises(ValueError, match="'x' has a source already"):
        wires.add("other", source(4.0), offers={"y0": "x"})
    with pytest.raises(ValueError, match="'x' has a source already"):
        wires.offer("x", source(1.0).get_output_port())
    with pytest.raises(ValueError, match="there is a system 'in' already"):
        wires.add("in", source(4.0), offers={"y0": "z"})
    with pytest.raises(ValueError, match=r"no system 'absent'; there are in$"):
        wires.replace("absent", source(4.0))
    with pytest.raises(ValueError, match="'bad' cannot be put behind 'x': it offers y0, y1"):
        wires.interpose("x", "bad", _two())
    wires.interpose("nowhere", "lost", Gain(2.0, 1))
    with pytest.raises(ValueError, match="'lost' is put behind 'nowhere', which nothing offers"):
        wires.connect()


def _two() -> Diagram:
    builder = DiagramBuilder()
    for number in range(2):
        builder.ExportOutput(builder.AddSystem(source(1.0)).get_output_port(), f"y{number}")
    return builder.Build()
