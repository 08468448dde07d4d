import dataclasses as dc

import pytest

from drake_oa.common.config import ScenarioError, check_values, count, number, vector


@dc.dataclass
class Inner:
    low: float = number(1.0, "m", 0.0, 10.0, below="high")
    high: float = number(2.0, "m", 0.0, 10.0)


@dc.dataclass
class Outer:
    times: int = count(3, 1, 9)
    place: list[float] = vector([0.0, 0.0], "m")
    inner: Inner = dc.field(default_factory=Inner)
    more: list[Inner] = dc.field(default_factory=lambda: [Inner()])
    perhaps: float | None = dc.field(default=None, metadata={"unit": "s"})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"times": 0}, r"Outer.times: 0 is outside \[1, 9\]"),
        ({"times": 2.5}, "Outer.times: expected a whole number"),
        ({"place": [1.0]}, "Outer.place: expected 2 numbers"),
        ({"inner": Inner(low=-1.0)}, r"Outer.inner.low: -1.0 is outside \[0, 10\] \[m\]"),
        ({"inner": Inner(low=2.0)}, "Outer.inner.low must be less than high, not 2.0 and 2.0"),
        ({"more": [Inner(), Inner(high=11.0)]}, r"Outer.more\[1\].high: 11.0 is outside"),
        ({"perhaps": float("nan")}, "Outer.perhaps: must be a finite number"),
    ],
)
def test_a_value_made_in_python_is_held_against_its_field(changes, message):
    check_values(Outer())
    check_values(Outer(perhaps=1.0))
    with pytest.raises(ScenarioError, match=message):
        check_values(Outer(**changes))


def test_the_name_of_the_block_may_be_given():
    with pytest.raises(ScenarioError, match=r"perception.noise.low must"):
        check_values(Inner(low=3.0), "perception.noise")
