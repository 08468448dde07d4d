"""The `policy` block of a scenario: constants of the action and decision levels."""

import dataclasses as dc

from drake_oa.common.config import choice, count, number
from drake_oa.policy.dmp import ALPHA_K, ALPHA_X, BETA_X


@dc.dataclass
class Policy:
    """Constants of the action and decision levels."""

    # Step of the movement primitive [s].
    period: float = number(0.008, "s", 1e-4, 0.1)
    # Transformation system: spring constants, per normalised time t / (tau T).
    alpha_x: float = number(ALPHA_X, "1", 0.0, 1e4, open_low=True)
    beta_x: float = number(BETA_X, "1", 0.0, 1e4, open_low=True)
    # Canonical system: decay of the phase over the motion.
    alpha_k: float = number(ALPHA_K, "1", 0.0, 100.0, open_low=True)
    # Basis functions of the forcing term.
    n_basis: int = count(35, 2, 1000)
    # How heading guidance fades near an obstacle (see docs/equations.md).
    guidance: str = choice("counterphase", "printed")
    # Largest alpha of the guidance term.
    guidance_gain: float = number(1e6, "1", 0.0, 1e6)
    # The coupling fades within this share of the baseline before the goal; 0: it does not, as
    # printed.
    fade: float = number(0.3, "1", 0.0, 1.0)
    # Height of the tool point above the table below which a route is forbidden [m].
    table_height: float = number(0.05, "m", 0.0, 10.0)
    # The motion is held when the last good observation is older than this [s].
    max_observation_age: float = number(0.5, "s", 0.0, 1e6, open_low=True)
    # Time in which the motion ramps from full speed to a hold [s].
    hold_time: float = number(0.25, "s", 0.0, 10.0, open_low=True)
