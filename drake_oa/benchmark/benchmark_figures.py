"""The figures of `drake-oa benchmark`, and their table."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from drake_oa.common.text_tables import aligned


@dataclass(frozen=True)
class Figure:
    """One measured figure beside its target and a baseline of the same run.

    Attributes:
        part: part of the benchmark that measured it.
        name: short name.
        value: what was measured, in `unit`.
        unit: "" for a factor.
        relation: ">=" or "<=": how the value has to stand to the target.
        target: what is asked for, in `unit`; None: nothing is.
        baseline: what the baseline takes, in `unit`; None: it could not be measured.
        baseline_name: what the baseline is, or why there is none.
        relative: whether it is `times_better` that is to reach the target instead.
    """

    part: str
    name: str
    value: float
    unit: str
    relation: str
    target: float | None
    baseline: float | None
    baseline_name: str
    relative: bool = False

    @property
    def ratio(self) -> float | None:
        """Value over baseline."""
        return None if self.baseline is None else self.value / self.baseline

    @property
    def times_better(self) -> float | None:
        """How many times better than the baseline: as fast, for a time."""
        ratio = self.ratio
        return ratio if ratio is None or self.relation == ">=" else 1.0 / ratio

    @property
    def met(self) -> bool | None:
        """Whether the target is reached; None where there is none, or nothing to compare."""
        if self.target is None:
            return None
        if self.relative:
            return None if self.times_better is None else self.times_better >= self.target
        return (self.value >= self.target) if self.relation == ">=" else (self.value <= self.target)

    def as_dict(self) -> dict[str, Any]:
        """The fields, and what follows from them."""
        return asdict(self) | {
            "ratio": self.ratio,
            "times_better": self.times_better,
            "met": self.met,
        }


@dataclass(frozen=True)
class Share:
    """Median time of one part of a step, a frame or a decision, in `unit`."""

    part: str
    layer: str
    value: float
    unit: str


def benchmark_table(figures: dict[str, Any]) -> str:
    """What `drake_oa.benchmark.benchmark.run_benchmark` returned, as text."""
    rows = [["", "measured", "target", "", "baseline", "times better", "baseline is"]]
    for item in figures["figures"]:
        rows.append(
            [
                item["name"],
                _quantity(item["value"], item["unit"]),
                _target(item),
                {True: "met", False: "MISSED", None: ""}[item["met"]],
                "-" if item["baseline"] is None else _quantity(item["baseline"], item["unit"]),
                "-" if item["times_better"] is None else _quantity(item["times_better"], ""),
                item["baseline_name"],
            ]
        )
    shares = [["where it goes", "", "median"]]
    shares += [
        [item["part"], item["layer"], _quantity(item["value"], item["unit"])]
        for item in figures["breakdown"]
    ]
    machine = figures["machine"]
    budget = figures["budget"]
    versions = [f"{name} {number}" for name, number in figures["versions"].items()]
    footer = [
        *(f"{part}: {note}" for part, note in figures["notes"].items()),
        f"{machine['cpu']}, {machine['cores']} cores, load {machine['load']:.1f} at the start, "
        f"Python {machine['python']}",
        ", ".join([*versions, f"commit {figures['commit'] or 'unknown'}"]),
    ]
    blocks = [aligned(rows, "lrrlrrl"), ""]
    if len(shares) > 1:
        blocks += [aligned(shares, "llr"), ""]
    if budget:
        blocks += [_budget_table(budget), ""]
    return "\n".join([*blocks, *footer])


def _budget_table(budget: list[dict[str, Any]]) -> str:
    """What each layer takes of a simulated second, and all together."""
    rows = [["a simulated second of the run", "wall", "share", "processor", "each", ""]]
    for item in budget:
        rows.append(
            [
                item["layer"],
                f"{item['wall']:.1f} ms",
                f"{100.0 * item['share']:.1f} %",
                f"{item['processor']:.1f} ms",
                _quantity(item["wall"] / item["rate"], "ms") if item["rate"] else "",
                f"a {item['every']}, {item['rate']:.4g} Hz" if item["rate"] else "",
            ]
        )
    wall, processor = (sum(item[key] for item in budget) for key in ("wall", "processor"))
    rows.append(["all", f"{wall:.1f} ms", "100.0 %", f"{processor:.1f} ms", "", ""])
    factors = (
        f"real time takes 1000 ms: a factor of {1e3 / wall:.2f} by wall time, "
        f"{1e3 / processor:.2f} by processor time"
    )
    return aligned(rows, "lrrrrl") + "\n" + factors


def _target(item: dict[str, Any]) -> str:
    if item["target"] is None:
        return ""
    if item["relative"]:
        return f"{item['target']:g} times better"
    return f"{item['relation']} {_quantity(item['target'], item['unit'])}"


def _quantity(value: float, unit: str) -> str:
    return f"{value:.3g} {unit}".rstrip() if value < 100.0 else f"{value:.0f} {unit}".rstrip()
