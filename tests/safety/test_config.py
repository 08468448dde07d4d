"""The blocks of safety refuse what they cannot go by."""

import math
from typing import Any

import pytest

from drake_oa.common.config import check_values
from drake_oa.safety.config import EvasionSettings, SupervisorSettings


def test_the_defaults_are_valid() -> None:
    check_values(SupervisorSettings())
    check_values(EvasionSettings())


@pytest.mark.parametrize(
    ("block", "change"),
    [
        (SupervisorSettings, {"reaction_time": 0.0}),
        (SupervisorSettings, {"stop_distance": -0.1}),
        (SupervisorSettings, {"patience": math.nan}),
        (SupervisorSettings, {"tracking_slow": 0.1}),
        (SupervisorSettings, {"hold_below": 0.4}),
        (SupervisorSettings, {"leave_scale": 2.0}),
        (EvasionSettings, {"margin": 0.0}),
        (EvasionSettings, {"growth": -1.0}),
        (EvasionSettings, {"instants": 1}),
        (EvasionSettings, {"short_ways": [0.1]}),
    ],
)
def test_bad_values_are_refused(block: type, change: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"{block.__name__}.{next(iter(change))}"):
        check_values(block(**change))
