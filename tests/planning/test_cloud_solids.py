"""Solids of what perception sees: kept while nothing new is seen, and else made anew."""

import logging
from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RotationMatrix

from drake_oa.common.messages import ObstacleClouds, TablePlane
from drake_oa.geometry.pinhole import View
from drake_oa.geometry.solids import Solids, solid_distance
from drake_oa.perception.depth_perception import FreeSpace
from drake_oa.perception.visibility import ImageRange, with_unseen_ends
from drake_oa.planning import cloud_solids
from drake_oa.planning.cloud_solids import (
    CloudSolids,
    SeenSolids,
    looked_at,
    names_moved,
    seen_free,
    unseen,
)
from tests.reference.depth_images import SIZE, K, look_at, ray_cast

CAMERA = np.array([1.2, 0.0, 0.8])
HALF = np.array([0.04, 0.1, 0.1])
CENTER = np.array([0.4, 0.0, 0.1])
VOXEL = 0.01
RNG = np.random.default_rng(5)
TABLE = TablePlane(offset=0.0)


def box(half=HALF, center=CENTER, spacing=0.004, noise=0.0):
    """Front and top (N, 3) of a box, as a camera ahead and above sees them."""
    x, y, z = (np.arange(-h, h + 1e-9, spacing) for h in half)
    front = np.stack(np.meshgrid([half[0]], y, z), -1).reshape(-1, 3)
    top = np.stack(np.meshgrid(x, y, [half[2]]), -1).reshape(-1, 3)
    points = np.concatenate([front, top]) + center
    return points + noise * RNG.normal(size=points.shape)


def seen(*clouds, stamp=1.0, table=TABLE, ids=None, v_WO=()):
    names = np.arange(len(clouds)) if ids is None else np.array(ids)
    return ObstacleClouds(stamp, clouds, names, table, v_WO=np.array(v_WO).reshape(-1, 3))


def distance(solids: Solids, row: int, point, time=0.0):
    return solid_distance(solids, row, *map(float, point), time)


def true_distance(points):
    """Of points (N, 3) outside the box."""
    return np.linalg.norm(np.maximum(np.abs(points - CENTER) - HALF, 0.0), axis=1)


def test_a_seen_box_is_a_solid_with_its_far_side():
    scene = looked_at(SeenSolids(), seen(box()), CAMERA[None]).scene
    assert scene.labels == ("obstacle 0", "the table")
    assert scene.stamp == 1.0
    assert not scene.moves
    points = CENTER + RNG.uniform(-0.3, 0.3, (1000, 3))
    points = points[(np.abs(points - CENTER) > HALF).any(axis=1)]
    error = np.array([distance(scene.solids, 0, p) for p in points]) - true_distance(points)
    # Never too far by more than a voxel, its hidden sides included, and rarely much too near.
    assert error.max() <= VOXEL
    assert np.median(np.abs(error)) <= VOXEL
    assert distance(scene.solids, 0, CENTER) < -0.02
    assert distance(scene.solids, 1, [0.0, 0.0, 0.3]) == pytest.approx(0.3)


def test_noise_leaves_the_arrays_as_they_are():
    first = looked_at(SeenSolids(), seen(box(noise=0.0012)), CAMERA[None])
    now = first
    for frame in range(2, 12):
        table = replace(TABLE, offset=1e-3 * RNG.uniform(-1.0, 1.0))
        cloud = RNG.permutation(box(noise=0.0012))[100:]
        now = looked_at(now, seen(cloud, stamp=float(frame), table=table), CAMERA[None])
        assert now.scene.solids is first.scene.solids
        assert now.scene.same_as(first.scene)
    assert now.scene.stamp == 11.0


