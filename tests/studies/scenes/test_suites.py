"""What each suite's scenes hold, checked by other means than sampling used."""

from collections.abc import Callable

import numpy as np
import pytest

from drake_oa.geometry.ellipsoid import shape_matrix
from drake_oa.studies.scenes.judge import judge
from drake_oa.studies.scenes.methods import Motions, Setting
from drake_oa.studies.scenes.scenes import DURATION, Scenes, check_scenes, scene_distance
from drake_oa.studies.scenes.suites import (
    BASELINES,
    FAMILIAR_CLEARANCES,
    FIGURES,
    SAMPLINGS,
    SUITES,
    draw_scenes,
    find_suite,
    line_distance,
    line_hits,
    random_rotations,
)

Straight = Callable[[Scenes, Setting], Motions]
COUNT = 64
ALL = (*SUITES, *FIGURES, *SAMPLINGS)
BOXED = ("novel", "posed", "hit", "head-on")


@pytest.mark.parametrize("name", ALL)
def test_scenes_are_valid_and_as_many_as_asked(name: str) -> None:
    scenes = draw_scenes(name, COUNT, seed=3)
    assert len(scenes) == COUNT
    check_scenes(scenes)
    assert scenes.present.all()


@pytest.mark.parametrize("name", ALL)
def test_the_seed_decides(name: str) -> None:
    one, same, other = (draw_scenes(name, COUNT, seed=seed) for seed in (5, 5, 6))
    assert (one.center == same.center).all()
    assert (one.semi_axes == same.semi_axes).all()
    drawn = name not in ("familiar", "dead-zone")
    assert drawn == (one.center != other.center).any()


@pytest.mark.parametrize("name", BOXED)
def test_obstacles_keep_to_the_papers_box(name: str) -> None:
    scenes = draw_scenes(name, 200)
    center, a = scenes.center[:, 0], scenes.semi_axes[:, 0]
    extent = np.sqrt(shape_matrix(scenes.R[:, 0], a)[:, 0, 0])
    assert (center[:, 0] - extent > 0.05 - 1e-9).all()
    assert (center[:, 0] + extent < scenes.baseline - 0.05 + 1e-9).all()
    assert (np.abs(center[:, 1:]) <= 0.4).all()
    assert (a >= 0.025).all()
    assert (a <= 0.25).all()
    assert (a[scenes.baseline == 0.5, 0] <= 0.2).all()
    assert (scenes.clearance == 0.15).all()
    assert (scenes.velocity == 0.0).all()
    for baseline in BASELINES:
        assert (scenes.baseline == baseline).sum() == 50
    aligned = (np.eye(3) == scenes.R).all()
    assert aligned == (name == "novel")


@pytest.mark.parametrize(("name", "aside"), [("demo", 0.4), ("narrow", 0.2), ("near", 0.4)])
def test_the_demo_leaves_every_obstacle_the_room_of_the_longest(name: str, aside: float) -> None:
    scenes = draw_scenes(name, 200)
    center, L = scenes.center[:, 0], scenes.baseline
    margin = np.where(L == 0.5, 0.25, 0.3)
    assert (center[:, 0] >= margin - 1e-12).all()
    assert (center[:, 0] <= L - margin + 1e-12).all()
    assert 0.7 * aside < np.abs(center[:, 1:]).max() <= aside
    assert (line_distance(scenes)[:, 0] < (0.1 if name == "near" else 0.15)).all()


@pytest.mark.parametrize(("name", "limit"), [("novel", 0.15), ("posed", 0.15), ("hit", 0.0)])
def test_the_straight_line_comes_near(name: str, limit: float, straight: Straight) -> None:
    scenes = draw_scenes(name, 200)
    judged = judge(scenes, straight(scenes, Setting()))
    assert (judged.kept_clearance < limit + 1e-6).all()
    if name != "hit":
        assert (judged.kept_clearance > 0.1).any()
        assert judged.collided.any()


