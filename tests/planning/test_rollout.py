"""Roll-outs of the whole arm, against SceneGraph along random motions."""

from dataclasses import replace

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import FloatArray
from drake_oa.planning.arm_world import (
    FAR,
    LINKS,
    TOOL,
    ArmWorld,
)
from drake_oa.planning.search import ArmRollouts, ToolPaths, roll_out_arm
from drake_oa.robot.arm import tool_poses
from tests.planning.arms import ArmAlone, Truth, box_at, random_things

SEEDS = st.integers(0, 2**32 - 1)
S = np.linspace(0.0, 1.0, 33)
MISSED = 2e-3


def swings(arm: ArmAlone, random: np.random.Generator, count: int) -> ToolPaths:
    """Smooth motions of the tool and of its orientation from where it is, and of the posture."""
    X_WE, ramp = arm.X_WE, S * S * (3.0 - 2.0 * S)
    bows = np.sin(np.pi * np.outer([1.0, 2.0], S))
    way = random.uniform(-0.3, 0.3, (count, 3))
    sway = random.uniform(-0.08, 0.08, (count, 2, 3))
    p_WE = X_WE[9:] + ramp[:, None] * way[:, None] + np.einsum("mt,nmk->ntk", bows, sway)
    turns = Rotation.from_rotvec(ramp[:, None] * random.uniform(-0.5, 0.5, 3))
    R_WE = turns.as_matrix() @ X_WE[:9].reshape(3, 3)
    held = np.tile(X_WE[:9], (len(S), 1))
    drawn = arm.q + ramp[:, None] * random.uniform(-0.4, 0.4, len(arm.q))
    return ToolPaths(
        S,
        p_WE,
        np.stack([held, R_WE.reshape(-1, 9)])[random.integers(2, size=count)],
        np.stack([np.tile(arm.q, (len(S), 1)), drawn])[random.integers(2, size=count)],
        random.uniform(2.0, 6.0, count),
    )


def row_of(paths: ToolPaths, i: int) -> ToolPaths:
    return ToolPaths(paths.s, *(of[i : i + 1] for of in paths[1:]))


def bare(arm: ArmAlone, things: list) -> ArmWorld:
    """In which nothing is asked, so that what is kept beyond it is the distance."""
    return arm.among([thing.solid() for thing in things], 0.0, 0.0, -5.0)


def same(one: ArmRollouts, other: ArmRollouts, rows: slice = slice(None)) -> None:
    for name in ("excess", "error", "hurry", "samples", "q"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name)[rows])


def between(q: FloatArray, parts: int) -> tuple[FloatArray, FloatArray]:
    """Normalised times (T,) and joints (T, n), some parts to each step."""
    s = np.linspace(0.0, 1.0, parts * (len(q) - 1) + 1)
    at = np.linspace(0.0, 1.0, len(q))
    return s, np.stack([np.interp(s, at, joint) for joint in q.T], axis=1)


@settings(max_examples=12)
@given(seed=SEEDS)
def test_it_keeps_what_scene_graph_says(panda_arm: ArmAlone, six_arm: ArmAlone, seed: int) -> None:
    random = np.random.default_rng(seed)
    for arm in (panda_arm, six_arm):
        things = random_things(random, 4, moving=2)
        world, paths, truth = bare(arm, things), swings(arm, random, 3), Truth(arm, things)
        found = roll_out_arm(world, arm.q, paths)
        assert (found.samples == len(S)).all()
        overshoot = arm.overshoot
        for i in range(3):
            dt = paths.seconds[i] / (len(S) - 1)
            at_samples = np.array([truth.least(q, dt * row) for row, q in enumerate(found.q[i])])
            for which in (TOOL, LINKS):
                true, spheres = at_samples[:, which].min(), found.excess[i, which]
                # The spheres enclose the arm; and by no more than they stick out. Of shapes that
                # meet SceneGraph tells how to part them, the spheres how deep one of them is.
                assert spheres <= max(min(true, FAR), 0.0) + 1e-4
                if true > 0.0:
                    assert spheres >= min(true, FAR) - overshoot - 1e-4
            # Between samples no more is lost than half the way that is gone from one to the next.
            s, q = between(found.q[i], 3)
            all_along = min(
                truth.least(*at).min() for at in zip(q, paths.seconds[i] * s, strict=True)
            )
            fastest = max(np.linalg.norm(thing.v_WO) for thing in things)
            step = np.abs(np.diff(found.q[i], axis=0)) @ arm.chain.reach + fastest * dt
            lost = at_samples.min() - all_along
            assert lost <= 0.5 * step.max() + 1e-4


