"""The typed scenario: everything a run needs, in one YAML file.

A scenario file is read in three steps. The text becomes plain mappings
(`pydrake.common.yaml.yaml_load`), overrides are merged into them, every key, tag,
type and range is checked against the dataclasses below, and those of
`drake_oa.scenario_perception`, `drake_oa.obstacles` and `drake_oa.faults`, so that an error
names the field and what would be valid, and `yaml_load_typed` builds the `Scenario`.
"""

# No postponed annotations here: yaml_load_typed reads the fields' types.
import dataclasses as dc
import math
import typing
from importlib import resources
from pathlib import Path
from typing import Any

from pydrake.common.yaml import yaml_dump, yaml_dump_typed, yaml_load_typed
from pydrake.multibody.parsing import ModelDirective
from pydrake.systems.sensors import CameraConfig

from drake_oa.dmp import ALPHA_K, ALPHA_X, BETA_X
from drake_oa.faults import CameraFault, Fault
from drake_oa.goal_course import check_goals
from drake_oa.obstacles import Box, Cylinder, Obstacle, Sphere, check_obstacles, check_shapes
from drake_oa.scenario_fields import choice as _choice
from drake_oa.scenario_fields import count as _count
from drake_oa.scenario_fields import number as _number
from drake_oa.scenario_fields import vector as _vector
from drake_oa.scenario_perception import CameraNoise as CameraNoise
from drake_oa.scenario_perception import (
    DepthCamera,
    GivenEllipsoids,
    GroundTruth,
    RecordedClouds,
    check_cameras,
    check_perception,
)
from drake_oa.scenario_perception import EllipsoidConfig as EllipsoidConfig
from drake_oa.schema_check import ScenarioError, apply_override, check, read_yaml
from drake_oa.verification import SearchParameters
from drake_oa.work import Thinking

_SEARCH = SearchParameters()
_SUFFIX = ".scenario.yaml"


@dc.dataclass
class Task:
    """The motion that was planned without knowing the obstacles."""

    # Where the tool point starts, and should end, in the world frame [m].
    start: list[float] = _vector([0.45, -0.45, 0.3], "m")
    goal: list[float] = _vector([0.45, 0.45, 0.3], "m")
    # Where the goal is moved to, and when: rows [t, x, y, z]; from time t on it is there, in
    # the world [s, m].
    goal_moves: list[list[float]] = dc.field(default_factory=list)
    # Duration T of the demonstrated motion; the avoiding one takes tau T [s]. Ignored
    # where the demonstration brings its own `t`: then T is what that spans.
    duration: float = _number(5.0, "s", 0.0, 600.0, open_low=True)
    # Asked distance between tool and obstacle, Delta [m].
    clearance: float = _number(0.15, "m", 0.0, 2.0, open_low=True)
    # Roll, pitch and yaw of R_WE at start and goal [rad]; null: what the demonstration has
    # there, or without orientations in it `robot.rpy_WE`.
    rpy_start: list[float] | None = dc.field(default=None, metadata={"unit": "rad", "size": 3})
    rpy_goal: list[float] | None = dc.field(default=None, metadata={"unit": "rad", "size": 3})
    # Joints of the arm at start and goal, as many as `robot.q_seed` has [rad]; null: what
    # inverse kinematics finds near that. What is not stated of start, goal and their
    # orientations follows from them, and what is must agree. The posture leads from one to
    # the other.
    q_start: list[float] | None = dc.field(default=None, metadata={"unit": "rad"})
    q_goal: list[float] | None = dc.field(default=None, metadata={"unit": "rad"})
    # A demonstrated path to imitate: .npz with `path` (T, 3) and, if uneven in
    # time, `t` (T,) [s]; and, if the tool turns, its orientations R_WE as `quaternion` (T, 4),
    # w first and of either sign, or `R` (T, 3, 3). Relative to the scenario file. Empty:
    # minimum jerk along the straight line and about a fixed axis.
    demonstration: str = ""


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
    weights: str = "package://drake_oa/weights/regressor_chain.npz"
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
class Verified:
    """Coupling parameters that roll-outs of the motion have checked."""

    # Motions that are rolled out a round.
    candidates: int = _count(_SEARCH.candidates, 32, 4096)
    # Rounds of the search at most, and after the first motion that keeps the clearance.
    rounds: int = _count(_SEARCH.rounds, 0, 1000)
    polish: int = _count(_SEARCH.polish, 0, 1000)
    # Searches again, finer and on every side, where it is not kept: seconds a decision.
    retries: int = _count(_SEARCH.retries, 0, 10)
    # A motion keeps the clearance when it is short of it by no more than this [m].
    slack: float = _number(_SEARCH.slack, "m", 0.0, 0.1)


