"""Configuration of the policy layer, which generates the motion: a scenario's field `policy`."""

from pydantic import Field
from pydantic.dataclasses import dataclass

from drake_oa.common.config import BLOCK
from drake_oa.policy.dmp import ALPHA_K, ALPHA_X, BETA_X


@dataclass(config=BLOCK)
class Policy:
    """Constants of the dynamic movement primitive (DMP) that generates the motion of the tool.

    Some constants belong to its coupling terms, which turn the motion away from obstacles, and to
    its holds, which stop the motion on its path.
    """

    period: float = Field(default=0.008, ge=1e-4, le=0.1)
    """Time step with which the movement primitive is integrated [s]. Raising it saves processor
    time and makes the motion less accurate."""
    alpha_x: float = Field(default=ALPHA_X, gt=0.0, le=1e4)
    """Gain alpha_x of the movement primitive's spring and damper, per normalized time (time over
    the planned duration) [-]. Raising it makes the motion return to the demonstration more quickly
    after avoidance."""
    beta_x: float = Field(default=BETA_X, gt=0.0, le=1e4)
    """Gain beta_x of the movement primitive's spring, per normalized time (time over the planned
    duration) [-]. Raising it makes the spring to the goal stiffer; alpha_x = 4 beta_x is critically
    damped."""
    alpha_k: float = Field(default=ALPHA_K, gt=0.0, le=100.0)
    """Decay rate alpha_k of the movement primitive's phase k = exp(-alpha_k s) over normalized time
    s (time over the planned duration) [-]. Raising it makes the phase decay faster."""
    n_basis: int = Field(default=35, ge=2, le=1000)
    """Number of basis functions of the forcing term, which reproduces a demonstration [-]. Raising
    it reproduces finer details of the demonstration."""
    fade: float = Field(default=0.3, ge=0.0, le=1.0)
    """Distance from the goal within which the coupling terms, which avoid obstacles, fade to zero,
    as a fraction of the distance from start to goal [-]; 0: no fading, as in Pairet et al., RA-L
    2019. Raising it ends avoidance farther from the goal."""
    table_height: float = Field(default=0.05, ge=0.0, le=10.0)
    """Minimum height of the tool point above the table where the motion passes an obstacle [m].
    Raising it forbids more directions of passing an obstacle close to the table."""
    max_observation_age: float = Field(default=0.5, gt=0.0, le=1e6)
    """Age of the last observation of the obstacles above which the motion is held, that is,
    stopped on its path [s]. Raising it tolerates longer gaps in perception."""
    hold_time: float = Field(default=0.25, gt=0.0, le=10.0)
    """Time in which a held motion slows down from full speed to rest [s]. Raising it makes stops
    gentler and longer."""
