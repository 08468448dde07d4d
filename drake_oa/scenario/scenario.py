"""Scenario: configuration block of all parameters of a run, which contains the blocks of all
layers.

`drake_oa.scenario.loading` reads a scenario from a YAML file.
"""

import dataclasses as dc
import typing
from typing import Annotated, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass, rebuild_dataclass
from pydrake.multibody.parsing import ModelDirective
from pydrake.systems.sensors import CameraConfig

from drake_oa.common.config import BLOCK, DrakeStruct, ScenarioError, Tagged
from drake_oa.common.latency import LatencyModel
from drake_oa.inference.config import Paper, Verified
from drake_oa.perception.config import CameraNoise as CameraNoise
from drake_oa.perception.config import (
    DepthCamera,
    GroundTruth,
    LcmCamera,
    RecordedBag,
    RecordedClouds,
)
from drake_oa.policy.config import Policy
from drake_oa.robot.config import Robot
from drake_oa.safety.config import GuardParameters
from drake_oa.scenario.faults import Fault
from drake_oa.scenario.obstacles import Obstacle
from drake_oa.scenario.perception import EllipsoidConfig as EllipsoidConfig
from drake_oa.scenario.perception import GivenEllipsoids
from drake_oa.scenario.task import Task

Layer = Literal["perception", "descriptor", "decision", "motion"]
"""Type of the name of a group of systems whose intermediate results a viewer can display."""
LAYERS = typing.get_args(Layer)
"""Names of the groups of systems (layers) whose intermediate results a viewer can display, in the
order of data flow.

The viewer draws point clouds for "perception", and the ellipsoids around obstacles for
"descriptor". For "decision" it draws cost rings (costs of passing an obstacle on each side) and
selected sides. For "motion" it draws the planned and the executed path."""


@dataclass(config=BLOCK)
class View:
    """Configuration block of the viewer's settings at the start of a run; the user can change them
    in the browser.
    """

    show: list[Layer] | None = None
    """Names of the layers that are displayed at first; null: "decision" and "motion", and for
    `inference: !Paper` also "descriptor", the ellipsoids of the obstacles."""


@dataclass(config=BLOCK)
class Scenario:
    """Configuration block of a scenario, which contains all parameters of a run. Each field has a
    default.
    """

    description: str = ""
    """One-line description of the scenario, listed by `drake-oa scenarios`."""
    seed: int = Field(default=0, ge=0, le=2**31 - 1)
    """Seed of the random noise of the simulated cameras [-]. Runs with the same seed give the same
    trajectory."""
    plant_step: float = Field(default=0.002, ge=1e-5, le=0.01)
    """Time step of the simulated plant and of the controller [s]. Raising it makes the simulation
    faster and less accurate."""
    task: Task = Field(default_factory=Task)
    """Nominal motion: start, goal, duration and demonstrations; also the requested clearance."""
    policy: Policy = Field(default_factory=Policy)
    """Constants of the dynamic movement primitive and of its coupling terms."""
    robot: Robot | None = Field(default_factory=Robot)
    """Model, tool and controller gains of the robot; null: no robot, and a free point executes the
    motion."""
    directives: list[Annotated[ModelDirective, DrakeStruct()]] = Field(default_factory=list)
    """Drake model directives, which add models to the world in addition to the robot. Each model
    instance whose name starts with "obstacle" is an obstacle."""
    obstacles: list[Obstacle] = Field(default_factory=list)
    """Obstacles that consist of primitive shapes, at rest, moving, or present for a limited
    time."""
    cameras: list[Annotated[CameraConfig, DrakeStruct()]] = Field(default_factory=list)
    """Drake's configurations of the depth cameras, with unique names."""
    perception: Annotated[
        DepthCamera | GroundTruth | RecordedClouds | GivenEllipsoids | LcmCamera | RecordedBag,
        Tagged(),
    ] = Field(default_factory=GroundTruth)
    """Source from which the obstacles are observed, for example !DepthCamera or !GroundTruth."""
    inference: Annotated[Verified | Paper, Tagged()] = Field(default_factory=Verified)
    """Method that selects the parameters of the coupling terms: !Verified by roll-outs of candidate
    motions, or !Paper as in Pairet et al., RA-L 2019."""
    guard: GuardParameters = Field(default_factory=GuardParameters)
    """Parameters of the maneuvers away from moving obstacles, of the reaction to contacts, and of
    the monitors that slow down or stop the arm."""
    compute_latency: LatencyModel | None = Field(default_factory=LatencyModel)
    """Model of the time for which a decision is computed. The simulation delays each decision by
    this time; null: each decision is active immediately."""
    table_height: float | None = 0.0
    """Height of the table, the plane that supports the obstacles, in the world [m]; null: no table.
    """
    view: View = Field(default_factory=View)
    """Settings of the viewer at the start of a run; the user can change them in the browser."""
    faults: list[Annotated[Fault, Tagged()]] = Field(default_factory=list)
    """Faults that the simulation injects, for example a camera without new images."""


def allow_perception(block: type) -> None:
    """Registers a dataclass as a valid configuration block of the scenario's field `perception`,
    with its class name as YAML tag.

    Args:
        block: dataclass of the configuration block.
    """
    field = next(item for item in dc.fields(Scenario) if item.name == "perception")
    union, tagged = typing.get_args(field.type)
    field.type = Annotated[union | block, tagged]
    rebuild_dataclass(Scenario, force=True)  # type: ignore[arg-type]


def robot_of(scenario: Scenario) -> Robot:
    """Returns the robot block of a scenario, which must not be null.

    Raises:
        ScenarioError: if the scenario has no robot.
    """
    if scenario.robot is None:
        raise ScenarioError("robot: must be set for this command; the scenario has null")
    return scenario.robot
