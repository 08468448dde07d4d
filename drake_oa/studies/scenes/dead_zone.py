"""The paper's dead-zone figure: both coupling terms, as strong, on the same action level.

For each gain gamma of the original term (eq. 7), gamma theta exp(-beta |theta|),
the dead-zone free term (eq. 8) of the same peak, gamma / (beta e), and of the same
area over the heading, gamma / beta^2 to each side; kappa = 0, as the original term knows no
distance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drake_oa.common.console import Column, TextTable
from drake_oa.common.messages import FloatArray
from drake_oa.studies.scenes.judge import judge
from drake_oa.studies.scenes.methods import Setting
from drake_oa.studies.scenes.paper_method import BETA, constant_motions
from drake_oa.studies.scenes.scenes import Scenes

GAMMAS = (10.0, 30.0, 100.0, 300.0, 1000.0)


@dataclass(frozen=True, eq=False)
class Comparison:
    """What both terms kept at one gain.

    Attributes:
        gamma: gain of the original term [1/s].
        original: (N,) clearance with the original term [m].
        dead_zone_free: (N,) clearance with the dead-zone free one [m].
    """

    gamma: float
    original: FloatArray
    dead_zone_free: FloatArray


def matched_term(gamma: float) -> tuple[float, float]:
    """alpha [rad/s] and psi [rad] of the same peak and area as the original term."""
    return gamma / (BETA * math.e), 2.0 * math.e / (BETA * math.sqrt(math.pi))


def compare_terms(scenes: Scenes, gammas: Sequence[float] = GAMMAS) -> list[Comparison]:
    """Runs both terms on all scenes at each gain, with the duration not scaled."""
    setting = Setting(constrained=False, scale_time=False)
    found = []
    for gamma in gammas:
        first = constant_motions(scenes, setting, np.array((gamma, BETA, 0.0)), original=True)
        second = constant_motions(scenes, setting, np.array((*matched_term(gamma), 0.0)))
        found.append(
            Comparison(
                gamma, judge(scenes, first).kept_clearance, judge(scenes, second).kept_clearance
            )
        )
    return found


def term_figures(comparisons: Sequence[Comparison]) -> list[dict[str, float]]:
    """One row a gain: clearances [m] in the first scene, head-on, and scenes that touch."""
    return [
        {
            "gamma": item.gamma,
            "original_head_on": float(item.original[0]),
            "dead_zone_free_head_on": float(item.dead_zone_free[0]),
            "original_collisions": int((item.original <= 0.0).sum()),
            "dead_zone_free_collisions": int((item.dead_zone_free <= 0.0).sum()),
        }
        for item in comparisons
    ]


def term_table(figures: Sequence[dict[str, float]]) -> TextTable:
    """The rows of `term_figures` as a table."""
    columns = (
        Column("gamma", "terms alone", "gamma = {:g}"),
        Column("original_head_on", "head-on: original [mm]", "{:.1f}", 1e3),
        Column("dead_zone_free_head_on", "dead-zone free [mm]", "{:.1f}", 1e3),
        Column("original_collisions", "collisions: original"),
        Column("dead_zone_free_collisions", "dead-zone free"),
    )
    return TextTable(columns, figures)
