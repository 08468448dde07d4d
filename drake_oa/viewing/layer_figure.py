"""Drawing of a diagram's layers as an N2 chart: a table with the systems from camera to torques on
its diagonal, and their signals beside it.
"""

from __future__ import annotations

from html import escape

from pydrake.systems.framework import Diagram

from drake_oa.common.signal_builder import connections

_CAMERAS = ("delayed_", "live_", "bag_")
"""Prefixes of the names of systems that output images: simulated, real and recorded cameras."""
_LAYERS = (
    "perception",
    "collision_scene",
    "ellipsoid_descriptor",
    "regressor_chain",
    "cost_ring_selector",
    "motion_verifier",
    "dmp_integrator",
    "motion_guard",
    "controller",
    "plant",
)
"""Names of the subsystems that `layer_figure` draws after the cameras, in the order of data flow.
Subsystems that a diagram lacks are skipped."""
_WIDTH, _HEIGHT, _LINE = 170, 76, 15
"""Width and height of one field of the N2 chart (table of systems and signals) that `layer_figure`
draws, and height of a text line [pixel]."""
_STYLE = (
    "<style>text { font: 13px sans-serif; fill: #222; text-anchor: middle }"
    " .name { font-weight: bold } .small { font-size: 11px; fill: #555 }"
    " rect { fill: #eef3fa; stroke: #456 } .signal { fill: #fff; stroke: #cdd }</style>"
)
"""SVG element with the CSS style of texts and fields in the chart that `layer_figure` draws."""


def layer_figure(diagram: Diagram) -> str:
    """Draws the layers of a diagram and their signals as an N2 chart, a table of systems and
    signals, in SVG.

    The layers are on the diagonal of the chart. A signal is in the row of the layer that outputs
    the signal and in the column of the layer that reads it. Signals above the diagonal go forward;
    signals below the diagonal are feedback.

    Args:
        diagram: diagram with cameras and some of the subsystems `_LAYERS`.

    Returns:
        Text of an SVG file.
    """
    systems = [system.get_name() for system in diagram.GetSystems()]
    names = [name for name in systems if name.startswith(_CAMERAS)]
    names += [name for name in _LAYERS if name in systems]
    cells = {
        (name, name): [type(diagram.GetSubsystemByName(name)).__name__.rstrip("_"), name]
        for name in names
    }
    for source, reader in connections(diagram):
        (name, port), inputs = source.split(".", 1), reader.split(".", 1)[0]
        if name in names and inputs in names and name != inputs:
            ports = cells.setdefault((name, inputs), [])
            ports += [port] * (port not in ports)
    parts = []
    for (name, inputs), lines in cells.items():
        x, y = _WIDTH * names.index(inputs), _HEIGHT * names.index(name)
        kind = ' class="signal"' if name != inputs else ' rx="6"'
        parts.append(f'<rect{kind} x="{x}" y="{y}" width="{_WIDTH}" height="{_HEIGHT}"/>')
        for number, line in enumerate(lines):
            of = "small" if number or name != inputs else "name"
            height = y + _HEIGHT / 2 + _LINE * (number - len(lines) / 2 + 0.8)
            parts.append(f'<text class="{of}" x="{x + _WIDTH / 2}" y="{height}">')
            parts.append(f"{escape(line)}</text>")
    width, height = _WIDTH * len(names), _HEIGHT * len(names)
    size = f'viewBox="-1 -1 {width + 2} {height + 2}" width="{width}" height="{height}"'
    svg = f'<svg xmlns="http://www.w3.org/2000/svg" {size}>'
    return f"{svg}{_STYLE}{''.join(parts)}</svg>\n"
