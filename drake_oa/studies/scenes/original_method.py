"""The method `original`: Hoffmann's avoidance term on the paper's action level.

(eq. oa_original) about each obstacle's centre, summed, with the published gains; nothing
regulates it, and it knows neither the obstacle's size nor the clearance asked for.
"""

from __future__ import annotations

import math

import numpy as np

from drake_oa.studies.scenes.methods import Setting
from drake_oa.studies.scenes.motions import Motions
from drake_oa.studies.scenes.paper_method import constant_motions
from drake_oa.studies.scenes.scenes import Scenes

GAMMA = 1000.0
"""gamma [1/s]."""

BETA = 20.0 / math.pi
"""beta [1/rad]."""


def run(scenes: Scenes, setting: Setting) -> Motions:
    """Hoffmann's term in N scenes; of the setting, only whether tau scales the time counts."""
    return constant_motions(scenes, setting, np.array((GAMMA, BETA, 0.0)), original=True)
