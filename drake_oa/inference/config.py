"""Configuration of the inference layer, which computes coupling parameters: field `inference`."""

from typing import Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from drake_oa.common.config import BLOCK


@dataclass(config=BLOCK)
class Paper:
    """Configuration of the method of Pairet et al., RA-L 2019, with a regressor chain.

    The regressor chain consists of three networks that compute the parameters of coupling terms.
    The fields select between interpretations of the paper. So does the field `fade` of the block
    `policy`, the distance from the goal within which the coupling terms fade to zero.
    """

    weights: str = "package://drake_oa/weights/paper_chain_running.safetensors"
    """Weights file of the regressor chain, which computes coupling parameters from the section of
    an obstacle: a package:// URL, or a file relative to the scenario. The default file is trained
    by the procedure of Pairet et al., RA-L 2019, with this package's integrator."""
    shape: Literal["superquadric", "enclosing"] = "superquadric"
    """Ellipsoid that describes an obstacle dilated by the tool: `superquadric` is the least-squares
    fit (11) of Pairet et al., RA-L 2019, and `enclosing` the ellipsoid of minimum volume that
    contains all points."""
    guided: bool = True
    """Whether cost rings (costs of the directions of passing) select the side on which each
    obstacle is passed. Heading guidance then turns the motion toward this side, and the duration is
    scaled with the length of the avoiding path, as in (9) and section IV-E of Pairet et al., RA-L
    2019. If false, the avoidance term alone determines the side."""


@dataclass(config=BLOCK)
class Verified:
    """Configuration of the search for a motion, verified by roll-outs (simulations) of the arm."""

    chain: str | None = "package://drake_oa/weights/paper_chain_running.safetensors"
    """Weights file of the regressor chain of Pairet et al., RA-L 2019: a package:// URL, or a file
    relative to the scenario; null: none. The chain's coupling terms for all obstacles together are
    one candidate motion, and the coupling term for each obstacle alone is a seed of the search."""
    candidates: int = Field(default=32, ge=8, le=4096)
    """Number of candidate motions that each iteration of the search simulates [-]. Raising it
    searches more widely."""
    generations: int = Field(default=8, ge=0, le=1000)
    """Maximum number of iterations of the search, before and after the first feasible motion [-].
    Raising it searches longer before the search fails."""
    refinement_generations: int = Field(default=4, ge=0, le=1000)
    """Maximum number of iterations of the search after the first feasible motion, within
    `generations` [-]. Raising it gives shorter motions."""
    slack: float = Field(default=5e-4, ge=0.0, le=0.1)
    """Maximum clearance shortfall of a feasible motion [m]. If start or goal has less than the
    requested clearance from an obstacle, the required clearance is the distance there minus this
    value. Raising it accepts motions closer to the obstacles."""
    tolerance: float = Field(default=6e-4, ge=0.0, le=0.1)
    """Maximum distance from the goal at the end of a feasible motion [m]. Raising it accepts
    motions that end farther away."""
    link_clearance: float = Field(default=0.03, ge=0.0, le=1.0)
    """Requested clearance of the links from all collision geometry, and of the tool from the
    environment [m]. It is limited to the requested clearance of the tool from obstacles. Raising it
    makes the arm pass at a larger distance."""
    ring_weight: float = Field(default=0.5, ge=0.0, le=100.0)
    """Additional cost of a side of the obstacles to which a user-supplied cost ring gives a value
    just below 1, as path length over the distance from start to goal [-]. The value 1 forbids a
    side. Raising it accepts longer detours to avoid such sides."""
    compute_budget: float = Field(default=0.028, ge=0.0, le=100.0)
    """Maximum compute latency of a search during the motion [s]; a search at the start of a motion
    has no such limit. The latency is estimated from the counted work by the model of
    `drake_oa.common.latency`, and the next search continues from the best candidates. Raising it
    gives later and better decisions; keep it below the frame period of the camera."""
    configurations: int = Field(default=20_000, ge=0, le=10_000_000)
    """Maximum number of configurations of the arm that one run of the joint-space planner checks
    [-]. If the search finds no feasible motion, the planner runs at decreasing fractions of the
    requested clearance. Raising the number finds more paths and requires more time."""
    last_configurations: int = Field(default=200_000, ge=0, le=10_000_000)
    """Maximum number of configurations of the arm that a last run of the joint-space planner checks
    [-]. It follows if all runs limited by `configurations` have found no path that the arm can
    execute, and requires 0.2 times the requested clearance. Raising the number finds more paths and
    requires more time."""
