"""Configuration of the source of coupling parameters: a scenario's field `inference`."""

from typing import Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from drake_oa.common.config import BLOCK


@dataclass(config=BLOCK)
class Paper:
    """Coupling parameters by the paper's regressor chain; fields select interpretations of it.

    `policy.fade` is an interpretation, too.
    """

    weights: str = "package://drake_oa/weights/paper_chain_running.safetensors"
    """Weights of the regressor chain RC(lambda', Delta): a package:// URL, or a file relative to
    the scenario. The default is trained by the paper's procedure with this package's integrator."""
    shape: Literal["superquadric", "enclosing"] = "superquadric"
    """Descriptor of an obstacle dilated by the tool: the least-squares `superquadric` (eq. 11), or
    the `enclosing` ellipsoid."""
    guided: bool = True
    """Whether cost rings select the sides and heading guidance (eq. 9) turns the motion toward
    them, and the duration is scaled with the length of the avoiding path (section IV-E). If false,
    the avoidance term alone determines the side."""


@dataclass(config=BLOCK)
class Verified:
    """Motions verified by whole-arm roll-outs among the obstacles' shapes."""

    chain: str | None = "package://drake_oa/weights/paper_chain_running.safetensors"
    """Weights of the paper's regressor chain, whose rows together are one candidate motion,
    and each alone a first candidate of the search: a package:// URL, or a file relative to the
    scenario; null: no such motions."""
    candidates: int = Field(default=32, ge=8, le=4096)
    """Number of motions rolled out in each iteration of the search [1]. Raising it searches more
    widely."""
    generations: int = Field(default=8, ge=0, le=1000)
    """Maximum number of iterations of the search [1]. Raising it searches longer for a feasible
    motion."""
    refinement_generations: int = Field(default=4, ge=0, le=1000)
    """Number of iterations of the search after the first feasible motion [1]. Raising it gives
    shorter motions."""
    slack: float = Field(default=5e-4, ge=0.0, le=0.1)
    """Maximum clearance shortfall of a feasible motion, and reduction of the clearance achievable
    at start and goal [m]. Raising it accepts motions closer to the obstacles."""
    tolerance: float = Field(default=6e-4, ge=0.0, le=0.1)
    """Maximum distance from the goal at the end of a feasible motion [m]. Raising it accepts
    motions that end farther away."""
    link_clearance: float = Field(default=0.03, ge=0.0, le=1.0)
    """Requested clearance of the links from all collision geometry, and of the tool from the
    environment [m]. Raising it makes the arm pass at a larger distance."""
    ring_weight: float = Field(default=0.5, ge=0.0, le=100.0)
    """Cost of a side that a user-supplied cost ring rates with 1, as additional path length over
    the start-to-goal distance [1]. Raising it accepts longer detours to avoid such sides."""
    compute_budget: float = Field(default=0.028, ge=0.0, le=100.0)
    """Maximum compute latency of one search while the robot or an obstacle moves, by the model of
    `drake_oa.common.latency` [s]; a longer search continues with the next observation. Raising it
    decides later and better; keep it below the frame period of the camera."""
    configurations: int = Field(default=20_000, ge=0, le=10_000_000)
    """Maximum number of configurations that the joint-space planner checks if no motion of the
    tool is feasible [1]. Raising it finds more paths and takes longer."""
    last_configurations: int = Field(default=200_000, ge=0, le=10_000_000)
    """Maximum number of configurations that the joint-space planner checks at the reduced
    clearance of last resort [1]. Raising it finds more paths and takes longer."""
