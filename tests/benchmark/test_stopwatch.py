"""Time shared out to nested sections."""

import pytest

from drake_oa.benchmark.stopwatch import REST, Stopwatch


class Clocks:
    """Wall time that passes as told, and processor time at half its rate."""

    def __init__(self) -> None:
        self.now = 0.0

    def perf_counter(self) -> float:
        return self.now

    def process_time(self) -> float:
        return 0.5 * self.now


@pytest.fixture
def clocks(monkeypatch):
    clocks = Clocks()
    monkeypatch.setattr("drake_oa.benchmark.stopwatch.time", clocks)
    return clocks


def test_each_moment_is_that_of_the_innermost_section(clocks):
    watch = Stopwatch()
    clocks.now += 1.0
    with watch.section("outer"):
        clocks.now += 2.0
        with watch.section("inner"):
            clocks.now += 4.0
        with watch.section("outer"):
            clocks.now += 8.0
        clocks.now += 16.0
    watch.stop()
    assert {name: one.wall for name, one in watch.spent.items()} == {
        REST: 1.0,
        "outer": 26.0,
        "inner": 4.0,
    }
    assert watch.spent["outer"].processor == 13.0


def test_what_raises_is_charged_and_closed(clocks):
    def fails(seconds: float, *, more: float) -> None:
        clocks.now += seconds + more
        raise RuntimeError("no")

    watch = Stopwatch()
    with pytest.raises(RuntimeError, match="no"):
        watch.watched("call", fails)(1.0, more=2.0)
    clocks.now += 5.0
    watch.stop()
    assert watch.spent["call"].wall == 3.0
    assert watch.spent[REST].wall == 5.0


def test_reset_forgets_what_was_spent_but_not_what_is_open(clocks):
    watch = Stopwatch()
    with watch.section("a"):
        clocks.now += 1.0
        watch.reset()
        clocks.now += 2.0
    assert {name: one.wall for name, one in watch.spent.items()} == {"a": 2.0}
