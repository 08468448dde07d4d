"""Readings of the paper's action level, of which print and released code leave some open."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, kw_only=True)
class Reading:
    """Reading of the paper's action level; T is the demonstrated duration, C the coupling.

    Attributes:
        law: released (code): a = tau^2 alpha_x (beta_x (g - x) - v) + f + C; printed:
            tau z' = alpha_x (beta_x (g - x) - z) + f + C, tau x' = z; running: the running
            system's, with exact turns, whose path depends neither on tau nor on steps (one
            obstacle a scene).
        tau: avoiding path over planned one. widths (released code): through the centre, plus twice
            the greatest width and Delta; semi-axes: plus twice the greatest semi-axis and Delta;
            extreme (print): through the extreme points of the sections.
        time: when a motion ends. fixed: after T; tau: after tau T; until-arrived: from T on when
            it is within 0.4 mm of the goal, after 2 T at the latest.
        chain: the action level that its training set went on.
        scale: what the chain is asked in; in baselines it is the nearest input of its training.
        steps: training (1,000 of 3 ms) or demo (500 of 5 ms, the released demo program).
    """

    law: Literal["released", "printed", "running"] = "released"
    tau: Literal["widths", "semi-axes", "extreme"] = "semi-axes"
    time: Literal["fixed", "tau", "until-arrived"] = "until-arrived"
    chain: Literal["released", "running"] = "released"
    scale: Literal["metres", "baselines"] = "metres"
    steps: Literal["training", "demo"] = "training"


READING = Reading()
"""Reading that agrees best with the paper's Table II."""