@dc.dataclass
class Regressor:
    """Coupling parameters as the regressor chain gives them, sides by cost rings: the paper."""

    # Whether the policy is given the route. Without it the motion only reacts: the term turns
    # it about the section of the P-plane, to whatever side it happens to head for.
    guided: bool = True


@dc.dataclass
class Supervisor:
    """What slows, holds or stops a motion of the robot that is not safe."""

    # Distance of a link to an obstacle or the table at which an approach is at rest [m].
    stop_distance: float = _number(0.025, "m", 0.0, 1.0)
    # The controller comes to rest this much later than the policy, whose own time
    # is `policy.hold_time` [s].
    lag: float = _number(0.05, "s", 0.0, 10.0)
    # Share of full speed at which a link that is nearer may leave; one where the motion is held
    # leaves only with 0.3 or more.
    leave_scale: float = _number(0.3, "1", 0.0, 1.0, open_low=True)
    # Frames that may be missed before the motion slows; it is held at the age
    # `policy.max_observation_age`.
    stale_frames: float = _number(2.5, "1", 1.0, 1e6)
    # Distance of a joint from its position limit at which an approach is at rest [rad].
    joint_margin: float = _number(0.02, "rad", 0.0, 3.0)
    # Tracking error of the tool point that begins to slow the motion, and that holds it [m].
    tracking_slow: float = _number(0.02, "m", 0.0, 1.0, open_low=True)
    tracking_hold: float = _number(0.05, "m", 0.0, 1.0, open_low=True)
    # Torque saturation that lasts longer slows the motion [s].
    saturation_time: float = _number(0.1, "s", 0.0, 10.0, open_low=True)
    # Time in which the speed rises from rest to full [s].
    recovery_time: float = _number(1.0, "s", 0.0, 60.0, open_low=True)
    # A hold that cannot end by itself becomes a stop after this time [s].
    patience: float = _number(3.0, "s", 0.0, 600.0, open_low=True)


@dc.dataclass
class Evasion:
    """What gets the arm out of the way of what moves."""

    # Distance of any link to what moves below which the motion is not left as it is [m].
    margin: float = _number(0.05, "m", 0.0, 1.0, open_low=True)
    # How far ahead it is looked, at least as far as a motion has to keep the margin [s].
    horizon: float = _number(1.2, "s", 0.7, 10.0)
    # Greatest speed [m/s] and acceleration [m/s^2] of the tool while it evades.
    speed: float = _number(0.6, "m/s", 0.0, 5.0, open_low=True)
    acceleration: float = _number(6.0, "m/s^2", 0.0, 50.0, open_low=True)
    # Of the joints in the null space of the tool's task, the norm of all; 0: none.
    turn_speed: float = _number(1.5, "rad/s", 0.0, 10.0)
    turn_acceleration: float = _number(10.0, "rad/s^2", 0.0, 100.0, open_low=True)


@dc.dataclass
class Gains:
    """Stiffness and damping of the Cartesian controller (critical by default)."""

    # Position [1/s^2] and [1/s].
    kp_position: float = _number(400.0, "1/s^2", 0.0, 1e5)
    kd_position: float = _number(40.0, "1/s", 0.0, 1e4)
    # Of the position error's integral, below kp kd; 0: none [1/s^3].
    ki_position: float = _number(1000.0, "1/s^3", 0.0, 1e6)
    # Orientation.
    kp_orientation: float = _number(400.0, "1/s^2", 0.0, 1e5)
    kd_orientation: float = _number(40.0, "1/s", 0.0, 1e4)
    # Posture, in the null space of the task.
    kp_posture: float = _number(25.0, "1/s^2", 0.0, 1e5)
    kd_posture: float = _number(10.0, "1/s", 0.0, 1e4)


@dc.dataclass
class NullSpaceCoupling:
    """The coupling law on the links' points that are nearest to obstacles."""

    # Strength [rad/s], width over the heading [rad], decay over the distance [1/m^2].
    alpha: float = _number(300.0, "rad/s", 0.0, 1e4)
    psi: float = _number(1.5, "rad", 0.0, 10.0, open_low=True)
    kappa: float = _number(20.0, "1/m^2", 0.0, 1e4, open_low=True)


@dc.dataclass
class Posture:
    """Where the rest of the arm goes while the tool follows its path."""

    # Distance that the links are to keep from obstacles and the table, where they can [m].
    clearance: float = _number(0.1, "m", 0.0, 1.0, open_low=True)
    # Whether it is planned along the verified motion; else it is drawn to that of the start.
    plan: bool = True
    # The paper's reaction of the links in the null space, besides; null: none.
    coupling: NullSpaceCoupling | None = None


