"""The configuration of regulation: what the block `regulation` of a scenario holds.

Every field has its unit and range, which `drake_oa.common.config` holds a file's blocks against,
and with `check_values` what Python code makes.
"""

# No postponed annotations here: yaml_load_typed reads the fields' types.
import dataclasses as dc

from drake_oa.common.config import count, number


@dc.dataclass
class Following:
    """How a motion is looked for that the whole arm can follow."""

    # So many other motions are tried in the place of one that the arm cannot follow, and the
    # best so many of them once more, thoroughly.
    tried: int = count(16, 0, 1000)
    looked_into: int = count(4, 0, 1000)
    # So many legs are looked at in one search for points aside; where they lead to the goal so
    # many motions from the last point are tried, and a leg takes this share of the motion's
    # duration, as it is short.
    legs: int = count(100, 0, 10_000)
    tried_there: int = count(8, 0, 1000)
    leg_pace: float = number(0.5, "1", 0.0, 1.0, open_low=True)
    # All of that where what is seen is no older than this [s].
    recent: float = number(0.2, "s", 0.0, 100.0)
    # A motion that is slowed to rest for so long is stuck, though the arm could follow it [s],
    # where a link is so near to something: a supervisor lets none come nearer than 3 cm [m].
    stuck: float = number(0.5, "s", 0.0, 100.0)
    beside: float = number(0.04, "m", 0.0, 1.0)
    # So far from where it was stuck last all is tried again [m], or where a joint is so far
    # from its position then [rad].
    elsewhere: float = number(0.03, "m", 0.0, 1.0)
    otherwise: float = number(0.1, "rad", 0.0, 3.0)
    # So near to a point aside it has been reached [m]; a leg keeps the tool so far from the
    # obstacles [m].
    there: float = number(0.02, "m", 0.0, 1.0)
    clear: float = number(0.03, "m", 0.0, 1.0)
    # So near to its old motion the arm keeps the posture of that, where it finds no other [m].
    near_old: float = number(0.05, "m", 0.0, 1.0)


@dc.dataclass
class Verified:
    """Coupling parameters that roll-outs of the motion have checked."""

    # Motions that are rolled out a round.
    candidates: int = count(64, 32, 4096)
    # Rounds of the search at most, and after the first motion that keeps the clearance.
    rounds: int = count(60, 0, 1000)
    polish: int = count(6, 0, 1000)
    # How often scenes whose clearance is not kept are searched again, with twice as many
    # candidates and steps: once as before, then on every side by itself (seconds a decision).
    retries: int = count(0, 0, 10)
    # A motion keeps the clearance when it is short of it by no more than this, and has arrived
    # when it is this near to the goal [m].
    slack: float = number(2e-4, "m", 0.0, 0.1)
    tolerance: float = number(6e-4, "m", 0.0, 0.1)
    # Normalised time by which it has to arrive, from s = 0, or one more than the present one.
    horizon: float = number(2.0, "1", 1.0, 100.0)
    # Rounds of a search that is begun anew with each frame: obstacles move.
    rounds_a_frame: int = count(5, 0, 1000)
    # How far a motion may leave the world's limits, which hold centimetres in reserve [m], and
    # how far from the goal its end is no arrival at all, in baselines.
    outside: float = number(0.01, "m", 0.0, 1.0)
    astray: float = number(0.1, "1", 0.0, 10.0)
    # A motion begins anew where it is farther than this from its start and its goal [m]; how
    # often it is looked whether it may [s].
    left: float = number(0.01, "m", 0.0, 1.0)
    retry_period: float = number(0.5, "s", 0.0, 100.0)
    # How often a motion that the arm can follow is looked for: it takes 0.3 s and more [s].
    seek_period: float = number(1.0, "s", 0.0, 100.0)
    # What such a motion keeps of every obstacle at least; how much more than at its choice it
    # may lack of the feasible clearance; and how far from the goal it may end within the
    # horizon, as its last part is verified again [m].
    least_clearance: float = number(0.05, "m", 0.0, 2.0)
    may_lose: float = number(0.01, "m", 0.0, 1.0)
    short_of_goal: float = number(0.02, "m", 0.0, 1.0)
    following: Following = dc.field(default_factory=Following)


@dc.dataclass
class SearchParameters(Verified):
    """The block, and what follows from the policy."""

    # Steps of a roll-out a unit of normalised time.
    steps: int = count(500, 50, 100_000)
    # The coupling fades within this share of the baseline before the goal.
    fade: float = number(0.3, "1", 0.0, 1e6)


@dc.dataclass
class Regressor:
    """Coupling parameters as the regressor chain gives them, sides by cost rings: the paper."""

    # Whether the policy is given the route. Without it the motion only reacts: the term turns
    # it about the section of the P-plane, to whatever side it happens to head for.
    guided: bool = True


@dc.dataclass
class WholeArm:
    """Motions that roll-outs of the whole arm among the true shapes have checked."""

    # Motions that are rolled out a round; rounds at most, and after the first that will do.
    candidates: int = count(64, 32, 4096)
    rounds: int = count(8, 0, 1000)
    polish: int = count(4, 0, 1000)
    # A motion keeps what is asked when it is short of it by no more than this, and what start
    # and goal leave is asked but for as much [m]; it has arrived when it is this near [m].
    slack: float = number(5e-4, "m", 0.0, 0.1)
    tolerance: float = number(6e-4, "m", 0.0, 0.1)
    # Normalised time by which it has to arrive, from s = 0, or one more than the present one.
    horizon: float = number(2.0, "1", 1.0, 100.0)
    # How far from the goal its end is no arrival at all, in baselines, and by how much the arm
    # may miss the tool's pose on the way [m, rad].
    astray: float = number(0.1, "1", 0.0, 10.0)
    missed: float = number(2e-3, "m", 0.0, 0.1)
    # How far the spheres that stand for links and tool may stick out of them: less takes more of
    # them, and time [m].
    overshoot: float = number(0.008, "m", 0.0, 0.1, open_low=True)
    tool_overshoot: float = number(0.004, "m", 0.0, 0.1, open_low=True)
    # What links keep of everything, and the tool of the cell itself; what the arm keeps of itself;
    # and the least that is gone on with where what is asked cannot be kept [m].
    link_clearance: float = number(0.03, "m", 0.0, 1.0)
    self_clearance: float = number(0.005, "m", 0.0, 0.1)
    least_kept: float = number(1e-3, "m", 0.0, 1.0)
    # How often a path in the joints is looked for while none of the motions will do [s]; among how
    # many configurations, for all that is asked, then for these shares of it, and at last for
    # the smallest share among so many; and to how many random postures at the goal.
    seek_period: float = number(0.5, "s", 0.0, 100.0)
    configurations: int = count(20_000, 0, 10_000_000)
    shares: list[float] = dc.field(default_factory=lambda: [0.5, 0.2])
    last_configurations: int = count(200_000, 0, 10_000_000)
    goal_seeds: int = count(128, 0, 1000)
    # With what share of the joints' greatest speeds it is gone at most, and in how many of the
    # demonstrated durations, where the joints can.
    speed_share: float = number(0.5, "1", 0.0, 1.0, open_low=True)
    longest: float = number(2.0, "1", 0.0, 100.0, open_low=True)

    def search(self, steps: int, fade: float) -> SearchParameters:
        """As the search of the tool's motions takes it."""
        shared = ("candidates", "rounds", "polish", "slack", "tolerance", "horizon", "astray")
        given = {name: getattr(self, name) for name in shared}
        return SearchParameters(**given, steps=steps, fade=fade)
