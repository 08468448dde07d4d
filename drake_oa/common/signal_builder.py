"""Signals of a diagram by name: their sources, their readers, and systems put between.

A system offers its outputs, and reads its inputs, under the names of their ports; all is
connected at the end, so that the order in which systems are added does not matter. A signal
that nobody offers leaves the inputs open that would read it: optional ones are meant to be.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeVar

from pydrake.systems.framework import Diagram, DiagramBuilder, InputPort, OutputPort, System
from pydrake.systems.primitives import LogVectorOutput

LOG_PERIOD = 0.004
"""Time between logged instants [s]."""

_Added = TypeVar("_Added", bound=System)
_Port = TypeVar("_Port", InputPort, OutputPort)

Names = Mapping[str, str | None]
"""Port -> signal, where it is not the port's own name; None: it is left open."""


@dataclass
class _SignalSystem:
    """A system, and the signals of its ports."""

    system: System
    inputs: Names = field(default_factory=dict)
    outputs: Names = field(default_factory=dict)
    behind: tuple[str, ...] = ()

    def input_ports(self) -> dict[str, InputPort]:
        """Returns signal -> input port."""
        count = self.system.num_input_ports()
        return self._named(list(map(self.system.get_input_port, range(count))), self.inputs)

    @cached_property
    def output_ports(self) -> dict[str, OutputPort]:
        """Signal -> output port."""
        count = self.system.num_output_ports()
        return self._named(list(map(self.system.get_output_port, range(count))), self.outputs)

    def _named(self, ports: list[_Port], names: Names) -> dict[str, _Port]:
        if len(ports) == 1 == len(self.behind) and not names:
            return {self.behind[0]: ports[0]}
        signals = {names.get(port.get_name(), port.get_name()): port for port in ports}
        return {signal: port for signal, port in signals.items() if signal is not None}


