"""Tests of the contact reaction: a box pushes a resting arm whose guard does not perceive it."""

import numpy as np
import pytest
from pydrake.systems.framework import Context

from drake_oa.common.signal_builder import SignalBuilder
from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.geometry.collision_scene import CollisionScene
from drake_oa.geometry.shapes import Box
from drake_oa.robot.plant import make_robot_plant
from drake_oa.runs.metrics import robot_metrics
from drake_oa.runs.simulation import MotionMonitor, simulate
from drake_oa.safety.config import GuardParameters
from drake_oa.scenario.end_poses import start_positions
from drake_oa.scenario.loading import parse_scenario
from drake_oa.scenario.obstacles import Obstacle
from drake_oa.scenario.scenario import Scenario
from tests.diagrams.fault_systems import ChangedMessages

REST = """
task: {start: [0.45, -0.05, 0.4], goal: [0.45, 0.0, 0.4], duration: 1.0, clearance: 0.05}
directives:
- add_directives: {file: package://drake_oa/scenes/table.dmd.yaml}
perception: !GroundTruth {}
"""
PUSH = 2.5
"""Time at which the box touches the link [s]."""
RETREAT = 0.4
"""Time in which the box moves back [s]."""
REACH = 0.2
"""Distance that the box travels after the first touch [m]."""


def blind(signals: SignalBuilder) -> None:
    """Replaces the collision scene by a current one without geometries."""
    system = ChangedMessages(
        "collision_scene_W", CollisionScene(), lambda t, scene: CollisionScene.of(t, [])
    )
    signals.interpose("collision_scene_W", "blind", system)


def pushed(scenario: Scenario, link: str, speed: float) -> Scenario:
    """Adds a box to a scenario that pushes a link of the resting arm along y and moves back."""
    robot = make_robot_plant(scenario.robot)
    context = robot.plant.CreateDefaultContext()
    robot.plant.SetPositions(context, start_positions(scenario))
    p_WL = robot.plant.GetBodyByName(link).EvalPoseInWorld(context).translation()
    distance = 0.3
    begin, end = PUSH - distance / speed, PUSH + REACH / speed
    box = Obstacle(name="box", shapes=[Box(size=[0.1, 0.1, 0.1])])
    box.translation = (p_WL + [0.0, distance, 0.0]).tolist()
    offsets = (max(begin, 0.0), 0.0), (end, -distance - REACH), (end + RETREAT, 0.0)
    box.waypoints = [[time, 0.0, y, 0.0] for time, y in offsets]
    scenario.obstacles = [box]
    return scenario


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0.3, 0.8])
@pytest.mark.parametrize("link", ["panda_link3", "panda_link5", "panda_hand"])
def test_command_yields_to_the_push_and_the_arm_returns(link: str, speed: float) -> None:
    scenario = pushed(parse_scenario(REST), link, speed)
    diagram = build_avoidance(scenario, customize=blind)
    guard, commands, times = diagram.GetSubsystemByName("motion_guard"), [], []

    def record(monitor: MotionMonitor, root: Context) -> None:
        own = guard.GetMyContextFromRoot(root)
        commands.append(np.array(guard.GetOutputPort("desired_joint_state").Eval(own)))
        times.append(root.get_time())

    log = simulate(scenario, diagram=diagram, duration=10.0, on_step=record)
    metrics = robot_metrics(scenario, log.q, log.q_world)
    assert metrics.contacts
    t, x = np.array(times), np.array(commands)
    limits = log.velocity_limit[:7]
    assert (np.abs(x[:, 7:]) <= limits + 1e-6).all()
    steps = np.diff(t) > 1e-6
    # The command restarts at rest at a contact; otherwise its acceleration is bounded.
    dt, v = np.diff(t)[steps, None], x[:, 7:]
    rate = np.abs(np.diff(v, axis=0))[steps] / dt
    jump = np.diff(x[:, :7], axis=0)[steps] - 0.5 * dt * (v[1:] + v[:-1])[steps]
    is_restart = np.abs(jump).max(axis=1) > 1e-3
    assert rate[~is_restart].max() <= 1.01 * GuardParameters().acceleration_limit
    touching = log.t[metrics.robot_clearance <= 1e-3]
    fast = log.t[(np.abs(log.v[:, :7]) > limits).any(axis=1)]
    assert not len(fast) or fast.max() <= touching.max() + 0.1
    assert np.abs(log.v[-1]).max() < 0.01
    assert log.stop_reason == "goal"
