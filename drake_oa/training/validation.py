"""Rolls out what a trained chain proposes, where it has not been trained."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drake_oa.common.messages import FloatArray
from drake_oa.policy.dmp import ALPHA_X
from drake_oa.regulation.regressor import ChainWeights
from drake_oa.training.rollouts import planar_rollouts, straight_dmp


@dataclass(frozen=True)
class Validation:
    """Outcome over random ellipses and clearances; lengths in baselines.

    Attributes:
        scenes: number of scenes.
        contacts: how many touched the ellipse.
        kept: share that kept the asked clearance.
        excess_least: worst clearance minus asked clearance.
        excess_mean: mean clearance minus asked clearance.
        arrived: share whose goal error at the end is below 1e-3.
        goal_error_largest: largest goal error at the end of those without contact.
        length_mean: mean path length of those without contact.
    """

    scenes: int
    contacts: int
    kept: float
    excess_least: float
    excess_mean: float
    arrived: float
    goal_error_largest: float
    length_mean: float


def validate(
    chain: ChainWeights,
    *,
    scenes: int = 4000,
    beside: float = 0.0,
    alpha_x: float = ALPHA_X,
    end: float = 1.25,
    fade: float = 0.3,
    seed: int = 1,
) -> Validation:
    """Rolls out random queries in the chain's range.

    Args:
        chain: the chain, of four inputs.
        scenes: number of scenes.
        beside: the centre lies up to this far beside the baseline, in L; the chain does
            not know. Start and goal keep at least the asked clearance.
        alpha_x: spring constant that the chain is for.
        end: s at the end of the motion.
        fade: of the coupling near the goal, see `planar_rollouts`.
        seed: of the scenes.

    Returns:
        What came of it.
    """
    rng = np.random.default_rng(seed)
    inputs: list[FloatArray] = []
    centers, parameters = [], []
    while len(inputs) < scenes:
        query = rng.uniform(chain.lower, chain.upper)
        proposal = chain.parameters(query[None, :2], query[2], 1.0, query[3])
        if proposal.in_range[0] and min(query[3], 1.0 - query[3]) - query[0] >= query[2]:
            inputs.append(query)
            centers.append((query[3], beside * rng.uniform(-1.0, 1.0)))
            parameters.append(proposal.as_array()[0])
    queries = np.array(inputs)
    outcome = planar_rollouts(
        queries[:, :2],
        np.array(centers),
        np.array(parameters)[:, None],
        dmp=straight_dmp(alpha_x),
        end=end,
        fade=fade,
    )
    excess, free = outcome.clearance[:, 0] - queries[:, 2], ~outcome.contact
    return Validation(
        scenes,
        int(outcome.contact.sum()),
        float(np.mean(excess >= 0.0)),
        float(excess.min()),
        float(excess.mean()),
        float(np.mean(outcome.goal_error < 1e-3)),
        float(outcome.goal_error[free].max()),
        float(outcome.path_length[free].mean()),
    )


def validation_table(outcomes: dict[str, Validation]) -> str:
    """Markdown table of what the proposals did when rolled out; lengths in mm a metre."""
    lines = [
        "| centre | scenes | contacts | kept | excess worst | excess mean "
        "| goal within 1 mm | goal worst | path ratio |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {name} | {v.scenes:,} | {v.contacts} | {v.kept:.2%} | {1e3 * v.excess_least:.1f} "
        f"| {1e3 * v.excess_mean:.1f} | {v.arrived:.1%} | {1e3 * v.goal_error_largest:.1f} "
        f"| {v.length_mean:.3f} |"
        for name, v in outcomes.items()
    ]
    return "\n".join(lines)
