"""The figures of an evaluation as text, with the paper's own beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from drake_oa.common.text_tables import aligned

TABLE_II: dict[float, dict[str, Any]] = {
    0.5: {
        "clearance_mean": 0.144,
        "clearance_min": -5.01e-4,
        "goal_error_mean": 4.41e-4,
        "goal_error_max": 0.017,
        "collisions": 2,
    },
    1.0: {
        "clearance_mean": 0.184,
        "clearance_min": 0.060,
        "goal_error_mean": 4.23e-4,
        "goal_error_max": 0.017,
        "collisions": 0,
    },
    1.5: {
        "clearance_mean": 0.196,
        "clearance_min": 0.068,
        "goal_error_mean": 5.22e-4,
        "goal_error_max": 0.023,
        "collisions": 0,
    },
    2.0: {
        "clearance_mean": 0.202,
        "clearance_min": 0.076,
        "goal_error_mean": 6.49e-4,
        "goal_error_max": 0.027,
        "collisions": 0,
    },
}
"""What the paper prints for its 4 x 1,000 novel scenes (tab:results_unseen_metrics)."""

_COLUMNS = (
    ("scenes", "scenes", "{:d}", 1.0),
    ("collisions", "collisions", "{:d}", 1.0),
    ("clearance_mean", "clearance mean [m]", "{:.3f}", 1.0),
    ("clearance_min", "min [m]", "{:.4f}", 1.0),
    ("short_of_feasible", "short", "{:d}", 1.0),
    ("goal_error_mean", "goal error mean [mm]", "{:.3f}", 1e3),
    ("goal_error_max", "max [mm]", "{:.3f}", 1e3),
    ("path_ratio_mean", "path ratio", "{:.3f}", 1.0),
)
_WHOLE = (
    *_COLUMNS[:3],
    ("clearance_mean_feasible", "where feasible [m]", "{:.3f}", 1.0),
    *_COLUMNS[3:],
    ("step_us", "step [us]", "{:.3g}", 1.0),
    ("seconds", "seconds", "{:.2f}", 1.0),
)


def evaluation_table(figures: Mapping[str, Any]) -> str:
    """All methods side by side; then each setting, or each baseline with the paper's figures.

    Args:
        figures: as `drake_oa.studies.scenes.figures.evaluation_figures` makes them.
    """
    methods: Mapping[str, Any] = figures["methods"]
    rows = [
        (name if method["complete"] else f"{name} (not complete)", method)
        for name, method in methods.items()
    ]
    blocks = [text_table("method", rows, _WHOLE)]
    covered = next((m["covers"] for m in methods.values() if "covers" in m), None)
    if covered:
        blocks[0] += f"\n(over: {'; '.join(covered)}; seconds: all settings)"
    for name, method in methods.items():
        if "settings" in method:
            blocks.append(text_table(name, list(method["settings"].items()), _COLUMNS))
        if "by_baseline" in method:
            blocks.append(text_table(name, _baseline_rows(figures["suite"], method), _COLUMNS))
    return "\n\n".join(blocks)


def _baseline_rows(suite: str, method: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any]]]:
    rows: list[tuple[str, Mapping[str, Any]]] = []
    for part in method["by_baseline"]:
        rows.append((f"goal at {part['baseline']:g} m", part))
        if suite == "novel" and part["baseline"] in TABLE_II:
            rows.append(("  the paper prints", TABLE_II[part["baseline"]]))
    return rows


def text_table(
    title: str,
    rows: Sequence[tuple[str, Mapping[str, Any]]],
    columns: Sequence[tuple[str, str, str, float]],
) -> str:
    """A text table; a figure that is not there shows as "-".

    Args:
        title: of the first column.
        rows: name and figures each.
        columns: key, heading, format and factor each.
    """
    cells = [[title, *(heading for _, heading, _, _ in columns)]]
    for name, figures in rows:
        row = [name]
        for key, _, form, factor in columns:
            value = figures.get(key)
            if value is None:
                row.append("-")
            else:
                row.append(form.format(value if isinstance(value, int) else value * factor))
        cells.append(row)
    return aligned(cells, "l" + "r" * len(columns))