def test_what_grows_or_goes_is_made_anew():
    first = looked_at(SeenSolids(), seen(box()), CAMERA[None])
    stick = CENTER + np.stack([np.zeros(9), np.zeros(9), np.linspace(0.1, 0.14, 9)], axis=1)
    grown = looked_at(first, seen(np.concatenate([box(), stick])), CAMERA[None])
    assert not grown.scene.same_as(first.scene)
    assert distance(grown.scene.solids, 0, stick[-1]) <= VOXEL
    short = np.array([0.04, 0.1, 0.08])
    less = looked_at(first, seen(box(short, CENTER - [0.0, 0.0, 0.02])), CAMERA[None])
    assert distance(less.scene.solids, 0, CENTER + [0.0, 0.0, 0.15]) > 0.06
    gone = looked_at(first, seen(), CAMERA[None])
    assert gone.scene.labels == ("the table",)


def test_another_view_fills_another_side():
    first = looked_at(SeenSolids(), seen(box()), CAMERA[None])
    assert looked_at(first, seen(box()), CAMERA[None] + 0.01).scene.solids is first.scene.solids
    turned = looked_at(first, seen(box()), np.array([[0.4, 1.2, 0.8]]))
    assert not turned.scene.same_as(first.scene)


def test_what_moves_keeps_its_field(monkeypatch):
    made, original = [], cloud_solids.field_of
    monkeypatch.setattr(
        cloud_solids, "field_of", lambda *args, **more: made.append(1) or original(*args, **more)
    )
    v_WO, far = np.array([0.0, 0.15, 0.0]), CENTER + [0.0, 0.2, 0.0]
    now = looked_at(SeenSolids(), seen(box(), v_WO=[v_WO]), CAMERA[None])
    assert now.scene.moves
    at_once = distance(now.scene.solids, 0, far, 1.0)
    assert distance(now.scene.solids, 0, far + 0.1 * v_WO, 1.1) == pytest.approx(at_once)
    # The same points shifted, and others where they are expected.
    for frame, noise in enumerate((0.0, 0.0, 0.001, 0.0), start=1):
        time = 1.0 + frame / 15.0
        moved = box(center=CENTER + (time - 1.0) * v_WO, noise=noise)
        now = looked_at(now, seen(moved, stamp=time, v_WO=[v_WO]), CAMERA[None])
        there = distance(now.scene.solids, 0, far + (time - 1.0) * v_WO, time)
        assert there == pytest.approx(at_once, abs=1e-6)
    assert len(made) == 1
    # It rests again: still deep, as it has moved.
    rests = looked_at(now, seen(moved, stamp=2.0, v_WO=[[0.0, 0.0, 0.0]]), CAMERA[None])
    assert not rests.scene.moves
    assert len(made) == 1
    assert rests.moved == {0}
    # Where it was not expected it is made anew.
    elsewhere = looked_at(
        rests, seen(box(center=CENTER + [0.0, 0.1, 0.0])[::2], stamp=3.0), CAMERA[None]
    )
    assert len(made) == 2
    assert distance(elsewhere.scene.solids, 0, CENTER + [0.0, 0.1, 0.2]) < 0.11


def test_what_has_moved_is_deeper():
    broad = box(np.array([0.005, 0.15, 0.1]))
    behind = CENTER - [0.12, 0.0, 0.0]
    resting = looked_at(SeenSolids(), seen(broad), CAMERA[None])
    moving = looked_at(resting, seen(broad, v_WO=[[0.1, 0.0, 0.0]]), CAMERA[None])
    assert distance(resting.scene.solids, 0, behind) > 0.02
    assert distance(moving.scene.solids, 0, behind, 1.0) < 0.0


@pytest.mark.parametrize("bad", ["cloud", "velocity", "far", "viewpoint"])
def test_what_is_not_finite_changes_nothing(bad):
    first = looked_at(SeenSolids(), seen(box(), v_WO=[[0.1, 0.0, 0.0]]), CAMERA[None])
    cloud, v_WO, viewpoint = box(), np.zeros((1, 3)), CAMERA[None].copy()
    if bad == "velocity":
        v_WO[0, 1] = np.inf
    elif bad == "viewpoint":
        viewpoint[0, 2] = np.nan
    else:
        cloud[3, 1] = np.nan if bad == "cloud" else 1e7
    now = looked_at(first, seen(cloud, stamp=2.0, v_WO=v_WO), viewpoint)
    assert (now.scene.solids is first.scene.solids, now.scene.stamp) == (True, 1.0)
    assert now.note == now.scene.note != ""
    assert not looked_at(now, seen(box(), stamp=3.0), CAMERA[None]).note


