"""What the supervisor demands and decides."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import Evasion, FloatArray, ObstacleClouds, TablePlane
from drake_oa.geometry.points import GuardShapes, ObstaclePoints
from drake_oa.geometry.primitives import RobotShapes, point_distance
from drake_oa.safety.approach_kernels import allowed_scale
from drake_oa.safety.config import SupervisorSettings
from drake_oa.safety.monitors import (
    JointRange,
    braking_rules,
    watch_clearance,
    watch_evasion,
    watch_joints,
    watch_observation,
    watch_torque,
    watch_tracking,
)
from drake_oa.safety.supervision import (
    NO_DEMAND,
    Demand,
    SupervisorState,
    broken,
    decide,
)

PARAMETERS = SupervisorSettings()
STEP = 0.008
SIZES = {
    "sphere": [0.0, 0.0, 0.0, 0.1, 0.0],
    "capsule": [0.0, 0.0, 0.2, 0.05, 0.0],
    "box": [0.1, 0.2, 0.05, 0.0, 0.0],
    "rounded box": [0.1, 0.2, 0.05, 0.03, 0.0],
    "cylinder": [0.08, 0.0, 0.15, 0.0, 1.0],
}
coordinate = st.floats(-0.5, 0.5)


def pose(p: FloatArray, rotation: Rotation | None = None) -> FloatArray:
    X = np.eye(4)
    X[:3, 3] = p
    X[:3, :3] = (rotation or Rotation.identity()).as_matrix()
    return X


def one_sphere(radius: float = 0.1) -> GuardShapes:
    shapes = RobotShapes(
        np.zeros(1, dtype=np.int64), np.eye(4)[None], np.zeros((1, 3)), np.array([radius])
    )
    return GuardShapes.of(shapes, 1)


def seen(*clouds: FloatArray, stamp: float = 0.0, **more: object) -> ObstacleClouds:
    return ObstacleClouds(stamp, tuple(clouds), np.arange(len(clouds)) + 7, **more)


def clearance(
    x: float,
    speed: float,
    *,
    obstacles: ObstacleClouds | None = None,
    table: TablePlane | None = None,
    time: float = 0.0,
    parameters: SupervisorSettings = PARAMETERS,
) -> Demand:
    """Of a sphere of 0.1 m at (x, 0, 0) that moves along x, near a point at the origin."""
    return watch_clearance(
        ("ball",),
        pose(np.array([x, 0.0, 0.0]))[None],
        np.array([[0.0, 0.0, 0.0, speed, 0.0, 0.0]]),
        one_sphere(),
        ObstaclePoints.of(seen(np.zeros((1, 3))) if obstacles is None else obstacles),
        table,
        time,
        parameters,
    )


# Distances.


@pytest.mark.parametrize("kind", SIZES)
@given(x=coordinate, y=coordinate, z=coordinate)
@settings(max_examples=40)
def test_the_direction_leads_to_the_surface(kind: str, x: float, y: float, z: float) -> None:
    size = np.array(SIZES[kind])
    d, *n = point_distance(x, y, z, size)
    assert math.hypot(*n) == pytest.approx(1.0)
    foot = np.array([x, y, z]) - d * np.array(n)
    on_surface, *_ = point_distance(*foot, size)
    assert on_surface == pytest.approx(0.0, abs=1e-9)


@given(seed=st.integers(0, 10_000), moving=st.booleans())
@settings(max_examples=12)
def test_no_pair_is_missed(seed: int, moving: bool) -> None:
    rng = np.random.default_rng(seed)
    shapes = GuardShapes.of(
        RobotShapes(
            np.array([0, 1, 1]),
            np.stack([pose(p, Rotation.random(random_state=rng)) for p in rng.normal(size=(3, 3))]),
            rng.uniform(0.0, 0.1, (3, 3)),
            rng.uniform(0.01, 0.1, 3),
            np.array([0]),
            pose(rng.normal(size=3))[None],
            np.array([[0.08, 0.15]]),
        ),
        2,
    )
    X_WB = np.stack([pose(p, Rotation.random(random_state=rng)) for p in rng.normal(size=(2, 3))])
    V_WB = rng.normal(size=(2, 6)) * 0.3
    clouds = [rng.normal(size=(count, 3)) for count in (50, 0, 200)]
    v_WO = rng.normal(size=(3, 3)) * 0.3 * moving
    points = ObstaclePoints.of(seen(*clouds, v_WO=v_WO))
    found = watch_clearance(("a", "b"), X_WB, V_WB, shapes, points, TablePlane(), 0.1, PARAMETERS)
    least = 1.0
    for row, body in enumerate(shapes.shape_body):
        X = X_WB[body] @ shapes.X_BG[row]
        for cloud, v in zip(clouds, v_WO, strict=True):
            for p in cloud + 0.1 * v:
                local = X[:3, :3].T @ (p - X[:3, 3])
                d, *n = point_distance(*local, shapes.size[row])
                n_W = X[:3, :3] @ n
                foot = p - d * n_W
                arm = foot - X_WB[body, :3, 3]
                closing = n_W @ (V_WB[body, 3:] + np.cross(V_WB[body, :3], arm))
                oncoming = max(0.0, -n_W @ v)
                scale = allowed_scale(
                    d - PARAMETERS.padding, closing, oncoming, braking_rules(PARAMETERS)
                )
                least = min(least, scale)
    without_table = watch_clearance(("a", "b"), X_WB, V_WB, shapes, points, None, 0.1, PARAMETERS)
    assert without_table.scale == pytest.approx(least, abs=1e-12)
    assert found.scale <= without_table.scale


@given(seed=st.integers(0, 10_000), spread=st.sampled_from([0.01, 0.3, 100.0]))
@settings(max_examples=30)
def test_blocks_hold_every_point_once(seed: int, spread: float) -> None:
    rng = np.random.default_rng(seed)
    clouds = [rng.normal(size=(count, 3)) * spread for count in (7, 0, 300, 1)]
    grouped = ObstaclePoints.of(seen(*clouds))
    assert grouped.start[-1] == len(grouped.points) == 308
    assert (np.diff(grouped.start) > 0).all()
    for row, cloud in enumerate(clouds):
        mine = np.repeat(grouped.owner, np.diff(grouped.start)) == row
        np.testing.assert_array_equal(
            np.unique(grouped.points[mine], axis=0), np.unique(cloud, axis=0)
        )
    for block, (begin, end) in enumerate(zip(grouped.start, grouped.start[1:], strict=False)):
        away = np.linalg.norm(grouped.points[begin:end] - grouped.sphere[block, :3], axis=1)
        assert away.max() <= grouped.sphere[block, 3] + 1e-12


# Watches.


def test_an_approach_is_slowed_by_what_is_left() -> None:
    assert clearance(-1.0, 0.5).scale == 1.0
    near = clearance(-0.2, 0.5)
    left = 0.2 - 0.1 - PARAMETERS.padding - PARAMETERS.stop_distance
    assert near.scale == pytest.approx(left / PARAMETERS.reaction_time / 0.5)
    assert (near.link, near.obstacle, near.lasting) == ("ball", 7, True)
    assert near.reason == "ball within 0.095 m of obstacle 7"
    assert clearance(-0.12, 0.5).scale == 0.0


def test_leaving_is_free_and_slow_only_when_too_near() -> None:
    assert clearance(-0.2, -0.5).scale == 1.0
    assert clearance(-0.12, -0.5).scale == PARAMETERS.leave_scale
    # In contact, too; and what does not move is not limited.
    assert clearance(-0.05, -0.5).scale == PARAMETERS.leave_scale
    assert clearance(-0.05, 0.0).scale == 1.0


def test_an_approaching_obstacle_counts_with_its_speed_and_the_age_of_the_frame() -> None:
    point, away = np.zeros((1, 3)), np.array([[0.3, 0.0, 0.0]])
    resting = clearance(-0.22, 0.5)
    coming = clearance(-0.22, 0.5, obstacles=seen(point, v_WO=-away))
    assert coming.scale < resting.scale
    assert not coming.lasting
    # What recedes counts as resting; after a while it is gone.
    assert clearance(-0.22, 0.5, obstacles=seen(point, v_WO=away)).scale == resting.scale
    assert clearance(-0.22, 0.5, obstacles=seen(point, v_WO=away), time=0.4).scale > resting.scale


def test_what_moves_does_not_last_and_may_be_left_at_full_speed() -> None:
    for v, lasting in (([0.0, 0.3, 0.0], False), ([0.0, 0.0, 0.0], True)):
        obstacles = seen(np.zeros((1, 3)), v_WO=np.array([v]))
        assert clearance(0.15, -0.4, obstacles=obstacles).lasting == lasting
    coming = seen(np.zeros((1, 3)), v_WO=np.array([[0.2, 0.0, 0.0]]))
    assert clearance(0.11, 0.4, obstacles=coming) is NO_DEMAND
    assert clearance(0.11, 0.4).scale == PARAMETERS.leave_scale


def test_what_rests_is_left_when_what_moves_is_taken_out() -> None:
    clouds = [np.full((3, 3), 0.1), np.full((2, 3), 5.0), np.full((4, 3), -0.3)]
    both = ObstaclePoints.of(
        seen(*clouds, v_WO=np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    )
    rests = both.resting()
    assert rests.resting() is not None
    np.testing.assert_array_equal(rests.ids, both.ids)
    np.testing.assert_array_equal(np.unique(rests.owner), [0, 2])
    np.testing.assert_array_equal(rests.points, np.concatenate([clouds[0], clouds[2]]))
    assert rests.start[-1] == len(rests.points)
    still = ObstaclePoints.of(seen(*clouds))
    assert still.resting() is still
    moving = ObstaclePoints.of(seen(clouds[0], v_WO=np.array([[0.1, 0.0, 0.0]]))).resting()
    assert len(moving.points) == 0
    np.testing.assert_array_equal(moving.start, [0])


@pytest.mark.parametrize(
    ("action", "scale", "said"),
    [
        ("", 1.0, ""),
        ("going on", 1.0, ""),
        ("waiting", 0.0, "waits for obstacle 4"),
        ("evading", 0.0, "evades obstacle 4"),
        ("caught", 0.0, "evades obstacle 4"),
    ],
)
def test_a_motion_is_held_while_it_waits_or_evades(action: str, scale: float, said: str) -> None:
    demand = watch_evasion(Evasion(action, obstacle=4))
    assert (demand.scale, demand.reason, demand.lasting) == (scale, said, False)


def test_the_table_is_kept_from() -> None:
    # A wall at x = 0 that faces the ball.
    wall = TablePlane(np.array([-1.0, 0.0, 0.0]), 0.0)
    empty = seen()
    found = clearance(-0.2, 0.5, obstacles=empty, table=wall)
    assert found.scale == pytest.approx((0.1 - PARAMETERS.stop_distance) / 0.3 / 0.5)
    assert found.reason == "ball within 0.100 m of the table"
    assert clearance(-0.2, -0.5, obstacles=empty, table=wall).scale == 1.0


def test_points_that_are_not_finite_are_refused() -> None:
    with pytest.raises(ValueError, match="not finite"):
        ObstaclePoints.of(seen(np.full((2, 3), np.nan)))


def test_a_bad_or_late_frame_leaves_what_was_seen() -> None:
    good = SupervisorState().with_observation(seen(np.zeros((1, 3)), stamp=1.0, table=TablePlane()))
    assert good.obstacles.stamp == 1.0
    for frame in (
        seen(np.full((1, 3), np.nan), stamp=2.0),
        seen(np.ones((1, 3)), stamp=0.5),
    ):
        after = good.with_observation(frame)
        assert after.obstacles is good.obstacles
    without_table = good.with_observation(seen(np.ones((1, 3)), stamp=2.0))
    assert without_table.obstacles.stamp == 2.0
    assert without_table.table is not None


@pytest.mark.parametrize(
    ("age", "scale"),
    [(0.0, 1.0), (2.4 / 15.0, 1.0), ((2.5 / 15.0 + 0.5) / 2.0, 0.5), (0.5, 0.1), (0.51, 0.0)],
)
def test_an_old_observation_slows(age: float, scale: float) -> None:
    demand = watch_observation(ObstaclePoints(stamp=1.0), 1.0 + age, PARAMETERS)
    assert demand.scale == pytest.approx(scale, abs=1e-9)
    assert not demand.lasting


def test_nothing_moves_before_the_first_observation() -> None:
    assert watch_observation(ObstaclePoints(), 0.0, PARAMETERS).scale == 0.0


RANGE = JointRange(("a", "b"), np.array([-1.0, -1.0]), np.array([1.0, 1.0]), np.array([2.0, 2.0]))


def test_a_joint_is_slowed_toward_its_limit_only() -> None:
    q, still = np.array([0.96, 0.0]), np.zeros(2)
    toward = watch_joints(RANGE, q, still, np.array([0.5, 0.5]), 1.0, PARAMETERS)
    assert toward.scale == pytest.approx(0.02 / 0.3 / 0.5)
    assert toward.reason == "a 0.040 rad from its position limit"
    assert watch_joints(RANGE, q, still, np.array([-0.5, 0.5]), 1.0, PARAMETERS).scale == 1.0


def test_a_fast_joint_is_slowed_but_not_held() -> None:
    q, still = np.zeros(2), np.zeros(2)
    assert watch_joints(RANGE, q, still, np.array([0.0, 4.0]), 1.0, PARAMETERS).scale == 0.5
    # Measured, at half speed, where the prediction does not say so.
    now = watch_joints(RANGE, q, np.array([3.0, 0.0]), still, 0.5, PARAMETERS)
    assert now.scale == pytest.approx(0.5 * 2.0 / 3.0)
    assert watch_joints(RANGE, q, still, np.array([0.0, 1e3]), 1.0, PARAMETERS).scale == 0.1


@pytest.mark.parametrize(("error", "scale"), [(0.0, 1.0), (0.02, 1.0), (0.035, 0.5), (0.05, 0.0)])
def test_the_tracking_error_slows(error: float, scale: float) -> None:
    assert watch_tracking(error, PARAMETERS).scale == pytest.approx(scale)


def test_lasting_saturation_slows_and_is_forgiven() -> None:
    state, scales = SupervisorState(), []
    for step in range(60):
        time = step * STEP
        state, demand = watch_torque(state, step < 40, time, STEP, PARAMETERS)
        scales.append(demand.scale)
    assert scales[12] == 1.0
    assert scales[14] == pytest.approx(0.7)
    assert min(scales) == pytest.approx(0.7**3)
    assert scales[-1] == pytest.approx(0.7**3 + 20 * STEP)
    for step in range(1000):
        state, demand = watch_torque(state, True, step * STEP, STEP, PARAMETERS)
    assert demand.scale == pytest.approx(0.1)


# Decisions.


def run(demands: list[Demand], count: int, state: SupervisorState, begin: float = 0.0) -> list:
    found = []
    for step in range(count):
        state = decide(state, demands, begin + step * STEP, STEP, PARAMETERS)
        found.append(state)
    return found


def test_speed_falls_at_once_and_rises_slowly() -> None:
    (held,) = run([Demand(0.0, "why", "why, 3 m")], 1, SupervisorState())
    assert held.supervision.action == "hold"
    assert (held.supervision.speed_scale, held.supervision.reason) == (0.0, "why, 3 m")
    back = run([Demand()], 200, held, 1.0)
    scales = [state.supervision.speed_scale for state in back]
    np.testing.assert_allclose(np.diff(scales[:100]), STEP / PARAMETERS.recovery_time)
    actions = [state.supervision.action for state in back]
    assert actions == sorted(actions, reverse=True)
    assert set(actions) == {"slow", "run"}
    assert all(s.supervision.reason == "why, 3 m" for s in back if s.supervision.action == "slow")
    assert back[-1].supervision.reason == ""


def test_a_hold_ends_only_well_above_where_it_began() -> None:
    (held,) = run([Demand(0.04, "why", "why")], 1, SupervisorState())
    assert run([Demand(0.2, "why", "why")], 5, held)[-1].supervision.action == "hold"
    assert run([Demand(0.4, "why", "why")], 5, held)[-1].supervision.action == "slow"
    # A motion that was not held goes on at that speed.
    assert run([Demand(0.2, "why", "why")], 1, SupervisorState())[0].supervision.action == "slow"


def test_a_demand_that_flickers_is_told_once() -> None:
    state, told = SupervisorState(), []
    for step in range(125):
        demand = Demand(0.9, "near", "near") if step % 2 else Demand()
        after = decide(state, [demand], step * STEP, STEP, PARAMETERS)
        if (after.supervision.action, after.cause) != (state.supervision.action, state.cause):
            told.append(after.supervision.action)
        state = after
    assert told == ["slow"]


def test_another_cause_is_told_after_a_while() -> None:
    (first,) = run([Demand(0.5, "one", "one")], 1, SupervisorState())
    later = run([Demand(0.4, "two", "two")], 100, first, STEP)
    assert [state.cause for state in later[:60]] == ["one"] * 60
    assert later[-1].cause == "two"


@pytest.mark.parametrize(("lasting", "action"), [(True, "stop"), (False, "hold")])
def test_patience_ends_for_what_stays(lasting: bool, action: str) -> None:
    held = run([Demand(0.0, "why", "why", lasting=lasting)], 400, SupervisorState())
    assert held[-1].supervision.action == action
    if lasting:
        after = run([Demand()], 300, held[-1], 10.0)
        assert after[0].supervision.action == "slow"
        assert after[-1].supervision.action == "run"


def test_what_cannot_be_watched_is_stopped_for_good() -> None:
    stop = broken(SupervisorState(), "the robot state is not finite", 1.0)
    (after,) = run([Demand()], 1, stop, 10.0)
    assert after is stop
    assert (stop.supervision.action, stop.supervision.speed_scale) == ("stop", 0.0)


def test_patience_is_not_lost_while_the_policy_waits() -> None:
    state = SupervisorState()
    for step in range(400):
        state = decide(
            state,
            [Demand(0.0, "why", "why", lasting=True)],
            step * STEP,
            STEP,
            PARAMETERS,
            waits=True,
        )
    assert state.supervision.action == "hold"


@given(speed=st.floats(0.3, 1.5), begin=st.floats(0.13, 0.6), hold_time=st.floats(0.05, 0.5))
@settings(max_examples=6)
def test_a_resting_obstacle_is_never_touched(speed: float, begin: float, hold_time: float) -> None:
    parameters = SupervisorSettings(reaction_time=hold_time + 0.05)
    state, x, scale = SupervisorState(), -begin, 0.0
    for step in range(500):
        demand = clearance(x, speed, parameters=parameters)
        state = decide(state, [demand], step * STEP, STEP, parameters)
        # The policy's ramp.
        most = STEP / hold_time
        scale += min(max(state.supervision.speed_scale - scale, -most), most)
        x += scale * speed * STEP
    rest = -x - 0.1 - parameters.padding
    assert rest > parameters.stop_distance - 1e-3
    assert rest < parameters.stop_distance + 0.1 * parameters.reaction_time * speed + 1e-2
    assert state.supervision.action in ("hold", "stop")
