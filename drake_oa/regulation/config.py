"""The configuration of regulation: what the block `regulation` of a scenario holds.

Every field has its unit and range, which `drake_oa.common.config` holds a file's blocks against,
and with `check_values` what Python code makes.
"""

# No postponed annotations here: yaml_load_typed reads the fields' types.
import dataclasses as dc

from drake_oa.common.config import choice, count, number


@dc.dataclass
class SearchParameters:
    """How far a search among motions of the tool goes."""

    # Motions that are rolled out a round.
    candidates: int = count(64, 8, 4096)
    # Rounds of the search at most, and after the first motion that keeps the clearance.
    rounds: int = count(60, 0, 1000)
    polish: int = count(6, 0, 1000)
    # A motion keeps the clearance when it is short of it by no more than this, and has arrived
    # when it is this near to the goal [m].
    slack: float = number(2e-4, "m", 0.0, 0.1)
    tolerance: float = number(6e-4, "m", 0.0, 0.1)
    # Steps of a roll-out a unit of normalised time.
    steps: int = count(500, 50, 100_000)
    # The coupling fades within this share of the baseline before the goal.
    fade: float = number(0.3, "1", 0.0, 1e6)


@dc.dataclass
class Paper:
    """The paper's chain and nothing else; each reading of its print is a field.

    `policy.fade`, `policy.guidance` and `policy.guidance_gain` are readings too.
    """

    # RC(lambda', Delta): package:// URL, or file relative to this one. The default is trained by
    # the paper's recipe on the action level that runs here.
    weights: str = "package://drake_oa/weights/paper_chain_running.safetensors"
    # What encodes an obstacle that the tool dilates: the superquadric of least squares
    # (eq. 11), or the ellipsoid that encloses it.
    shape: str = choice("superquadric", "enclosing")
    # How strongly the superquadric's exponents are drawn to 1: what one unit of their logarithm
    # costs, in mean squares of a residual that is the volume's root. null: they are 1, as
    # section IV-B has it; 0: as fitted.
    exponent_prior: float | None = dc.field(default=None, metadata={"unit": "1", "low": 0.0})
    # The avoidance term: (eq. 8), or (eq. 7) at its published gains.
    term: str = choice("dead_zone_free", "original")
    # Whether cost rings choose the sides, and headings lead there (eq. 9). Without them the
    # motion only reacts: the term turns it to whatever side it happens to head for.
    guided: bool = True
    # Whether the duration is scaled by the length of the avoiding path (section IV-E).
    scaled: bool = True


@dc.dataclass
class Verified:
    """Motions that roll-outs of the whole arm among the true shapes have checked."""

    # Proposal network that seeds the search: package:// URL, or file relative to this one.
    weights: str = "package://drake_oa/weights/proposals.safetensors"
    # Motions that are rolled out a round; rounds at most, and after the first that will do.
    candidates: int = count(32, 8, 4096)
    rounds: int = count(8, 0, 1000)
    polish: int = count(4, 0, 1000)
    # A motion keeps what is asked when it is short of it by no more than this, and what start
    # and goal leave is asked but for as much [m]; it has arrived when it is this near [m].
    slack: float = number(5e-4, "m", 0.0, 0.1)
    tolerance: float = number(6e-4, "m", 0.0, 0.1)
    # What links keep of everything, and the tool of the cell itself [m].
    link_clearance: float = number(0.03, "m", 0.0, 1.0)
    # What a side costs at which a ring of one's own is 1, which forbids it, or at less its share of
    # it: so much longer another way may be, in baselines.
    ring_price: float = number(0.5, "1", 0.0, 100.0)
    # What a search may cost, by `drake_oa.common.thinking`, once the motion has begun or while
    # something moves [s]: less than a camera's period. One that costs more goes on with the next
    # observation.
    frame: float = number(0.028, "s", 0.0, 100.0)
    # Among how many configurations a path in the joints is looked for where none of the motions
    # will do, and among how many for the least clearance.
    configurations: int = count(20_000, 0, 10_000_000)
    last_configurations: int = count(200_000, 0, 10_000_000)

    def search(self, steps: int, fade: float) -> SearchParameters:
        """As the search of the tool's motions takes it."""
        shared = ("candidates", "rounds", "polish", "slack", "tolerance")
        given = {name: getattr(self, name) for name in shared}
        return SearchParameters(**given, steps=steps, fade=fade)
