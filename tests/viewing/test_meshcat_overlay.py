"""The overlay in Meshcat."""

from unittest.mock import Mock

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.tree import BodyIndex
from pydrake.perception import BaseField, Fields, PointCloud
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantValueSource
from pydrake.systems.sensors import CameraInfo

from drake_oa.common.messages import PolicyState, Route
from drake_oa.viewing.meshcat_overlay import LAYERS, MeshcatOverlay, SeenRange, dress_scene
from tests.builders import balls

PERIOD = 0.1
ROOT = "/drake_oa"


@pytest.fixture(scope="module")
def server():
    return Meshcat(MeshcatParams(host="localhost"))


@pytest.fixture
def meshcat(server):
    server.Delete(ROOT)
    server.DeleteRecording()
    return server


def obstacles(*ids):
    return balls(*[(0.5, 0.0, 0.2)] * len(ids), radius=(0.1, 0.15, 0.2), stamp=-np.inf, ids=ids)


def sides(*ids, cost=0.0):
    count = len(ids)
    return Route(
        direction_W=np.tile([0.0, 0.0, 1.0], (count, 1)),
        heading_W=np.zeros((count, 3)),
        normal_W=np.tile([1.0, 0.0, 0.0], (count, 1)),
        index=np.zeros(count, dtype=np.int64),
        angles=np.arange(8) * np.pi / 4,
        costs={"table": np.full((count, 8), cost), "length": np.zeros((count, 8))},
        ids=np.array(ids, dtype=np.int64),
    )


class Moving(LeafSystem):
    """Emits `value(time)` as an abstract value."""

    def __init__(self, value):
        super().__init__()
        self.DeclareAbstractOutputPort(
            "value",
            lambda: Value(value(0.0)),
            lambda context, output: output.set_value(value(context.get_time())),
        )


def moving_policy(time):
    return PolicyState(
        p_WE=np.array([0.3, -0.4 + 0.2 * time, 0.3]),
        z_W=np.array([0.0, 0.2, 0.0]),
        p_WS=np.array([0.3, -0.4, 0.3]),
        p_WG=np.array([0.3, 0.4, 0.3]),
        R_WL=np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    )


def simulator(meshcat, ellipsoids=None, route=None, policy=moving_policy, more=(), **options):
    """Overlay with sources; a callable input is a function of time."""
    builder = DiagramBuilder()
    overlay = builder.AddNamedSystem("overlay", MeshcatOverlay(meshcat, period=PERIOD, **options))
    inputs = {
        "ellipsoids_W": obstacles() if ellipsoids is None else ellipsoids,
        "route": sides() if route is None else route,
        "policy_state": policy,
        **dict(more),
    }
    for name, value in inputs.items():
        if callable(value):
            source = builder.AddSystem(Moving(value))
        else:
            wrapped = value if hasattr(value, "get_value") else Value(value)
            source = builder.AddSystem(ConstantValueSource(wrapped))
        builder.Connect(source.get_output_port(), overlay.GetInputPort(name))
    return Simulator(builder.Build())


def test_pool_is_set_at_the_start(meshcat):
    simulator(meshcat, max_obstacles=2).Initialize()
    for slot in (0, 1):
        for part in ("ellipsoid/shape", "section/shape"):
            assert meshcat.HasPath(f"{ROOT}/descriptor/{slot}/{part}")
        for part in ("direction/shaft", "direction/head"):
            assert meshcat.HasPath(f"{ROOT}/decision/{slot}/{part}")
    assert not meshcat.HasPath(f"{ROOT}/descriptor/2")
    for part in ("start", "goal", "path"):
        assert meshcat.HasPath(f"{ROOT}/motion/planned/{part}")
    assert not meshcat.HasPath(f"{ROOT}/perception/camera")


def test_layers_are_shown_that_are_asked_for(meshcat):
    simulator(meshcat, show=["motion"]).Initialize()
    shown = {
        layer: b"\xc3" in meshcat._GetPackedProperty(f"{ROOT}/{layer}", "visible")
        for layer in LAYERS
    }
    assert shown == {layer: layer == "motion" for layer in LAYERS}
    with pytest.raises(ValueError, match="show: 'moton' is not one of perception, descriptor"):
        MeshcatOverlay(meshcat, show=["moton"])


def test_executed_path_grows_by_a_segment_a_frame_while_moving(meshcat):
    sim = simulator(meshcat)
    sim.AdvanceTo(0.35)
    frames = [k for k in range(10) if meshcat.HasPath(f"{ROOT}/motion/executed/{k}")]
    assert frames == [1, 2, 3]


