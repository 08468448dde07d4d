"""The typed scenario: everything a run needs, composed of the layers' blocks.

`drake_oa.scenario.loading` reads it from a YAML file.
"""

# No postponed annotations here: yaml_load_typed reads the fields' types.
import dataclasses as dc
import math

from pydrake.multibody.parsing import ModelDirective
from pydrake.systems.sensors import CameraConfig

from drake_oa.common.config import choice as _choice
from drake_oa.common.config import count as _count
from drake_oa.common.config import number as _number
from drake_oa.common.config import vector as _vector
from drake_oa.common.thinking import Thinking
from drake_oa.perception.config import CameraNoise as CameraNoise
from drake_oa.perception.config import DepthCamera, GroundTruth, RecordedClouds
from drake_oa.policy.dmp import ALPHA_K, ALPHA_X, BETA_X
from drake_oa.regulation.config import Regressor, Verified
from drake_oa.robot.config import Robot
from drake_oa.safety.config import EvasionParameters, SupervisorParameters
from drake_oa.scenario.faults import Fault
from drake_oa.scenario.obstacles import Obstacle
from drake_oa.scenario.perception import EllipsoidConfig as EllipsoidConfig
from drake_oa.scenario.perception import GivenEllipsoids
from drake_oa.scenario.task import Task


@dc.dataclass
class Turn:
    """Turns of the tool about an axis of the world through the tool point."""

    # The axis in the world, of any length but 0.
    axis: list[float] = _vector([0.0, 0.0, 1.0], "1")
    # Largest turn either way, and the step between those that are tried [rad].
    largest: float = _number(math.pi / 2.0, "rad", 0.0, math.pi, open_low=True)
    step: float = _number(math.pi / 12.0, "rad", 0.05, math.pi)
    # How fast the tool turns at most [rad/s].
    speed: float = _number(1.0, "rad/s", 0.0, 10.0, open_low=True)


@dc.dataclass
class Policy:
    """Constants of the action and decision levels."""

    # Step of the movement primitive [s].
    period: float = _number(0.008, "s", 1e-4, 0.1)
    # Transformation system: spring constants, per normalised time t / (tau T).
    alpha_x: float = _number(ALPHA_X, "1", 0.0, 1e4, open_low=True)
    beta_x: float = _number(BETA_X, "1", 0.0, 1e4, open_low=True)
    # Canonical system: decay of the phase over the motion.
    alpha_k: float = _number(ALPHA_K, "1", 0.0, 100.0, open_low=True)
    # Basis functions of the forcing term.
    n_basis: int = _count(35, 2, 1000)
    # Weights of the regressor chain: package:// URL, or file relative to this one.
    weights: str = "package://drake_oa/weights/regressor_chain.safetensors"
    # How heading guidance fades near an obstacle (see docs/equations.md).
    guidance: str = _choice("counterphase", "printed")
    # Largest alpha of the guidance term.
    guidance_gain: float = _number(100.0, "1", 0.0, 1e6)
    # What the regressor chain looks at with `regulation: !Regressor`: the obstacle as the
    # chosen route meets it, or the section of the P-plane, as in the paper.
    descriptor: str = _choice("route", "section")
    # The coupling fades within this share of the baseline before the goal.
    fade: float = _number(0.3, "1", 0.0, 1.0)
    # Directions on a cost ring, and how often the route is reconsidered [s].
    ring_directions: int = _count(36, 4, 720)
    route_period: float = _number(1.0 / 15.0, "s", 1e-3, 10.0)
    # Height of the tool point above the table below which a route is forbidden [m].
    table_height: float = _number(0.05, "m", 0.0, 10.0)
    # The motion is held when the last good observation is older than this [s].
    max_observation_age: float = _number(0.5, "s", 0.0, 1e6, open_low=True)
    # Time in which the motion ramps from full speed to a hold [s].
    hold_time: float = _number(0.25, "s", 0.0, 10.0, open_low=True)
    # How the tool may be turned to pass where it would not fit otherwise; null: it is not.
    turn: Turn | None = None


@dc.dataclass
class Scenario:
    """Everything a run needs. Each field has a default; a file states the rest."""

    # One line for `drake-oa scenarios`.
    description: str = ""
    # Of the camera's noise: the same scenario with the same seed always runs the same.
    seed: int = _count(0, 0, 2**31 - 1)
    # Step of the simulated plant and controller [s].
    plant_step: float = _number(0.002, "s", 1e-5, 0.01)
    task: Task = dc.field(default_factory=Task)
    policy: Policy = dc.field(default_factory=Policy)
    # The robot, or null: the action level drives a free point.
    robot: Robot | None = dc.field(default_factory=Robot)
    # What stands in the world besides the robot (Drake model directives).
    # Obstacles are the model instances whose name starts with "obstacle".
    directives: list[ModelDirective] = dc.field(default_factory=list)
    # Obstacles of primitive shapes, written here.
    obstacles: list[Obstacle] = dc.field(default_factory=list)
    # Drake's camera configurations, each with a name of its own.
    cameras: list[CameraConfig] = dc.field(default_factory=list)
    # Where obstacles come from.
    perception: DepthCamera | GroundTruth | RecordedClouds | GivenEllipsoids = dc.field(
        default_factory=GroundTruth
    )
    # What the coupling parameters come from.
    regulation: Verified | Regressor = dc.field(default_factory=Verified)
    # What watches the motion of the robot, or null: nothing does.
    supervisor: SupervisorParameters | None = dc.field(default_factory=SupervisorParameters)
    # What gets the arm out of the way of what moves, or null: nothing does; nor does anything
    # without a supervisor.
    evasion: EvasionParameters | None = dc.field(default_factory=EvasionParameters)
    # What decisions cost in simulated time, or null: they are in force at once.
    thinking: Thinking | None = dc.field(default_factory=Thinking)
    # Height of the table in the world; null: there is none [m].
    table_height: float | None = dc.field(default=0.0, metadata={"unit": "m"})
    # What goes wrong, and when.
    faults: list[Fault] = dc.field(default_factory=list)


def allow_perception(block: type) -> None:
    """Makes a dataclass a valid block of `perception`, under its class's name as a tag.

    Raises:
        TypeError: if it is no dataclass, has no `period`, or its module postpones annotations.
    """
    if not dc.is_dataclass(block) or "period" not in {item.name for item in dc.fields(block)}:
        raise TypeError(
            f"{block.__name__}: a perception block is a dataclass with a field 'period'"
        )
    if any(isinstance(item.type, str) for item in dc.fields(block)):
        raise TypeError(
            f"{block.__name__}: its module postpones annotations, of which Drake's YAML reader "
            "knows nothing: leave out `from __future__ import annotations` there"
        )
    item = next(item for item in dc.fields(Scenario) if item.name == "perception")
    item.type = item.type | block
    Scenario.__annotations__["perception"] = item.type
