"""Configuration of the motion: a scenario's field `policy`."""

from pydantic import Field
from pydantic.dataclasses import dataclass

from drake_oa.common.config import BLOCK
from drake_oa.policy.dmp import ALPHA_K, ALPHA_X, BETA_X


@dataclass(config=BLOCK)
class Policy:
    """Constants of the dynamic movement primitive and its coupling terms."""

    period: float = Field(default=0.008, ge=1e-4, le=0.1)
    """Time step of the integration [s]. Raising it saves processor time and makes the motion less
    accurate."""
    alpha_x: float = Field(default=ALPHA_X, gt=0.0, le=1e4)
    """Gain alpha_x of the transformation system, in normalized time t / (tau T) [1]. Raising it
    makes the motion return to the demonstration more quickly."""
    beta_x: float = Field(default=BETA_X, gt=0.0, le=1e4)
    """Gain beta_x of the transformation system, in normalized time [1]. Raising it makes the
    spring to the goal stiffer; alpha_x = 4 beta_x is critically damped."""
    alpha_k: float = Field(default=ALPHA_K, gt=0.0, le=100.0)
    """Decay rate alpha_k of the canonical system over the motion [1]. Raising it makes the phase
    decay earlier."""
    n_basis: int = Field(default=35, ge=2, le=1000)
    """Number of basis functions of the forcing term [1]. Raising it reproduces finer details of a
    demonstration."""
    fade: float = Field(default=0.3, ge=0.0, le=1.0)
    """Fraction of the start-to-goal distance before the goal within which the coupling terms fade
    to zero [1]; 0: no fading, as in the paper. Raising it ends avoidance farther from the
    goal."""
    table_height: float = Field(default=0.05, ge=0.0, le=10.0)
    """Minimum height of the tool point above the table on a selected side [m]. Raising it forbids
    more of the sides that pass close to the table."""
    max_observation_age: float = Field(default=0.5, gt=0.0, le=1e6)
    """Age of the last valid observation above which the motion is held [s]. Raising it tolerates
    longer gaps in perception."""
    hold_time: float = Field(default=0.25, gt=0.0, le=10.0)
    """Time to slow down from full speed to rest [s]. Raising it stops more gently and later."""