@dc.dataclass
class Robot:
    """The arm that carries the tool. Welded to the world by `base_link`."""

    # Drake's own Panda is package://drake_models/franka_description/urdf/panda_arm_hand.urdf
    model: str = "package://drake_oa/panda/panda_arm_hand.urdf"
    base_link: str = "panda_link0"
    # The tool point E is p_HE in the frame of the hand link H.
    hand_link: str = "panda_hand"
    p_HE: list[float] = _vector([0.0, 0.0, 0.1034], "m")
    # Bodies that make up the tool: they dilate the obstacles.
    tool_links: list[str] = dc.field(
        default_factory=lambda: ["panda_hand", "panda_leftfinger", "panda_rightfinger"]
    )
    # Orientation of E, held throughout where neither the task nor `policy.turn` turns it: roll,
    # pitch, yaw [rad]. Tool down, fingers opening along the world's x: the hand is narrow along
    # the motion.
    rpy_WE: list[float] = _vector([math.pi, 0.0, math.pi / 2.0], "rad")
    # Seed of the inverse kinematics and posture of the null space, a number for each joint of the
    # arm: these are the first of the model's joints [rad].
    q_seed: list[float] = dc.field(
        default_factory=lambda: [-0.7401, 0.1857, 0.0143, -1.9017, -0.003, 2.0874, 0.0608],
        metadata={"unit": "rad"},
    )
    # Opening of each finger [m]. At a joint's limit the plant's steps cost more.
    finger_opening: float = _number(0.005, "m", 0.0, 0.04)
    # What the hand holds, posed in the frame of the hand link H; part of the tool.
    carried: list[Box | Cylinder | Sphere] = dc.field(default_factory=list)
    # Mass of all of it, shared out by volume [kg].
    carried_mass: float = _number(0.5, "kg", 0.0, 20.0, open_low=True)
    gains: Gains = dc.field(default_factory=Gains)
    # The posture of an arm of seven joints is planned; null: it is drawn to that of the start.
    posture: Posture | None = dc.field(default_factory=Posture)


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
    supervisor: Supervisor | None = dc.field(default_factory=Supervisor)
    # What gets the arm out of the way of what moves, or null: nothing does; nor does anything
    # without a supervisor.
    evasion: Evasion | None = dc.field(default_factory=Evasion)
    # What decisions cost in simulated time, or null: they are in force at once.
    thinking: Thinking | None = dc.field(default_factory=Thinking)
    # Height of the table in the world; null: there is none [m].
    table_height: float | None = dc.field(default=0.0, metadata={"unit": "m"})
    # What goes wrong, and when.
    faults: list[Fault] = dc.field(default_factory=list)


def shipped_scenarios() -> dict[str, Path]:
    """Name -> file of the scenarios that come with the package."""
    folder = Path(str(resources.files("drake_oa.diagrams")))
    return {p.name.removesuffix(_SUFFIX): p for p in sorted(folder.glob(f"*{_SUFFIX}"))}


def scenario_path(name_or_file: str) -> Path:
    """Finds a scenario by shipped name or by file.

    Raises:
        ScenarioError: if it is neither; lists the shipped names.
    """
    shipped = shipped_scenarios()
    if name_or_file in shipped:
        return shipped[name_or_file]
    path = Path(name_or_file)
    if path.is_file():
        return path
    raise ScenarioError(
        f"unknown scenario '{name_or_file}': it is neither a file nor one of {', '.join(shipped)}"
    )


def load_scenario(name_or_file: str, overrides: typing.Sequence[str] = ()) -> Scenario:
    """Reads a scenario and applies overrides.

    Args:
        name_or_file: a shipped name (see `shipped_scenarios`) or a path.
        overrides: texts "a.b=c": c, read as YAML, replaces field b of block a.
            A value with a tag ("perception=!GroundTruth {}") replaces the block.

    Raises:
        ScenarioError: naming the field and what would be valid.
    """
    path = scenario_path(name_or_file)
    try:
        return parse_scenario(path.read_text("utf-8"), overrides, folder=path.parent)
    except (ScenarioError, UnicodeDecodeError) as error:
        raise ScenarioError(f"{path.name}: {error}") from None


