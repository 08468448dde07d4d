"""MeshcatOverlay: drawn objects, their visibility over time, and the camera of the viewer."""

from unittest.mock import Mock

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.tree import BodyIndex
from pydrake.perception import PointCloud
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantValueSource

from drake_oa.common.messages import PolicyState, Route
from drake_oa.viewing.meshcat_overlay import LAYERS, PERIOD, MeshcatOverlay
from drake_oa.viewing.viewer import set_scene_style
from tests.builders import TimeFunctionSource, balls

ROOT = "/drake_oa"


@pytest.fixture(scope="module")
def server():
    """Returns a Meshcat server for all tests of this module."""
    return Meshcat(MeshcatParams(host="localhost"))


@pytest.fixture
def meshcat(server):
    """Returns the Meshcat server without objects of earlier tests."""
    server.Delete(ROOT)
    server.DeleteRecording()
    return server


def obstacles(*ids):
    """Returns ellipsoids of equal size and position with the given IDs."""
    return balls(*[(0.5, 0.0, 0.2)] * len(ids), radius=(0.1, 0.15, 0.2), stamp=-np.inf, ids=ids)


def sides(*ids, cost=0.0):
    """Returns a route with the selected direction up for each obstacle ID."""
    count = len(ids)
    return Route(
        direction_W=np.tile([0.0, 0.0, 1.0], (count, 1)),
        normal_W=np.tile([1.0, 0.0, 0.0], (count, 1)),
        index=np.zeros(count, dtype=np.int64),
        angles=np.arange(8) * np.pi / 4,
        costs={"table": np.full((count, 8), cost), "length": np.zeros((count, 8))},
        ids=np.array(ids, dtype=np.int64),
    )


def moving_policy(time):
    """Returns the policy state of a motion along y at 0.2 m/s."""
    return PolicyState(
        p_WE=np.array([0.3, -0.4 + 0.2 * time, 0.3]),
        z_W=np.array([0.0, 0.2, 0.0]),
        p_WS=np.array([0.3, -0.4, 0.3]),
        p_WG=np.array([0.3, 0.4, 0.3]),
        R_WL=np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    )


def simulator(meshcat, ellipsoids=None, route=None, policy=moving_policy, more=(), **options):
    """Builds a simulator of an overlay with sources; a callable input is a function of time."""
    builder = DiagramBuilder()
    overlay = builder.AddNamedSystem("overlay", MeshcatOverlay(meshcat, **options))
    inputs = {
        "ellipsoids_W": obstacles() if ellipsoids is None else ellipsoids,
        "route": sides() if route is None else route,
        "policy_state": policy,
        **dict(more),
    }
    for name, value in inputs.items():
        if callable(value):
            source = builder.AddSystem(TimeFunctionSource(value))
        else:
            wrapped = value if hasattr(value, "get_value") else Value(value)
            source = builder.AddSystem(ConstantValueSource(wrapped))
        builder.Connect(source.get_output_port(), overlay.GetInputPort(name))
    return Simulator(builder.Build())


def is_visible(meshcat, path):
    """Checks whether the property `visible` of a path is true."""
    return b"\xc3" in meshcat._GetPackedProperty(f"{ROOT}/{path}", "visible")


def test_objects_of_constant_shape_are_drawn_at_the_start(meshcat):
    simulator(meshcat, show=["motion"]).Initialize()
    places = ("descriptor/7/ellipsoid/shape", "decision/7/direction/line")
    for path in (*places, "motion/nominal/start", "motion/nominal/goal", "motion/nominal/path"):
        assert meshcat.HasPath(f"{ROOT}/{path}")
    assert [layer for layer in LAYERS if is_visible(meshcat, layer)] == ["motion"]


def frames(meshcat, path):
    """Returns the numbers of the frames with an object below a path."""
    return [k for k in range(10) if meshcat.HasPath(f"{ROOT}/{path}/{k}")]


def test_executed_path_grows_while_moving_and_restarts_with_the_simulation(meshcat):
    sim = simulator(meshcat)
    sim.AdvanceTo(3.5 * PERIOD)
    assert frames(meshcat, "motion/executed") == [1, 2, 3]
    # The state is in the Context, so that one system can be part of several simulations.
    other = Simulator(sim.get_system())
    other.AdvanceTo(1.5 * PERIOD)
    assert frames(meshcat, "motion/executed") == [1]


def test_executed_path_is_that_of_the_tool_body_if_its_poses_are_connected(meshcat):
    bodies = Value[list[RigidTransform]]()
    bodies.set_value([RigidTransform(), RigidTransform([1.0, 2.0, 3.0])])
    sim = simulator(meshcat, more=[("body_poses", bodies)], body_index=BodyIndex(1))
    sim.AdvanceTo(3.5 * PERIOD)
    assert not meshcat.HasPath(f"{ROOT}/motion/executed")


def test_obstacles_keep_their_slots_and_rings_are_those_of_obstacles(meshcat):
    points = Value(PointCloud(1))
    sim = simulator(
        meshcat,
        lambda time: obstacles(1, 2) if time < 1.5 * PERIOD else obstacles(2),
        sides(2, 9),
        more=[("cloud", points)],
    )
    sim.AdvanceTo(3.5 * PERIOD)
    for layer, slots in (("descriptor", [2]), ("decision", [2])):
        assert [k for k in range(8) if is_visible(meshcat, f"{layer}/{k}")] == slots
    assert frames(meshcat, "decision/2/rings") == [0, 3]
    assert not is_visible(meshcat, "decision/2/rings/0")
    assert frames(meshcat, "perception/cloud") == [0, 3]


def test_viewer_camera_follows_the_base_pose():
    hanging = RigidTransform(RollPitchYaw(np.pi, 0.0, np.pi / 2.0), [1.0, 2.0, 1.3])
    usual, there = Mock(), Mock()
    set_scene_style(usual, RigidTransform(), 0.0)
    set_scene_style(there, hanging, 0.2)
    turned = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    points = (viewer.SetCameraPose.call_args.args for viewer in (usual, there))
    for p_FC, p_WC in zip(*points, strict=True):
        np.testing.assert_allclose(p_WC, turned @ p_FC + [1.0, 2.0, 0.2], atol=1e-12)
