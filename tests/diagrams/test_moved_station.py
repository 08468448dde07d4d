"""Tests of a displaced and rotated station: the motion equals that at the world's origin.

Decisions from given ellipsoids are equal up to rounding. Decisions from clouds are not: enclosing
ellipsoids are computed to about a millimeter, which amplifies rounding.
"""

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from drake_oa.geometry.shapes import pose
from drake_oa.robot.config import BasePose
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.end_poses import start_positions
from drake_oa.scenario.loading import parse_scenario
from drake_oa.scenario.perception import GivenEllipsoids
from drake_oa.scenario.scenario import Scenario

TURNED = RigidTransform(RollPitchYaw(0.0, 0.0, 2.2), [1.5, -0.7, 0.4])
"""Pose of the displaced station's origin in the world."""

_STATION = """
task: {{start: [0.45, -0.4, 0.3], goal: [0.45, 0.4, 0.3], duration: 2.0, clearance: 0.1}}
compute_latency: null
table_height: {height}
directives:
- add_model: {{name: table, file: package://drake_oa/scenes/table.sdf}}
- add_weld:
    parent: world
    child: table::body
    X_PC: {{translation: {place}, rotation: !Rpy {{deg: [0, 0, {degrees}]}}}}
- add_model: {{name: camera_mount, file: package://drake_oa/scenes/camera_mount.sdf}}
- add_weld:
    parent: world
    child: camera_mount::body
    X_PC: {{translation: {mount}, rotation: !Rpy {{deg: [0, 0, {looks}]}}}}
"""
_GIVEN = """
perception: !GivenEllipsoids
  ellipsoids: [{center: [0.52, 0.03, 0.28], semi_axes: [0.2, 0.18, 0.3], rpy: [0.1, 0.2, 0.3]}]
"""
_THOROUGH = """
inference: !Verified
  candidates: 256
  generations: 24
  compute_budget: 10
"""
"""Search that is long enough to converge; a short one ends at one of many similar motions."""

_SEEN = """
perception: !DepthCamera {camera: camera}
obstacles:
- {name: box, shapes: [!Box {size: [0.1, 0.2, 0.3]}], translation: [0.52, 0.03, 0.15]}
cameras:
- name: camera
  width: 320
  height: 240
  focal: !FovDegrees {x: 58.0, y: 45.0}
  z_near: 0.8
  z_far: 3.5
  X_PB: {base_frame: camera_mount::camera}
  renderer_name: vtk
  renderer_class: RenderEngineVtk
  fps: 30
  rgb: false
  depth: true
"""


def station(X_WN: RigidTransform, blocks: str) -> Scenario:
    """Returns a scenario whose robot, table, camera, task and obstacles are displaced by X_WN."""
    p, yaw = X_WN.translation().tolist(), float(RollPitchYaw(X_WN.rotation()).yaw_angle())
    text = _STATION.format(
        place=p,
        height=p[2],
        degrees=float(np.rad2deg(yaw)),
        mount=(X_WN @ np.array([1.2473, 0.2902, 0.0])).tolist(),
        looks=float(np.rad2deg(yaw)) + 20.0,
    )
    scenario = parse_scenario(text + blocks)
    task, robot = scenario.task, scenario.robot
    # Otherwise inverse kinematics would compute the start to its own tolerance.
    task.q_start = start_positions(scenario)[: len(robot.q_seed)].tolist()
    task.start, task.goal = ((X_WN @ np.array(place)).tolist() for place in (task.start, task.goal))
    robot.X_WB = BasePose(p, [0.0, 0.0, yaw])
    robot.rpy_WE[2] += yaw
    for obstacle in scenario.obstacles:
        obstacle.translation, obstacle.rpy = moved(X_WN @ pose(obstacle))
    if isinstance(scenario.perception, GivenEllipsoids):
        for item in scenario.perception.ellipsoids:
            X_WO = X_WN @ RigidTransform(RollPitchYaw(item.rpy), item.center)
            item.center, item.rpy = moved(X_WO)
    return scenario


def moved(X: RigidTransform) -> tuple[list[float], list[float]]:
    """Returns translation [m] and roll, pitch, yaw [rad] of a pose."""
    return X.translation().tolist(), RollPitchYaw(X.rotation()).vector().tolist()


@pytest.mark.parametrize(
    ("blocks", "duration", "apart", "joints"),
    [
        (_SEEN + _THOROUGH, 0.6, 1.5e-2, 3e-2),
        (_GIVEN + "inference: !Paper {guided: true}", 1.0, 1e-6, 1e-6),
    ],
)
def test_displaced_station_has_the_same_motion(
    blocks: str, duration: float, apart: float, joints: float
) -> None:
    base = simulate(station(RigidTransform(), blocks), duration=duration)
    other = simulate(station(TURNED, blocks), duration=duration)
    p_WE, p_WO = ((TURNED @ p.reshape(-1, 3).T).T.reshape(p.shape) for p in (base.p_WE, base.p_WO))
    np.testing.assert_allclose(other.p_WO, p_WO, atol=2e-3)
    np.testing.assert_allclose(other.p_WE, p_WE, atol=apart)
    np.testing.assert_allclose(other.q, base.q, atol=joints)
    assert np.ptp(base.p_WE, axis=0).max() > 0.01
    assert other.event == base.event
