"""A method simple enough to know its figures by heart."""

from collections.abc import Callable

import numpy as np
import pytest

from drake_oa.studies.scenes.methods import Setting
from drake_oa.studies.scenes.motions import Motions
from drake_oa.studies.scenes.scenes import DURATION, Scenes

STEPS = 100


def straight_motions(scenes: Scenes, setting: Setting) -> Motions:
    """The unmodulated minimum-jerk motion, which avoids nothing."""
    s = np.linspace(0.0, 1.0, STEPS + 1)
    path = np.zeros((len(scenes), STEPS + 1, 3))
    velocity = np.zeros_like(path)
    path[..., 0] = scenes.baseline[:, None] * s**3 * (10.0 - 15.0 * s + 6.0 * s * s)
    velocity[..., 0] = scenes.baseline[:, None] * 30.0 * (s * (1.0 - s)) ** 2 / DURATION
    seconds = 1e-6 * STEPS * len(scenes)
    return Motions(path, velocity, np.full(len(scenes), DURATION), seconds)


@pytest.fixture
def straight() -> Callable[[Scenes, Setting], Motions]:
    """The unmodulated motion as a method: a microsecond a step."""
    return straight_motions
