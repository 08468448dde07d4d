"""Functions that add Drake's visualizer and an overlay of intermediate results to a diagram."""

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
from drake_oa.viewing.viewer import add_world_visualizer, set_scene_style


def add_view(
    signals: SignalBuilder, scenario: Scenario, station: StationModel | None, meshcat: Meshcat
) -> None:
    """Adds Drake's visualizer, and the system overlay that draws results of other systems.

    The overlay draws point cloud, ellipsoids, paths and cost rings (costs of passing an obstacle in
    each direction). If the diagram lacks cost rings, as with `inference: !Paper {guided: false}`, a
    system that computes them is added for the overlay only.
    """
    if isinstance(scenario.inference, Paper) and "shown_route" not in signals:
        outputs = {"decision": None, "route": "shown_route"}
        signals.add("cost_ring_selector", make_cost_ring_selector(scenario), outputs=outputs)
    signals.add(
        "overlay", make_overlay(scenario, station, meshcat), inputs={"route": "shown_route"}
    )
    if station is not None:
        add_world_visualizer(signals.builder, station.scene_graph, meshcat)


def make_overlay(
    scenario: Scenario, station: StationModel | None, meshcat: Meshcat
) -> MeshcatOverlay:
    """Creates the system that draws results of perception, inference and planning in the viewer.

    It also sets background and camera pose of the viewer. The field `view.show` of the scenario
    selects the results that are displayed at first; null: cost rings (costs of passing each
    obstacle in the directions around it) and paths of the tool, and for `inference: !Paper` also
    the ellipsoids that enclose the obstacles.
    """
    set_scene_style(meshcat, base_pose(scenario.robot), scenario.table_height or 0.0)
    show = scenario.view.show
    if show is None:
        show = ["decision", "motion"]
        show += ["descriptor"] if isinstance(scenario.inference, Paper) else []
    robot, hand = scenario.robot, None
    if station is not None and robot is not None:
        hand = station.plant.GetBodyByName(robot.hand_link, station.robot).index()
    return MeshcatOverlay(
        meshcat,
        nominal_W=_nominal_path(scenario),
        body_index=hand,
        p_BE=[0.0] * 3 if robot is None else robot.p_HE,
        show=show,
    )


def _nominal_path(scenario: Scenario) -> FloatArray | None:
    """Computes the path (T, 3) of the tool point in the nominal motion, in the world frame [m].

    The nominal motion is the demonstrated motion without coupling terms. The path is None for a
    task without demonstration, whose nominal motion is a straight line.
    """
    task = scenario.task
    if not task.demonstration:
        return None
    return trajectory(make_dmp(scenario), task.start, task.goal).p
