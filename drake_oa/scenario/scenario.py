"""Configuration block of all parameters of a run, composed of the blocks of the layers.

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
"""Name of a layer that a viewer can display."""
LAYERS = typing.get_args(Layer)
"""Layers of a viewer, as folders of its scene tree: clouds and cameras; ellipsoids and their
sections; cost rings and selected sides; planned and executed path."""


@dataclass(config=BLOCK)
class View:
    """Initial settings of a viewer; its user can change them."""

    show: list[Layer] | None = None
    """Names of the displayed layers; null: decision and motion, and the descriptor for !Paper."""


@dataclass(config=BLOCK)
class Scenario:
    """Parameters of a run. Each field has a default."""

    description: str = ""
    """One-line description, listed by `drake-oa scenarios`."""
    seed: int = Field(default=0, ge=0, le=2**31 - 1)
    """Seed of the camera noise [1]. Runs with the same seed give the same trajectory."""
    plant_step: float = Field(default=0.002, ge=1e-5, le=0.01)
    """Time step of the simulated plant and the controller [s]. Raising it makes the simulation
    faster and less accurate."""
    task: Task = Field(default_factory=Task)
    """Nominal motion: start, goal, duration, demonstrations, and requested clearance."""
    policy: Policy = Field(default_factory=Policy)
    """Constants of the dynamic movement primitive."""
    robot: Robot | None = Field(default_factory=Robot)
    """Robot model, tool and gains; null: a free point executes the motion."""
    directives: list[Annotated[ModelDirective, DrakeStruct()]] = Field(default_factory=list)
    """Models in the world in addition to the robot, as Drake model directives. Model instances
    whose name starts with "obstacle" are obstacles."""
    obstacles: list[Obstacle] = Field(default_factory=list)
    """Obstacles of primitive shapes."""
    cameras: list[Annotated[CameraConfig, DrakeStruct()]] = Field(default_factory=list)
    """Drake's camera configurations, with unique names."""
    perception: Annotated[
        DepthCamera | GroundTruth | RecordedClouds | GivenEllipsoids | LcmCamera,
        Tagged(),
    ] = Field(default_factory=GroundTruth)
    """Source of the obstacles."""
    inference: Annotated[Verified | Paper, Tagged()] = Field(default_factory=Verified)
    """Source of the coupling parameters."""
    guard: GuardParameters = Field(default_factory=GuardParameters)
    """Maneuvers away from moving obstacles, contact reaction, and monitors."""
    compute_latency: LatencyModel | None = Field(default_factory=LatencyModel)
    """Simulated compute latency of decisions; null: decisions are active immediately."""
    table_height: float | None = 0.0
    """Height of the support plane, the table, in the world [m]; null: no table. Raising it raises
    the table."""
    view: View = Field(default_factory=View)
    """Initial settings of a viewer."""
    faults: list[Annotated[Fault, Tagged()]] = Field(default_factory=list)
    """Faults injected into the simulation."""


def allow_perception(block: type) -> None:
    """Registers a dataclass as a valid block of `perception`, with its class name as the tag."""
    field = next(item for item in dc.fields(Scenario) if item.name == "perception")
    union, tagged = typing.get_args(field.type)
    field.type = Annotated[union | block, tagged]
    rebuild_dataclass(Scenario, force=True)  # type: ignore[arg-type]


def robot_of(scenario: Scenario) -> Robot:
    """Returns the robot of a scenario that must have one.

    Raises:
        ScenarioError: if it has none.
    """
    if scenario.robot is None:
        raise ScenarioError("robot: must be set for this command; the scenario has null")
    return scenario.robot
