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
)

Straight = Callable[[Scenes, Setting], Motions]
COUNT = 64
ALL = (*SUITES, *FIGURES, *SAMPLINGS)
BOXED = ("novel", "posed", "hit", "head-on")


@pytest.mark.parametrize("name", ALL)
def test_the_seed_decides(name: str) -> None:
    one, same, other = (draw_scenes(name, COUNT, seed=seed) for seed in (5, 5, 6))
    assert len(one) == COUNT
    check_scenes(one)
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
    assert a.min() >= 0.025
    assert a.max() <= 0.25
    assert (line_distance(scenes) < 0.15).all()
    assert (line_hits(scenes) == (line_distance(scenes) < 0.0)).all()
    for baseline in BASELINES:
        assert (scenes.baseline == baseline).sum() == 50


@pytest.mark.parametrize(("name", "aside"), [("demo", 0.4), ("narrow", 0.2), ("near", 0.4)])
def test_the_demo_leaves_every_obstacle_the_room_of_the_longest(name: str, aside: float) -> None:
    scenes = draw_scenes(name, 200)
    center, L = scenes.center[:, 0], scenes.baseline
    margin = np.where(L == 0.5, 0.25, 0.3)
    assert (center[:, 0] >= margin - 1e-12).all()
    assert (center[:, 0] <= L - margin + 1e-12).all()
    assert 0.7 * aside < np.abs(center[:, 1:]).max() <= aside
    assert (line_distance(scenes)[:, 0] < (0.1 if name == "near" else 0.15)).all()


def test_clutter_blocks_the_line_and_leaves_the_ends() -> None:
    scenes = draw_scenes("clutter", 50)
    assert scenes.center.shape == (50, 6, 3)
    assert (line_distance(scenes).min(axis=1) < 0.0).all()
    for x in (0.0, 1.0):
        point = np.tile((x, 0.0, 0.0), (50, 1))
        assert (scene_distance(scenes, point, np.zeros(50)) >= 0.05 - 1e-9).all()


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
    cases = find_suite("familiar").cases
    assert len({case.label for case in cases}) == 12
    asked = {case.of(scenes).clearance[0] for case in cases if case.setting.constrained}
    assert asked == set(FAMILIAR_CLEARANCES)
    assert sum(case.setting.scale_time for case in cases) == 6


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