def test_what_comes_late_or_sees_no_table_leaves_what_was_seen():
    first = looked_at(SeenSolids(), seen(box()), CAMERA[None])
    late = looked_at(first, seen(stamp=0.5), CAMERA[None])
    assert late.scene is first.scene
    after = looked_at(first, seen(box(), stamp=2.0, table=None), CAMERA[None])
    assert after.scene.labels == ("obstacle 0", "the table")


def test_a_table_that_is_told_of_counts_from_the_start():
    before = unseen(TABLE)
    assert (before.scene.stamp, before.scene.labels) == (-np.inf, ("the table",))
    after = looked_at(before, seen(stamp=1.0, table=None))
    assert (after.scene.stamp, after.scene.labels) == (1.0, ("the table",))
    assert distance(after.scene.solids, 0, [0.0, 0.0, 0.3]) == pytest.approx(0.3)
    note = looked_at(unseen(), replace(ObstacleClouds(), note="no valid pixel"))
    assert (note.scene.stamp, note.scene.note) == (-np.inf, "no valid pixel")


def system(obstacles):
    made = CloudSolids(period=0.1)
    context = made.CreateDefaultContext()
    made.GetInputPort("obstacles_W").FixValue(context, AbstractValue.Make(obstacles))
    return made, context


def updated(made, context, obstacles, time):
    context.SetTime(time)
    made.GetInputPort("obstacles_W").FixValue(context, AbstractValue.Make(obstacles))
    made.ExecuteInitializationEvents(context)
    return made.GetOutputPort("solids_W").Eval(context)


def test_the_system_keeps_what_it_knows_and_logs_what_is_bad(caplog):
    made, context = system(ObstacleClouds())
    made.GetInputPort("camera_pose").FixValue(context, AbstractValue.Make(RigidTransform(CAMERA)))
    assert updated(made, context, ObstacleClouds(), 0.0).stamp == -np.inf
    one = updated(made, context, seen(box(), np.zeros((0, 3)), ids=[3, 4]), 0.1)
    assert one.labels == ("obstacle 3", "the table")
    two = updated(made, context, seen(box(noise=1e-3), stamp=1.1, ids=[3]), 0.2)
    assert two.solids is one.solids
    bad = box()
    bad[0] = np.nan
    with caplog.at_level(logging.INFO, "drake_oa"):
        for frame in (3, 4):
            assert updated(made, context, seen(bad, stamp=1.2), 0.1 * frame).stamp == 1.1
        assert updated(made, context, seen(stamp=1.3), 0.5).labels == ("the table",)
    assert [record.levelname for record in caplog.records] == ["WARNING", "INFO"]


def test_coarser_voxels_are_told_once(caplog):
    large = RNG.uniform(-1.5, 1.5, (2000, 3))
    made, context = system(ObstacleClouds())
    with caplog.at_level(logging.INFO, "drake_oa"):
        for frame in range(3):
            moved = large + [0.0, 0.1 * frame, 0.0]
            updated(made, context, seen(moved, stamp=float(frame), table=None), 0.1 * frame)
    assert [record.getMessage() for record in caplog.records] == [caplog.records[0].getMessage()]
    assert "obstacle 0: voxels of" in caplog.text


def post(height):
    """The front of a post, 4 cm broad, as high as that."""
    y, z = np.meshgrid(np.arange(-0.02, 0.021, 0.005), np.arange(0.0, height, 0.005))
    return np.stack([np.full(y.size, 0.5), y.ravel(), z.ravel()], axis=1)


