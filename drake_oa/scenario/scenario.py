"""The typed scenario: everything a run needs, composed of the layers' blocks.

`drake_oa.scenario.loading` reads it from a YAML file.
"""

# No postponed annotations here: yaml_load_typed reads the fields' types.
import dataclasses as dc

from pydrake.multibody.parsing import ModelDirective
from pydrake.systems.sensors import CameraConfig

from drake_oa.common.config import ScenarioError
from drake_oa.common.config import count as _count
from drake_oa.common.config import number as _number
from drake_oa.common.thinking import Thinking
from drake_oa.perception.config import CameraNoise as CameraNoise
from drake_oa.perception.config import (
    DepthCamera,
    GroundTruth,
    LcmCamera,
    RealSense,
    RecordedClouds,
)
from drake_oa.policy.config import Policy
from drake_oa.regulation.config import Paper, Verified
from drake_oa.robot.config import Robot
from drake_oa.safety.config import EvasionParameters, SupervisorParameters
from drake_oa.scenario.faults import Fault
from drake_oa.scenario.obstacles import Obstacle
from drake_oa.scenario.perception import EllipsoidConfig as EllipsoidConfig
from drake_oa.scenario.perception import GivenEllipsoids
from drake_oa.scenario.task import Task

LAYERS = ("perception", "descriptor", "decision", "motion")
"""What a viewer draws, as folders of its scene tree: clouds and cameras; ellipsoids and their
sections; cost rings and chosen sides; planned and executed path."""


@dc.dataclass
class View:
    """What a viewer shows at first; whoever looks may change it there."""

    # Some of perception, descriptor, decision and motion; null: what decides, which is decision
    # and motion, and for !Paper the descriptor.
    show: list[str] | None = None


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
    perception: (
        DepthCamera | GroundTruth | RecordedClouds | GivenEllipsoids | LcmCamera | RealSense
    ) = dc.field(default_factory=GroundTruth)
    # What the coupling parameters come from.
    regulation: Verified | Paper = dc.field(default_factory=Verified)
    # What watches the motion of the robot, or null: nothing does.
    supervisor: SupervisorParameters | None = dc.field(default_factory=SupervisorParameters)
    # What gets the arm out of the way of what moves, or null: nothing does; nor does anything
    # without a supervisor.
    evasion: EvasionParameters | None = dc.field(default_factory=EvasionParameters)
    # What decisions cost in simulated time, or null: they are in force at once.
    thinking: Thinking | None = dc.field(default_factory=Thinking)
    # Height of the table in the world; null: there is none [m].
    table_height: float | None = dc.field(default=0.0, metadata={"unit": "m"})
    # What a viewer shows.
    view: View = dc.field(default_factory=View)
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


def robot_of(scenario: Scenario) -> Robot:
    """Returns the robot of a scenario that must have one.

    Raises:
        ScenarioError: if it has none.
    """
    if scenario.robot is None:
        raise ScenarioError("robot: must be set for this; the scenario has null")
    return scenario.robot