def parse_scenario(
    text: str, overrides: typing.Sequence[str] = (), *, folder: Path | None = None
) -> Scenario:
    """Builds a `Scenario` from YAML text; see `load_scenario`.

    Relative file names in it are relative to `folder` (None: the current directory),
    those in overrides to the current directory.
    """
    data = read_yaml(text)
    data = {} if data is None else data
    if not isinstance(data, dict):
        raise ScenarioError(
            f"expected a block of field: value, not the {type(data).__name__} {data!r}"
        )
    _resolve_files(data, folder or Path())
    for override in overrides:
        apply_override(data, override)
    _resolve_files(data, Path())
    check(data, Scenario, "", {})
    try:
        scenario = yaml_load_typed(schema=Scenario, data=yaml_dump(data), defaults=Scenario())
    except (RuntimeError, ValueError, TypeError) as error:
        raise ScenarioError(str(error)) from None
    _check_whole(scenario)
    # The robot's plant is built from the scenario that is defined here.
    from drake_oa.task_joints import follow_joints

    follow_joints(
        scenario, {name for name, value in data.get("task", {}).items() if value is not None}
    )
    return scenario


def _check_whole(scenario: Scenario) -> None:
    """What no single field can tell."""
    names = [camera.name for camera in scenario.cameras]
    check_cameras(scenario.cameras)
    check_obstacles(scenario.obstacles)
    if scenario.robot is not None:
        check_shapes(scenario.robot.carried, "robot.carried")
    _check_turn(scenario.policy.turn)
    _check_faults(scenario)
    perception = scenario.perception
    check_perception(perception, names)
    if scenario.robot is None and not isinstance(perception, GivenEllipsoids):
        raise ScenarioError(
            "robot: null (a free point) needs 'perception: !GivenEllipsoids'; "
            f"it has !{type(perception).__name__}"
        )
    supervisor = scenario.supervisor
    if supervisor is not None and supervisor.tracking_hold <= supervisor.tracking_slow:
        raise ScenarioError(
            f"supervisor.tracking_hold: {supervisor.tracking_hold} must be more than "
            f"supervisor.tracking_slow, {supervisor.tracking_slow} [m]"
        )
    check_goals(scenario.task.start, scenario.task.goal, scenario.task.goal_moves)


def _check_turn(turn: Turn | None) -> None:
    """Refuses an axis without a direction.

    Raises:
        ScenarioError: naming the field.
    """
    if turn is not None and not math.hypot(*turn.axis) > 1e-6:
        raise ScenarioError(f"policy.turn.axis: {turn.axis} has no direction")


def _check_faults(scenario: Scenario) -> None:
    """Refuses faults of something that the scenario does not have."""
    for number, fault in enumerate(scenario.faults):
        what = f"faults[{number}]: !{type(fault).__name__}"
        if isinstance(fault, CameraFault) and not isinstance(scenario.perception, DepthCamera):
            raise ScenarioError(
                f"{what} needs 'perception: !DepthCamera'; it has "
                f"!{type(scenario.perception).__name__}"
            )
        if scenario.robot is None:
            raise ScenarioError(f"{what} needs a robot; this scenario has null")


def _resolve_files(data: dict[str, Any], base: Path) -> None:
    """Makes relative file names absolute; URLs, and what is no text, stay."""
    for name, field in (
        ("perception", "folder"),
        ("task", "demonstration"),
        ("policy", "weights"),
    ):
        block = data.get(name)
        if not isinstance(block, dict):
            continue
        file = block.get(field)
        if isinstance(file, str) and file and "://" not in file:
            block[field] = str(base.absolute() / Path(file).expanduser())


def package_file(url_or_file: str) -> Path:
    """The file behind a `package://drake_oa/...` URL, or the path itself."""
    prefix = "package://drake_oa/"
    if url_or_file.startswith(prefix):
        return Path(str(resources.files("drake_oa.models"))) / url_or_file.removeprefix(prefix)
    return Path(url_or_file)


def scenario_text(scenario: Scenario) -> str:
    """The scenario as YAML, defaults included, as it is written into a log.

    `parse_scenario` makes the same scenario of it.
    """
    text: str = yaml_dump_typed(scenario)
    data = read_yaml(text)
    # yaml_dump_typed leaves nulls out; reading that back would give the defaults.
    return yaml_dump(data) if _add_nulls(scenario, data) else text


def _add_nulls(value: Any, data: Any) -> bool:
    """Writes the fields of a dataclass that are None into its mapping; says if any was."""
    found = False
    if isinstance(value, list):
        for inner, place in zip(value, data, strict=True):
            found |= _add_nulls(inner, place)
    if not dc.is_dataclass(value):
        return found
    for item in dc.fields(value):
        inner = getattr(value, item.name)
        if inner is None:
            data[item.name], found = None, True
        elif item.name in data:
            found |= _add_nulls(inner, data[item.name])
    return found
