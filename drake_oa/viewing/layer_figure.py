"""Figure of a diagram's layers: the systems between camera and torques, and their signals."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from pydrake.systems.framework import Diagram

from drake_oa.common.wires import connections

LAYERS = (
    "late_camera",
    "perception",
    "ellipsoid_descriptor",
    "regressor_chain",
    "cost_ring_selector",
    "motion_verifier",
    "dmp_integrator",
    "motion_guard",
    "controller",
    "plant",
)
"""Names of the drawn subsystems, those that a diagram has, in the order data flows."""
_WIDTH, _HEIGHT, _STEP, _LEFT, _TOP = 210, 44, 92, 215, 12
_PAGE = 630
_STYLE = (
    "<style>text { font: 13px sans-serif; fill: #222 } .name { font-weight: bold }"
    " .small { font-size: 11px; fill: #555 } rect { fill: #eef3fa; stroke: #456 }"
    " path { fill: none; stroke: #456 } .back { stroke-dasharray: 5 4 }</style>"
    '<defs><marker id="tip" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="8" markerHeight="8"'
    ' orient="auto"><path d="M0 0 L8 4 L0 8 z" style="fill: #456"/></marker></defs>'
)


def layer_figure(diagram: Diagram) -> str:
    """Returns an SVG of the layers of a diagram.

    Signals from one layer to the next are beside the arrows, those that skip layers on the right,
    and those that lead back on the left.
    """
    names = [name for name in LAYERS if diagram.HasSubsystemNamed(name)]
    row = {name: number for number, name in enumerate(names)}
    signals: dict[tuple[int, int], list[str]] = {}
    for source, reader in connections(diagram):
        (name, port), reads = source.split(".", 1), reader.split(".", 1)[0]
        if name in row and reads in row and name != reads and (name, reads) not in _UNDRAWN:
            signals.setdefault((row[name], row[reads]), []).append(port)
    parts = [_box(diagram, name, number) for number, name in enumerate(names)]
    lanes: dict[tuple[int, str, bool], list[int]] = {}
    for (one, other), ports in sorted(signals.items()):
        if other == one + 1:
            parts.append(_arrow(one, ports))
        else:
            lanes.setdefault((one, ", ".join(dict.fromkeys(ports)), other < one), []).append(other)
    for back in (False, True):
        mine = [(one, port, rows) for (one, port, side), rows in lanes.items() if side == back]
        mine.sort(key=lambda lane: max(abs(other - lane[0]) for other in lane[2]))
        begun = [lane[0] for lane in mine]
        parts += [
            _lane(*lane, back, number, begun[:number].count(lane[0]))
            for number, lane in enumerate(mine)
        ]
    height = 2 * _TOP + (len(names) - 1) * _STEP + _HEIGHT
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_PAGE} {height}" '
        f'width="{_PAGE}" height="{height}">{_STYLE}{"".join(parts)}</svg>\n'
    )


_UNDRAWN = {("late_camera", "motion_verifier"), ("plant", "late_camera")}
"""Connections of the simulation itself."""


def _box(diagram: Diagram, name: str, row: int) -> str:
    kind = type(diagram.GetSubsystemByName(name)).__name__.rstrip("_")
    y, middle = _TOP + row * _STEP, _LEFT + _WIDTH / 2
    return (
        f'<rect x="{_LEFT}" y="{y}" width="{_WIDTH}" height="{_HEIGHT}" rx="6"/>'
        f'<text class="name" x="{middle}" y="{y + 19}" text-anchor="middle">{escape(kind)}</text>'
        f'<text class="small" x="{middle}" y="{y + 35}" text-anchor="middle">{name}</text>'
    )


def _arrow(row: int, ports: Sequence[str]) -> str:
    y, x = _TOP + row * _STEP + _HEIGHT, _LEFT + _WIDTH / 2
    return f'<path d="M{x} {y} V{y + _STEP - _HEIGHT}" marker-end="url(#tip)"/>' + "".join(
        _label(x + 8, y + 15 + 13 * line, text) for line, text in enumerate(_lines(ports))
    )


def _lane(row: int, port: str, readers: Sequence[int], back: bool, lane: int, earlier: int) -> str:
    """Draws a signal to layers that are not the next one: on the right, or back on the left.

    Args:
        row: of the layer that it comes from.
        port: its name.
        readers: rows of the layers that read it.
        back: whether these come before.
        lane: number of the vertical line.
        earlier: number of lines from the same layer that are drawn above.
    """
    edge, sign = (_LEFT, -1) if back else (_LEFT + _WIDTH, 1)
    x, begin = edge + sign * (125 + 20 * lane), _TOP + row * _STEP + (12 if back else 30)
    begin += 13 * earlier
    ends = [_TOP + reader * _STEP + (34 if back else 12) for reader in readers]
    path = '<path class="back" d="' if back else '<path d="'
    tip = '" marker-end="url(#tip)"/>'
    paths = "".join(f"{path}M{x} {begin} V{y} H{edge}{tip}" for y in ends)
    stub = f'{path}M{edge} {begin} H{x}"/>'
    return stub + paths + _label(edge + sign * 5, begin - 4, port, "end" if back else "start")


def _lines(ports: Sequence[str]) -> list[str]:
    """Returns the names of ports, two a line."""
    names = list(dict.fromkeys(ports))
    return [", ".join(names[first : first + 2]) for first in range(0, len(names), 2)]


def _label(x: float, y: float, text: str, anchor: str = "start") -> str:
    return f'<text class="small" x="{x}" y="{y}" text-anchor="{anchor}">{escape(text)}</text>'