class SignalBuilder:
    """Adds systems to a builder and connects them by the names of their signals."""

    def __init__(self, builder: DiagramBuilder) -> None:
        """SignalBuilder nothing yet.

        Args:
            builder: receives the systems with `connect`.
        """
        self.builder = builder
        self._systems: dict[str, _SignalSystem] = {}
        self._offered: dict[str, OutputPort] = {}
        self._taken: list[tuple[str, InputPort]] = []
        self._otherwise: dict[str, str] = {}
        self._logged: list[str] = []
        self._exported: list[str] = []

    def add_source(self, signal: str, port: OutputPort) -> None:
        """Makes the port of a system that is in the builder already the source of a signal.

        Raises:
            ValueError: if the signal has a source.
        """
        self._refuse_second(signal)
        self._offered[signal] = port

    def add_sink(self, signal: str, port: InputPort) -> None:
        """Has an input of a system that is in the builder already read a signal."""
        self._taken.append((signal, port))

    def set_fallback(self, signal: str, instead: str) -> None:
        """Connects readers of a signal without a source to another signal."""
        self._otherwise[signal] = instead

    def add(
        self,
        name: str,
        system: _Added,
        *,
        inputs: Names | None = None,
        outputs: Names | None = None,
    ) -> _Added:
        """Adds a system, which offers and reads signals by the names of its ports.

        Args:
            name: of the subsystem.
            system: that is added.
            inputs: input port -> signal, where it is another name; None leaves the port open.
            outputs: output port -> signal, likewise.

        Returns:
            The system.

        Raises:
            ValueError: if there is a subsystem of that name, or a signal has a source.
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
        """Puts a system in the place of one that was added under this name.

        Args:
            name: of the subsystem.
            system: that is there from now on.
            inputs: as for `add`; None: as of the system before.
            outputs: likewise.

        Raises:
            ValueError: if there is none of that name, or a signal has another source.
        """
        if name not in self._systems:
            raise ValueError(f"there is no system '{name}'; there are {', '.join(self._systems)}")
        names = list(self._systems)
        before = self._systems.pop(name)
        inputs = before.inputs if inputs is None else inputs
        outputs = before.outputs if outputs is None else outputs
        self._add(name, _SignalSystem(system, inputs, outputs, before.behind))
        # In the place of the one before, which is that of its events at equal times.
        self._systems = {each: self._systems[each] for each in names}
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
        """Puts a system between a signal's source and all that read it.

        The system reads the signal as it was and offers what it is from now on, by ports of the
        signal's name, or by its only ones. What is interposed later comes behind.

        Args:
            signal: which, or several.
            name: of the subsystem.
            system: that is added.
            inputs: as for `add`.
            outputs: as for `add`.

        Raises:
            ValueError: if there is a subsystem of that name, or it does not offer the signal.
        """
        signals = (signal,) if isinstance(signal, str) else tuple(signal)
        wired = _SignalSystem(system, inputs or {}, outputs or {}, signals)
        for one in signals:
            if one not in wired.output_ports:
                raise ValueError(
                    f"'{name}' cannot be put behind '{one}': it offers "
                    f"{', '.join(wired.output_ports) or 'nothing'}"
                )
        self._add(name, wired)
        return system

    def log(self, *signals: str) -> None:
        """Logs vector signals every `LOG_PERIOD` in sinks log_<signal>, those that are offered."""
        self._logged += signals

    def export(self, *signals: str) -> None:
        """Makes signals outputs of the diagram."""
        self._exported += signals

    def __contains__(self, signal: str) -> bool:
        """Returns whether a signal has a source so far."""
        return self._source(signal) is not None

    def connect(self) -> None:
        """Adds the systems to the builder and connects the readers of signals to their sources.

        Raises:
            ValueError: if a system is put behind a signal that nobody offers.
        """
        for name, wired in self._systems.items():
            self.builder.AddNamedSystem(name, wired.system)
        for name, wired in self._systems.items():
            for signal, port in wired.input_ports().items():
                source = self._source(signal, name if signal in wired.behind else None)
                if source is not None:
                    self.builder.Connect(source, port)
                elif signal in wired.behind:
                    raise ValueError(
                        f"'{name}' is put behind '{signal}', which nothing offers; there are "
                        f"{', '.join(sorted(self._signals()))}"
                    )
        for signal, port in self._taken:
            if (source := self._source(signal)) is not None:
                self.builder.Connect(source, port)
        for signal in filter(self.__contains__, self._logged):
            sink = LogVectorOutput(self._source(signal), self.builder, LOG_PERIOD)
            sink.set_name(f"log_{signal}")
        for signal in filter(self.__contains__, self._exported):
            self.builder.ExportOutput(self._source(signal), signal)

    def _add(self, name: str, wired: _SignalSystem) -> None:
        if name in self._systems or self.builder.HasSubsystemNamed(name):
            raise ValueError(
                f"there is a system '{name}' already; SignalBuilder.replace takes its place"
            )
        for signal in wired.output_ports:
            if signal not in wired.behind:
                self._refuse_second(signal)
        self._systems[name] = wired

    def _refuse_second(self, signal: str) -> None:
        if signal in self._signals():
            raise ValueError(
                f"the signal '{signal}' has a source already; SignalBuilder.interpose puts a system behind "
                "it, SignalBuilder.replace in its place"
            )

    def _signals(self) -> set[str]:
        offered = set(self._offered)
        for wired in self._systems.values():
            offered |= wired.output_ports.keys() - set(wired.behind)
        return offered

    def _source(self, signal: str, before: str | None = None) -> OutputPort | None:
        """The port that a signal comes from; as `before` reads it, which is put behind it."""
        found = self._offered.get(signal)
        for wired in self._systems.values():
            if signal not in wired.behind and signal in (output_ports := wired.output_ports):
                found = output_ports[signal]
        if found is None and signal in self._otherwise:
            found = self._source(self._otherwise[signal], before)
        for name, wired in self._systems.items():
            if name == before:
                break
            if signal in wired.behind:
                found = wired.output_ports[signal]
        return found


def connections(diagram: Diagram) -> list[tuple[str, str]]:
    """Source and reader of each connection of a diagram, as "system.port", sorted."""
    return sorted(
        (
            f"{source.get_name()}.{source.get_output_port(out).get_name()}",
            f"{reader.get_name()}.{reader.get_input_port(into).get_name()}",
        )
        for (reader, into), (source, out) in diagram.connection_map().items()
    )
