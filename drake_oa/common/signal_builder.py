"""Builder of diagrams that connects output and input ports by the names of their signals.

A signal is a named value: one output port is its source, and any number of input ports read it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeVar

from pydrake.systems.framework import Diagram, DiagramBuilder, InputPort, OutputPort, System
from pydrake.systems.primitives import LogVectorOutput

LOG_PERIOD = 0.004
"""Sampling period of the vector signals that a diagram logs [s]."""

_Added = TypeVar("_Added", bound=System)
_Port = TypeVar("_Port", InputPort, OutputPort)

Names = Mapping[str, str | None]
"""Type of a mapping from port names to signal names, for ports whose signal has another name than
the port.

A signal is a named value, with one output port as its source and any number of input ports that
read it. A port mapped to None is not connected."""


@dataclass
class _SignalSystem:
    """Drake system with the names of the signals (named values) that its ports read and output.

    Attributes:
        system: the Drake system.
        inputs: signal name by input port, for signals with another name than the port; a port
            mapped to None is not connected.
        outputs: signal name by output port, for signals with another name than the port; a port
            mapped to None is not connected.
        interposed: signals that the system reads from their source and replaces for all other
            readers; empty: no signal.
    """

    system: System
    inputs: Names = field(default_factory=dict)
    outputs: Names = field(default_factory=dict)
    interposed: tuple[str, ...] = ()

    @cached_property
    def input_ports(self) -> list[tuple[str, InputPort]]:
        """Input ports of the system, each with the name of the signal that it reads.

        Ports that `inputs` maps to None are left out.
        """
        count = self.system.num_input_ports()
        return self._named(list(map(self.system.get_input_port, range(count))), self.inputs)

    @cached_property
    def output_ports(self) -> dict[str, OutputPort]:
        """Output ports of the system by the name of the signal that they output.

        Ports that `outputs` maps to None are left out.

        Raises:
            ValueError: if several ports output the same signal.
        """
        count = self.system.num_output_ports()
        named = self._named(list(map(self.system.get_output_port, range(count))), self.outputs)
        if len(ports := dict(named)) < len(named):
            names = ", ".join(signal for signal, _ in named)
            raise ValueError(f"several output ports of a system are one signal, of {names}")
        return ports

    def _named(self, ports: list[_Port], names: Names) -> list[tuple[str, _Port]]:
        """Returns the ports of a system with the name of the signal that each reads or outputs.

        If the system has one port and is interposed on one signal, and `names` is empty, the port
        belongs to this signal.

        Args:
            ports: all input ports or all output ports of the system.
            names: signal names of ports whose signal has another name than the port.

        Raises:
            ValueError: if `names` has a port that is not one of `ports`.
        """
        valid = [port.get_name() for port in ports]
        for port in names.keys() - valid:
            name = self.system.get_name() or type(self.system).__name__
            message = f"'{name}' has no port '{port}'; valid ports: {', '.join(valid) or 'none'}"
            raise ValueError(message)
        if len(ports) == 1 == len(self.interposed) and not names:
            return [(self.interposed[0], ports[0])]
        signals = ((names.get(port.get_name(), port.get_name()), port) for port in ports)
        return [(signal, port) for signal, port in signals if signal is not None]


class SignalBuilder:
    """Builder of a diagram whose ports are connected by signal names.

    A signal is a named value with one output port as its source. By default, a port belongs to the
    signal that has the port's name. The arguments `inputs` or `outputs` map a port to another
    signal. `connect` makes all connections at the end::

        builder = DiagramBuilder()
        signals = SignalBuilder(builder)
        signals.add("policy", policy)  # Has an output port desired_position.
        signals.add("controller", controller)  # Its input port desired_position reads it.
        signals.add("camera", camera, outputs={"depth_image_32f": "depth_image"})
        signals.interpose("desired_position", "filter", low_pass)  # policy -> filter -> controller
        signals.log("desired_position")
        signals.export("actuation")
        signals.connect()
        diagram = builder.Build()

    An input port that reads a signal without a source stays unconnected, as optional ports may be.
    The order in which systems are added determines the order of interposed systems, and of events
    at equal times. This order does not matter for other connections, but ``signal in signals``
    considers only sources that have been added before.

    The resulting connections are listed in tests/golden/<scenario>.connections.txt, one
    ``system.port -> system.port`` a line, and printed by ``drake-oa graph <scenario> --signals``.
    """

    def __init__(self, builder: DiagramBuilder) -> None:
        """Initializes the builder without systems and signals.

        Args:
            builder: diagram builder to which `connect` adds the systems.
        """
        self.builder = builder
        self._systems: dict[str, _SignalSystem] = {}
        self._sources: dict[str, OutputPort] = {}
        self._sinks: list[tuple[str, InputPort]] = []
        self._fallbacks: dict[str, str] = {}
        self._logged: list[str] = []
        self._exported: list[str] = []

    def add_source(self, signal: str, port: OutputPort) -> None:
        """Makes an output port the source of a signal.

        Args:
            signal: name of the signal.
            port: output port of a system that is already in the diagram builder.

        Raises:
            ValueError: if the signal already has a source.
        """
        self._check_no_source(signal)
        self._sources[signal] = port

    def add_sink(self, signal: str, port: InputPort) -> None:
        """Makes an input port a reader of a signal, to which `connect` connects the port.

        Args:
            signal: name of the signal; without a source of this signal, the port is not connected.
            port: input port of a system that is already in the diagram builder.
        """
        self._sinks.append((signal, port))

    def set_fallback(self, signal: str, fallback: str) -> None:
        """Connects the readers of `signal` to the signal `fallback` if `signal` has no source."""
        self._fallbacks[signal] = fallback

    def add(
        self,
        name: str,
        system: _Added,
        *,
        inputs: Names | None = None,
        outputs: Names | None = None,
    ) -> _Added:
        """Adds a system whose ports read and output the signals of the same names by default.

        Args:
            name: name of the subsystem.
            system: system to add.
            inputs: signal name by input port, for signals with another name than the port; a port
                mapped to None is not connected.
            outputs: signal name by output port, for signals with another name than the port; a port
                mapped to None is not connected.

        Returns:
            The argument `system`.

        Raises:
            ValueError: if the name is in use, a signal already has a source, or the system lacks a
                port named in `inputs` or `outputs`.
        """
        self._add(name, _SignalSystem(system, inputs or {}, outputs or {}))
        return system

    def replace(
        self,
        name: str,
        system: _Added,
        *,
        inputs: Names | None = None,
        outputs: Names | None = None,
    ) -> _Added:
        """Replaces a system that was added before by another one.

        The new system is interposed on the same signals as the replaced one.

        Args:
            name: name of the subsystem to replace.
            system: new system.
            inputs: signal name by input port, for signals with another name than the port; a port
                mapped to None is not connected. If the argument is None, ports that both systems
                have keep the signals of the replaced system.
            outputs: signal name by output port, with the same rules as for `inputs`.

        Returns:
            The argument `system`.

        Raises:
            ValueError: if no system has that name, a signal already has another source, or the
                system lacks a port named in `inputs` or `outputs`.
        """
        if name not in self._systems:
            raise ValueError(f"there is no system '{name}'; there are {', '.join(self._systems)}")
        systems = dict(self._systems)
        before = self._systems.pop(name)
        own_inputs = {k: v for k, v in before.inputs.items() if system.HasInputPort(k)}
        own_outputs = {k: v for k, v in before.outputs.items() if system.HasOutputPort(k)}
        inputs = own_inputs if inputs is None else inputs
        outputs = own_outputs if outputs is None else outputs
        try:
            self._add(name, _SignalSystem(system, inputs, outputs, before.interposed))
        except ValueError:
            self._systems = systems
            raise
        # The position in the diagram is preserved: it is the order of events at equal times.
        self._systems = {each: self._systems[each] for each in systems}
        return system

    def interpose(
        self,
        signal: str | Sequence[str],
        name: str,
        system: _Added,
        *,
        inputs: Names | None = None,
        outputs: Names | None = None,
    ) -> _Added:
        """Inserts a system between the source of a signal and all its readers.

        The system reads the original signal and outputs its replacement. The ports for this must
        have the name of the signal, or be the only input and the only output port of the system. If
        several systems are interposed on one signal, the first is next to the source.

        Args:
            signal: name of one signal, or of several.
            name: name of the subsystem.
            system: system to insert.
            inputs: signal name by input port, for signals with another name than the port; a port
                mapped to None is not connected.
            outputs: signal name by output port, for signals with another name than the port; a port
                mapped to None is not connected.

        Returns:
            The argument `system`.

        Raises:
            ValueError: if the name is in use, the system does not output the signal, or it lacks a
                port named in `inputs` or `outputs`.
        """
        signals = (signal,) if isinstance(signal, str) else tuple(signal)
        entry = _SignalSystem(system, inputs or {}, outputs or {}, signals)
        for one in signals:
            if one not in entry.output_ports:
                raise ValueError(
                    f"'{name}' cannot be interposed on '{one}': its output signals are "
                    f"{', '.join(entry.output_ports) or 'none'}; map its port by outputs="
                )
        self._add(name, entry)
        return system

    def log(self, *signals: str) -> None:
        """Logs vector signals every `LOG_PERIOD` (4 ms) in sinks named log_<signal>.

        A sink is a VectorLogSink of Drake. Signals without a source are skipped.
        """
        self._logged += [name for name in signals if name not in self._logged]

    def export(self, *signals: str) -> None:
        """Exports signals as output ports of the diagram; signals without a source are skipped."""
        self._exported += signals

    def __contains__(self, signal: str) -> bool:
        """Checks whether a signal has a source among the systems added so far."""
        return self._source(signal) is not None

    def connect(self) -> None:
        """Adds the systems to the diagram builder and connects each signal to its readers.

        Raises:
            ValueError: if a system is interposed on a signal without a source.
        """
        for name, entry in self._systems.items():
            self.builder.AddNamedSystem(name, entry.system)
        for name, entry in self._systems.items():
            for signal, port in entry.input_ports:
                source = self._source(signal, name if signal in entry.interposed else None)
                if source is not None:
                    self.builder.Connect(source, port)
                elif signal in entry.interposed:
                    raise ValueError(
                        f"'{name}' is interposed on '{signal}', which has no source; signals with "
                        f"a source are {', '.join(sorted(self._signals()))}"
                    )
        for signal, port in self._sinks:
            if (source := self._source(signal)) is not None:
                self.builder.Connect(source, port)
        for signal in filter(self.__contains__, self._logged):
            sink = LogVectorOutput(self._source(signal), self.builder, LOG_PERIOD)
            sink.set_name(f"log_{signal}")
        for signal in filter(self.__contains__, self._exported):
            self.builder.ExportOutput(self._source(signal), signal)

    def _add(self, name: str, entry: _SignalSystem) -> None:
        """Registers a system and its signals, which `connect` adds to the diagram builder.

        Args:
            name: name of the subsystem.
            entry: system with the signals of its ports.

        Raises:
            ValueError: if the name is in use, a signal that the system outputs already has a
                source, or the system lacks a port that `entry.inputs` or `entry.outputs` name.
        """
        if name in self._systems or self.builder.HasSubsystemNamed(name):
            raise ValueError(
                f"there is already a system '{name}'; use SignalBuilder.replace to replace it"
            )
        entry.system.set_name(name)
        _ = entry.input_ports  # Checks the names of input ports.
        for signal in entry.output_ports:
            if signal not in entry.interposed:
                self._check_no_source(signal)
        self._systems[name] = entry

    def _check_no_source(self, signal: str) -> None:
        """Checks that a signal has no source yet.

        Raises:
            ValueError: if the signal already has a source.
        """
        if signal in self._signals():
            raise ValueError(
                f"the signal '{signal}' already has a source; use SignalBuilder.interpose to "
                "modify the signal, or SignalBuilder.replace to replace its source"
            )

    def _signals(self) -> set[str]:
        """Returns the names of all signals that have a source."""
        signals = set(self._sources)
        for entry in self._systems.values():
            signals |= entry.output_ports.keys() - set(entry.interposed)
        return signals

    def _source(self, signal: str, before: str | None = None) -> OutputPort | None:
        """Returns the output port to which readers of a signal are connected.

        The result is the output port of the last system interposed on the signal (between its
        source and its readers); otherwise the source of the signal; otherwise the source of the
        fallback signal, which readers use if the signal has no source.

        Args:
            signal: name of the signal.
            before: name of the reader if the reader is interposed on the signal; only systems
                interposed before this reader are considered. None: all are considered.

        Returns:
            Output port; None if the signal has no source.
        """
        port = self._sources.get(signal)
        for entry in self._systems.values():
            if signal not in entry.interposed and signal in (output_ports := entry.output_ports):
                port = output_ports[signal]
        if port is None and signal in self._fallbacks:
            port = self._source(self._fallbacks[signal], before)
        for name, entry in self._systems.items():
            if name == before:
                break
            if signal in entry.interposed:
                port = entry.output_ports[signal]
        return port


def connections(diagram: Diagram) -> list[tuple[str, str]]:
    """Returns the connections between the systems of a diagram, in alphabetical order.

    Each connection is a tuple of output port and input port, each as "system.port".
    """
    return sorted(
        (
            f"{source.get_name()}.{source.get_output_port(out).get_name()}",
            f"{reader.get_name()}.{reader.get_input_port(into).get_name()}",
        )
        for (reader, into), (source, out) in diagram.connection_map().items()
    )
