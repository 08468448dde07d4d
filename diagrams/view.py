"""Wiring of the viewer: Drake's visualizer, and the overlay of intermediate results."""

from __future__ import annotations

from pydrake.geometry import Meshcat

from drake_oa.common.messages import FloatArray
from drake_oa.common.signal_builder import SignalBuilder
from drake_oa.diagrams.motion import make_cost_ring_selector, make_dmp
from drake_oa.diagrams.station import StationModel
from drake_oa.inference.config import Paper
from drake_oa.policy.dmp import trajectory
from drake_oa.robot.plant import base_pose
from drake_oa.scenario.scenario import Scenario
from drake_oa.viewing.meshcat_overlay import MeshcatOverlay
from drake_oa.viewing.viewer import dress_scene, show_world


def add_view(
    signals: SignalBuilder, scenario: Scenario, station_model: StationModel | None, meshcat: Meshcat
) -> None:
    """Adds overlay, and the cost rings that it draws where what only reacts goes without."""
    if isinstance(scenario.inference, Paper) and "shown_route" not in signals:
        outputs = {"decision": None, "route": "shown_route"}
        signals.add("cost_ring_selector", make_cost_ring_selector(scenario), outputs=outputs)
    signals.add(
        "overlay", make_overlay(scenario, station_model, meshcat), inputs={"route": "shown_route"}
    )
    if station_model is not None:
        show_world(signals.builder, station_model.scene_graph, meshcat)


def make_overlay(
    scenario: Scenario, station_model: StationModel | None, meshcat: Meshcat
) -> MeshcatOverlay:
    """Makes the overlay of intermediate results; also sets background and camera of the viewer."""
    dress_scene(meshcat, base_pose(scenario.robot), scenario.table_height or 0.0)
    show = scenario.view.show
    if show is None:
        show = ["decision", "motion"]
        show += ["descriptor"] if isinstance(scenario.inference, Paper) else []
    robot, hand = scenario.robot, None
    if station_model is not None and robot is not None:
        hand = station_model.plant.GetBodyByName(robot.hand_link, station_model.robot).index()
    return MeshcatOverlay(
        meshcat,
        planned_W=_planned_path(scenario),
        body_index=hand,
        p_BE=[0.0] * 3 if robot is None else robot.p_HE,
        show=show,
    )


def _planned_path(scenario: Scenario) -> FloatArray | None:
    """(T, 3) the planned motion in the world; None for the straight line."""
    task = scenario.task
    if not task.demonstration:
        return None
    return trajectory(make_dmp(scenario), task.start, task.goal).p