def test_executed_path_does_not_grow_at_rest(meshcat):
    sim = simulator(meshcat, policy=moving_policy(0.0))
    sim.AdvanceTo(0.35)
    assert not meshcat.HasPath(f"{ROOT}/motion/executed")


def test_executed_path_starts_anew_with_the_simulation(meshcat):
    sim = simulator(meshcat)
    sim.AdvanceTo(0.35)
    sim.get_mutable_context().SetTime(0.0)
    sim.Initialize()
    assert not meshcat.HasPath(f"{ROOT}/motion/executed")
    sim.AdvanceTo(0.15)
    assert meshcat.HasPath(f"{ROOT}/motion/executed/1")
    assert not meshcat.HasPath(f"{ROOT}/motion/executed/2")


def test_executed_path_is_that_of_the_body_when_connected(meshcat):
    bodies = Value[list[RigidTransform]]()
    bodies.set_value([RigidTransform(), RigidTransform([1.0, 2.0, 3.0])])
    sim = simulator(meshcat, more=[("body_poses", bodies)], body_index=BodyIndex(1))
    sim.AdvanceTo(0.35)
    assert not meshcat.HasPath(f"{ROOT}/motion/executed")
    assert meshcat._GetPackedTransform(f"{ROOT}/motion/tool_point")


def test_rings_are_drawn_once_while_costs_stay(meshcat):
    sim = simulator(meshcat, obstacles(3), sides(3))
    sim.AdvanceTo(0.55)
    frames = [k for k in range(10) if meshcat.HasPath(f"{ROOT}/decision/0/rings/{k}")]
    assert frames == [0]


def test_rings_are_drawn_anew_when_costs_change_visibly(meshcat):
    def route(time):
        return sides(3, cost=0.05 * time if time < 0.25 else 1.0)

    sim = simulator(meshcat, obstacles(3), route)
    sim.AdvanceTo(0.55)
    frames = [k for k in range(10) if meshcat.HasPath(f"{ROOT}/decision/0/rings/{k}")]
    assert frames == [0, 3]


def test_obstacle_keeps_its_place_when_another_one_goes(meshcat):
    sim = simulator(
        meshcat, lambda time: obstacles(1, 2) if time < 0.15 else obstacles(2), sides(2)
    )
    sim.AdvanceTo(0.35)
    place = f"{ROOT}/descriptor/1"
    assert b"\xc3" in meshcat._GetPackedProperty(place, "visible")
    assert b"\xc2" in meshcat._GetPackedProperty(f"{ROOT}/descriptor/0", "visible")


def test_only_the_policy_state_is_needed(meshcat):
    system = MeshcatOverlay(meshcat, period=PERIOD)
    sim = Simulator(system)
    system.GetInputPort("policy_state").FixValue(sim.get_mutable_context(), moving_policy(0.0))
    sim.AdvanceTo(0.25)
    assert meshcat.HasPath(f"{ROOT}/motion/planned/path")


def test_more_obstacles_than_places_are_left_out(meshcat):
    sim = simulator(meshcat, obstacles(1, 2, 3), sides(1, 2, 3), max_obstacles=2)
    sim.AdvanceTo(0.15)
    assert not meshcat.HasPath(f"{ROOT}/descriptor/2")


def test_route_for_other_obstacles_is_not_drawn(meshcat):
    sim = simulator(meshcat, obstacles(1), sides(9))
    sim.AdvanceTo(0.15)
    assert b"\xc2" in meshcat._GetPackedProperty(f"{ROOT}/decision/0/rings", "visible")


def cloud_value(points):
    cloud = PointCloud(len(points))
    cloud.mutable_xyzs()[:] = np.asarray(points, dtype=float).T
    return Value(cloud)


def test_each_cloud_is_an_object_of_its_own(meshcat):
    cloud = cloud_value([[0.1, 0.2, 0.3], [np.nan, 0, 0], [np.inf, 0, 0]])
    sim = simulator(meshcat, more=[("cloud", cloud)], cloud_period=0.2)
    sim.AdvanceTo(0.55)
    assert [k for k in range(10) if meshcat.HasPath(f"{ROOT}/perception/cloud/{k}")] == [0, 2, 4]


def test_colours_stay_with_their_points(meshcat):
    cloud = PointCloud(3, Fields(BaseField.kXYZs | BaseField.kRGBs))
    cloud.mutable_xyzs()[:] = np.array([[np.nan, 0, 0], [0, 0, 0.5], [0, 0.3, 0.2]]).T
    cloud.mutable_rgbs()[:] = np.array([[1, 1, 1], [2, 2, 2], [3, 3, 3]]).T
    thin = MeshcatOverlay(meshcat)._thinned(cloud, None)
    assert thin.xyzs()[2] == pytest.approx([0.5, 0.2])
    assert thin.rgbs()[0].tolist() == [2, 3]