def test_head_on_is_half_on_the_line_and_half_near_it() -> None:
    scenes = draw_scenes("head-on", 400)
    off = np.linalg.norm(scenes.center[:, 0, 1:], axis=1)
    assert (off == 0.0).sum() == 200
    assert off.max() <= 0.01
    for baseline in BASELINES:
        assert (off[scenes.baseline == baseline] == 0.0).sum() == 50


def test_clutter_blocks_the_line_and_leaves_the_ends() -> None:
    scenes = draw_scenes("clutter", 50)
    assert scenes.center.shape == (50, 6, 3)
    assert (line_distance(scenes).min(axis=1) < 0.0).all()
    for x in (0.0, 1.0):
        point = np.tile((x, 0.0, 0.0), (50, 1))
        assert (scene_distance(scenes, point, np.zeros(50)) >= 0.05 - 1e-9).all()
    assert scenes.semi_axes.min() >= 0.025
    assert scenes.semi_axes.max() <= 0.1


def test_moving_obstacles_meet_the_robot_on_its_way(straight: Straight) -> None:
    scenes = draw_scenes("moving", 200)
    speed = np.linalg.norm(scenes.velocity[:, 0], axis=1)
    assert speed.min() >= 0.1
    assert speed.max() <= 0.4
    assert judge(scenes, straight(scenes, Setting())).collided.all()
    start, goal = np.zeros((200, 3)), scenes.goal
    for share in np.linspace(0.0, 1.0, 21):
        early = np.full(200, 0.25 * DURATION * share)
        late = np.full(200, DURATION * (0.75 + 1.25 * share))
        assert (scene_distance(scenes, start, early) >= 0.05 - 1e-9).all()
        assert (scene_distance(scenes, goal, late) >= 0.05 - 1e-9).all()


def test_familiar_is_the_lattice_in_twelve_settings() -> None:
    scenes = draw_scenes("familiar")
    assert len(scenes) == 100
    assert len(np.unique(scenes.semi_axes[:, 0, :2], axis=0)) == 100
    assert np.unique(scenes.semi_axes).tolist() == np.linspace(0.025, 0.25, 10).tolist()
    assert (scenes.semi_axes[..., 1] == scenes.semi_axes[..., 2]).all()
    cases = find_suite("familiar").cases
    assert len({case.label for case in cases}) == 12
    asked = {case.of(scenes).clearance[0] for case in cases if case.setting.constrained}
    assert asked == set(FAMILIAR_CLEARANCES)
    assert sum(case.setting.scale_time for case in cases) == 6


@pytest.mark.parametrize("name", ["novel", "posed", "clutter"])
def test_the_line_hits_where_its_distance_is_negative(name: str) -> None:
    scenes = draw_scenes(name, 200)
    hits = line_hits(scenes)
    assert (hits == (line_distance(scenes) < 0.0)).all()
    assert 0 < hits.sum() < hits.size


def test_dead_zone_begins_on_the_line() -> None:
    scenes = draw_scenes("dead-zone")
    assert scenes.center[0, 0].tolist() == [0.5, 0.0, 0.0]
    assert (np.diff(scenes.center[:, 0, 1]) > 0.0).all()


def test_rotations_are_uniform() -> None:
    R = random_rotations(np.random.default_rng(0), 20_000)
    assert np.allclose(R @ np.swapaxes(R, 1, 2), np.eye(3))
    assert np.allclose(np.linalg.det(R), 1.0)
    # Each entry of a uniformly random rotation has mean 0 and variance 1/3.
    assert np.abs(R.mean(axis=0)).max() < 0.02
    assert np.abs(R.var(axis=0) - 1.0 / 3.0).max() < 0.02
    assert abs(np.trace(R, axis1=1, axis2=2).mean()) < 0.03


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("nowhere",), "unknown suite 'nowhere'; valid: novel, posed"),
        (("novel", 0), "at least 1"),
        (("novel", 5, -1), "seed must be at least 0"),
        (("familiar", 10), "square"),
    ],
)
def test_bad_requests_are_refused(arguments: tuple, named: str) -> None:
    with pytest.raises(ValueError, match=named):
        draw_scenes(*arguments)
    if len(arguments) == 1:
        with pytest.raises(ValueError, match=named):
            find_suite(*arguments)