@pytest.mark.parametrize("cut", ["top", "near"])
def test_what_the_image_cuts_off_goes_on_beyond_it(cut):
    # It looks along -x, and down by 45 degrees.
    down = np.array([-1.0, 0.0, -1.0]) / np.sqrt(2.0)
    across = np.array([0.0, 1.0, 0.0])
    X_WC = np.eye(4)
    X_WC[:3, :3] = np.column_stack([across, np.cross(down, across), down])
    X_WC[:3, 3] = [1.0, 0.0, 1.0]
    wide = ImageRange(500.0, 1000.0, 2000)
    whole = seen(post(0.4))
    assert with_unseen_ends(whole, [(X_WC, wide)]) is whole
    last = (post(0.4)[-1] - X_WC[:3, 3]) @ X_WC[:3, :3]
    if cut == "near":
        image = wide._replace(near=last[2] - 0.005)
    else:
        v = 500.0 * (last[1] / last[2]) + 1000.0 - 2.0
        image = wide._replace(cy=1000.0 - v, height=int(2000.0 - v))
    (longer,) = with_unseen_ends(whole, [(X_WC, image)]).clouds_W
    np.testing.assert_array_equal(longer[: len(post(0.4))], post(0.4))
    np.testing.assert_allclose(longer.max(axis=0), [0.5, 0.02, 0.79], atol=0.02)
    assert longer[:, 2].min() == 0.0
    bad = post(0.4)
    bad[0] = np.nan
    assert with_unseen_ends(seen(bad), [(X_WC, image)]).clouds_W[0] is bad


def test_what_has_moved_is_told_until_it_is_gone():
    def seen(*velocities):
        clouds = tuple(np.zeros((1, 3)) for _ in velocities)
        v_WO = np.array(velocities, dtype=float).reshape(-1, 3)
        ids = np.arange(len(velocities))
        return ObstacleClouds(stamp=0.0, clouds_W=clouds, ids=ids, v_WO=v_WO)

    moved = names_moved(seen((-0.2, 0.0, 0.0), (0.0,) * 3), frozenset())
    assert moved == {0}
    assert names_moved(seen((0.0,) * 3, (0.0,) * 3), moved) == {0}
    # Its name may be given again.
    assert names_moved(seen(), moved) == frozenset()
    assert names_moved(seen((np.nan, 0.0, 0.0)), frozenset()) == frozenset()


OTHER = np.array([-0.4, 0.0, 0.8])
"""A second camera, on the other side."""


def whole(half=HALF, center=CENTER, spacing=0.004):
    """All sides of a box that two cameras see, (N, 3)."""
    x, y, z = (np.arange(-h, h + 1e-9, spacing) for h in half)
    walls = [np.stack(np.meshgrid([s * half[0]], y, z), -1).reshape(-1, 3) for s in (-1, 1)]
    top = np.stack(np.meshgrid(x, y, [half[2]]), -1).reshape(-1, 3)
    return np.concatenate([*walls, top]) + center


def image(eye, *boxes):
    """Of boxes (low, high) on a table, from a place that looks at their middle."""
    X_WC = look_at(eye, [0.4, 0.0, 0.1])
    return View(ray_cast(X_WC, boxes), K, X_WC)


# 1 cm thin, 20 cm broad: from one camera it may be 8 cm deep.
THIN = np.array([0.005, 0.1, 0.1])
BOARD = CENTER - THIN, CENTER + THIN
BEHIND = CENTER - [0.05, 0.0, 0.0]