def test_one_cloud_is_replaced_when_clouds_are_not_recorded(meshcat):
    sim = simulator(meshcat, more=[("cloud", cloud_value([[0, 0, 0.1]]))], record_clouds=False)
    sim.AdvanceTo(0.55)
    assert meshcat.HasPath(f"{ROOT}/perception/cloud/now")
    assert not meshcat.HasPath(f"{ROOT}/perception/cloud/0")


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.full((4, 3), np.nan)])
def test_an_empty_cloud_is_no_fault(meshcat, points):
    simulator(meshcat, more=[("cloud", cloud_value(points))]).AdvanceTo(0.25)
    assert meshcat.HasPath(f"{ROOT}/descriptor")


def test_frustum_needs_camera_and_pose(meshcat):
    seen = {"camera_pose": SeenRange(CameraInfo(width=640, height=480, fov_y=0.8))}
    simulator(meshcat, cameras=seen).Initialize()
    assert not meshcat.HasPath(f"{ROOT}/perception/camera")
    pose = Value(RigidTransform([1.0, 0.0, 1.0]))
    simulator(meshcat, cameras=seen, more=[("camera_pose", pose)]).Initialize()
    assert meshcat.HasPath(f"{ROOT}/perception/camera/frustum")


def test_each_camera_has_a_frustum(meshcat):
    info = CameraInfo(width=640, height=480, fov_y=0.8)
    seen = {"camera_pose_left": SeenRange(info), "camera_pose_right": SeenRange(info, 0.5, 2.0)}
    poses = [(name, Value(RigidTransform([x, 0.0, 1.0]))) for x, name in enumerate(seen)]
    simulator(meshcat, cameras=seen, more=poses).Initialize()
    assert meshcat.HasPath(f"{ROOT}/perception/camera/frustum")
    assert meshcat.HasPath(f"{ROOT}/perception/camera_2/frustum")


def test_recording_goes_into_one_page(meshcat):
    meshcat.StartRecording(1.0 / PERIOD)
    simulator(meshcat, obstacles(1), sides(1)).AdvanceTo(0.45)
    meshcat.StopRecording()
    before = len(meshcat.StaticHtml())
    meshcat.PublishRecording()
    assert len(meshcat.StaticHtml()) > before + 1000


def test_two_overlays_in_turn_draw_the_same(meshcat):
    """Nothing is kept on the system: one may serve several simulations."""
    sim = simulator(meshcat, obstacles(1), sides(1))
    system = sim.get_system()
    sim.AdvanceTo(0.35)
    other = Simulator(system)
    other.AdvanceTo(0.15)
    assert meshcat.HasPath(f"{ROOT}/motion/executed/1")
    assert not meshcat.HasPath(f"{ROOT}/motion/executed/3")


def test_wrong_type_on_a_port_is_named(meshcat):
    sim = simulator(meshcat, route=42)
    with pytest.raises(TypeError, match="route"):
        sim.Initialize()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"period": 0.0}, "period"),
        ({"cloud_period": float("nan")}, "cloud_period"),
        ({"max_obstacles": 0}, "max_obstacles"),
        ({"planned_W": np.zeros((3, 2))}, "planned_W"),
    ],
)
def test_argument_out_of_range_is_named(meshcat, options, message):
    with pytest.raises(ValueError, match=message):
        MeshcatOverlay(meshcat, **options)


def test_dressed_scene_hides_what_is_not_the_subject(meshcat):
    dress_scene(meshcat)
    for path in ("/Grid", "/Axes", "/drake/proximity"):
        assert b"\xc2" in meshcat._GetPackedProperty(path, "visible")


def test_the_scene_is_looked_at_from_the_base():
    hanging = RigidTransform(RollPitchYaw(np.pi, 0.0, np.pi / 2.0), [1.0, 2.0, 1.3])
    usual, there = Mock(), Mock()
    dress_scene(usual)
    dress_scene(there, hanging, 0.2)
    turned = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    points = (viewer.SetCameraPose.call_args.args for viewer in (usual, there))
    for p_FC, p_WC in zip(*points, strict=True):
        np.testing.assert_allclose(p_WC, turned @ p_FC + [1.0, 2.0, 0.2], atol=1e-12)
    assert usual.SetTransform.call_args.args[1].IsExactlyIdentity()