@settings(max_examples=15)
@given(seed=SEEDS)
def test_the_joints_hold_the_tool_where_it_is_asked(
    panda_arm: ArmAlone, six_arm: ArmAlone, seed: int
) -> None:
    random = np.random.default_rng(seed)
    for arm in (panda_arm, six_arm):
        paths = swings(arm, random, 4)
        found = roll_out_arm(bare(arm, []), arm.q, paths)
        assert (found.q >= arm.chain.lower).all()
        assert (found.q <= arm.chain.upper).all()
        np.testing.assert_allclose(found.q[:, 0], np.tile(arm.q, (4, 1)), atol=1e-6)
        for i in range(4):
            X_WE = tool_poses(arm.chain, found.q[i])
            away = np.abs(X_WE[1:, 9:] - paths.p_WE[i, 1:]).max()
            R_WT = paths.R_WE[i].reshape(-1, 3, 3)
            R_WE = X_WE[:, :9].reshape(-1, 3, 3)
            turned = Rotation.from_matrix(R_WT @ R_WE.transpose(0, 2, 1)).as_rotvec()
            expected = max(away, np.abs(turned[1:]).max())
            assert found.error[i] == pytest.approx(expected, rel=0.02, abs=1e-9)
            dt = paths.seconds[i] * np.diff(S)[:, None]
            rate = np.abs(np.diff(found.q[i], axis=0)) / dt / arm.chain.speed
            assert found.hurry[i] == pytest.approx(rate.max(), rel=1e-9)
        # A way that is no farther than this is within reach.
        near = paths._replace(p_WE=arm.X_WE[9:] + 0.2 * (paths.p_WE - arm.X_WE[9:]))
        assert roll_out_arm(bare(arm, []), arm.q, near).error.max() < MISSED


@settings(max_examples=8)
@given(seed=SEEDS)
def test_many_are_as_each_alone_whatever_the_threads(panda_arm: ArmAlone, seed: int) -> None:
    random = np.random.default_rng(seed)
    world, paths = bare(panda_arm, random_things(random, 3, moving=1)), swings(panda_arm, random, 9)
    enough = np.where(random.random(9) < 0.5, 0.1, -np.inf)
    found = roll_out_arm(world, panda_arm.q, paths, enough)
    for i in range(9):
        same(roll_out_arm(world, panda_arm.q, row_of(paths, i), enough[i]), found, slice(i, i + 1))
    threads = numba.get_num_threads()
    try:
        for count in (1, min(2, threads)):
            numba.set_num_threads(count)
            same(roll_out_arm(world, panda_arm.q, paths, enough), found)
    finally:
        numba.set_num_threads(threads)


def test_what_keeps_too_little_is_not_followed(panda_arm: ArmAlone) -> None:
    paths = swings(panda_arm, np.random.default_rng(2), 1)
    at_end = box_at([0.1, 0.1, 0.1], paths.p_WE[0, -1])
    world = panda_arm.among([at_end], 0.0, 0.0, -5.0)
    whole = roll_out_arm(world, panda_arm.q, paths)
    part = roll_out_arm(world, panda_arm.q, paths, 0.02)
    assert whole.excess[0, TOOL] < 0.0
    assert part.least[0] < 0.02
    count = int(part.samples[0])
    assert count < whole.samples[0] == len(S)
    np.testing.assert_array_equal(part.q[0, :count], whole.q[0, :count])
    # It stays where it was left.
    np.testing.assert_array_equal(
        part.q[0, count:], np.tile(part.q[0, count - 1], (len(S) - count, 1))
    )


def test_a_motion_ends_where_it_has_arrived(panda_arm: ArmAlone) -> None:
    paths = swings(panda_arm, np.random.default_rng(4), 2)
    p_WE = paths.p_WE.copy()
    p_WE[0, 20:] = np.nan
    cut = paths._replace(p_WE=p_WE)
    world = bare(panda_arm, random_things(np.random.default_rng(4), 3))
    whole, found = (roll_out_arm(world, panda_arm.q, each) for each in (paths, cut))
    assert found.samples.tolist() == [20, len(S)]
    same(
        ArmRollouts(**{name: value[1:] for name, value in vars(found).items()}), whole, slice(1, 2)
    )
    assert (found.excess[0] >= whole.excess[0]).all()


def test_an_obstacle_is_where_it_will_be(panda_arm: ArmAlone) -> None:
    """The tool stands; a ball comes by and is gone before the end."""
    still = ToolPaths(
        S,
        np.tile(panda_arm.X_WE[9:], (1, len(S), 1)),
        np.tile(panda_arm.X_WE[:9], (1, len(S), 1)),
        np.tile(panda_arm.q, (1, len(S), 1)),
        np.full(1, 4.0),
    )
    (thing,) = random_things(np.random.default_rng(8), 1, moving=1)
    least = []
    for speed in (0.0, 0.25, 0.5):
        X_WO = np.eye(4)
        X_WO[:3, 3] = panda_arm.X_WE[9:] + [-0.5, 0.0, -0.15]
        moving = replace(thing, X_WO=X_WO, v_WO=np.array([speed, 0.0, 0.0]))
        truth = Truth(panda_arm, [moving])
        for now in (0.0, 2.0):
            world = bare(panda_arm, [moving])._replace(now=now)
            true = min(truth.least(panda_arm.q, now + 4.0 * s).min() for s in S)
            found = roll_out_arm(world, panda_arm.q, still).least[0]
            assert min(true, FAR) - panda_arm.overshoot <= found <= min(true, FAR) + 1e-4
            least.append(true)
    # It comes nearer; and what has gone by is not met any more.
    assert least[2] < least[0] - 0.05
    assert least[5] > least[4] + 0.05