def test_what_another_camera_sees_through_is_not_filled():
    alone = looked_at(SeenSolids(), seen(box(THIN)), CAMERA[None])
    assert distance(alone.scene.solids, 0, BEHIND) < 0.0
    eyes, views = np.stack([CAMERA, OTHER]), [image(eye, BOARD) for eye in (CAMERA, OTHER)]
    both = looked_at(SeenSolids(), seen(whole(THIN)), eyes, views)
    assert distance(both.scene.solids, 0, BEHIND) > 0.02
    assert distance(both.scene.solids, 0, CENTER) <= 0.0
    # As large as it is; just over the table, which is seen there too, no image tells.
    points = CENTER + RNG.uniform([-0.2, -0.2, 0.0], 0.2, (500, 3))
    true = np.linalg.norm(np.maximum(np.abs(points - CENTER) - THIN, 0.0), axis=1)
    points, true = points[true > 0.0], true[true > 0.0]
    error, before = (
        np.array([distance(found.scene.solids, 0, p) for p in points]) - true
        for found in (both, alone)
    )
    assert error.max() <= VOXEL
    assert error.min() >= -4.0 * VOXEL
    assert np.quantile(error, 0.05) >= -2.0 * VOXEL
    assert before.min() < -7.0 * VOXEL


def test_what_is_hidden_from_all_cameras_is_filled():
    # Something stands before the second camera.
    post = np.array([0.1, -0.3, 0.0]), np.array([0.14, 0.3, 0.5])
    views = [image(CAMERA, BOARD, post), image(OTHER, BOARD, post)]
    found = looked_at(SeenSolids(), seen(box(THIN)), np.stack([CAMERA, OTHER]), views)
    assert distance(found.scene.solids, 0, BEHIND) < 0.0
    # It is gone: now the other one sees that nothing is there.
    views = [image(CAMERA, BOARD), image(OTHER, BOARD)]
    after = looked_at(found, seen(box(THIN), stamp=1.1), np.stack([CAMERA, OTHER]), views)
    assert distance(after.scene.solids, 0, BEHIND) > 0.02
    # And that is known from then on, though it comes again.
    views = [image(CAMERA, BOARD, post), image(OTHER, BOARD, post)]
    last = looked_at(after, seen(box(THIN), stamp=1.2), np.stack([CAMERA, OTHER]), views)
    assert last.scene.solids is after.scene.solids


def test_what_one_image_cuts_off_ends_where_another_sees_through():
    X_WC = image(CAMERA).X_WC
    last = (post(0.2)[-1] - X_WC[:3, 3]) @ X_WC[:3, :3]
    near = ImageRange(K[0], K[3], SIZE[0], near=float(last[2]) - 0.005)
    cut = seen(post(0.2))
    (longer,) = with_unseen_ends(cut, [(X_WC, near)]).clouds_W
    assert len(longer) > len(post(0.2))
    views = [image(OTHER)]
    assert with_unseen_ends(cut, [(X_WC, near)], lambda p: seen_free(views, p)) is cut


def test_the_system_reads_what_several_cameras_see():
    ranges = {f"camera_pose_{name}": ImageRange(K[0], K[3], SIZE[0]) for name in ("a", "b")}
    made = CloudSolids(period=0.1, cameras=ranges)
    context = made.CreateDefaultContext()
    views = [image(eye, BOARD) for eye in (CAMERA, OTHER)]
    for name, view in zip(ranges, views, strict=True):
        pose = AbstractValue.Make(
            RigidTransform(RotationMatrix(view.X_WC[:3, :3]), view.X_WC[:3, 3])
        )
        made.GetInputPort(name).FixValue(context, pose)

    def show(*images, stamp):
        made.GetInputPort("free_space_W").FixValue(
            context, AbstractValue.Make(FreeSpace(images, stamp))
        )

    # Those of another time tell nothing, as what moves is elsewhere in them.
    show(*views, stamp=1.2)
    open_ = updated(made, context, seen(box(THIN)), 0.0)
    assert distance(open_.solids, 0, BEHIND) < 0.0
    show(*views, stamp=1.3)
    scene = updated(made, context, seen(box(THIN), stamp=1.3), 0.1)
    assert distance(scene.solids, 0, BEHIND) > 0.02
    show(views[0], None, stamp=1.4)
    assert updated(made, context, seen(box(THIN), stamp=1.4), 0.2).solids is scene.solids
