"""Tests of the claims of passive motion safety, while joint 1 moves and brakes."""

from dataclasses import replace

import numpy as np
import pydrake.geometry as drake
import pytest

from drake_oa.geometry.collision_scene import CollisionScene, geometry_of
from drake_oa.geometry.pinhole import View
from drake_oa.perception.depth_perception import FreeSpace
from drake_oa.safety.passive_safety import violated_claim
from tests.planning.arms import ArmAlone

BRAKING = 5.0
# Pose of a camera 3 m above the base that looks down.
X_WC = np.array(
    [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 3.0], [0.0, 0.0, 0.0, 1.0]]
)
K = np.array([100.0, 100.0, 159.5, 119.5])


def claim_of(
    arm: ArmAlone, rate: float, scene: CollisionScene, space: FreeSpace | None = None
) -> str:
    """Returns the claim violated by joint 1 at a rate [rad/s] for 0.1 s, then braking."""
    t = np.arange(0.0, 0.6, 0.03)
    braked = np.clip(t - 0.1, 0.0, abs(rate) / BRAKING)
    distance = rate * np.minimum(t, 0.1) + rate * braked - np.sign(rate) * 0.5 * BRAKING * braked**2
    q = np.tile(arm.q, (len(t), 1))
    q[:, 0] += distance
    spheres = arm.arm_spheres.arrays
    return violated_claim(arm.chain, spheres, t, q, scene, space, V=0.8, v_unseen=0.25)


def moving_ball(panda: ArmAlone, distance: float, speed: float) -> CollisionScene:
    """Returns a rising ball at a distance from the tool along the motion of joint 1 [m]."""
    X_WO, p_WE = np.eye(4), panda.X_WE[9:]
    X_WO[:3, 3] = p_WE + distance * np.array([-p_WE[1], p_WE[0], 0.0]) / np.hypot(*p_WE[:2])
    ball = replace(geometry_of(drake.Sphere(0.05)), X_WO=X_WO, v_WO=np.array([0.0, 0.0, speed]))
    return CollisionScene.of(0.0, [ball])


@pytest.mark.parametrize(
    ("distance", "rate", "speed", "claim"),
    [
        (0.3, 1.0, 0.3, "A"),
        (0.3, -1.0, 0.3, ""),
        (0.3, 0.02, 0.3, ""),
        (0.9, 1.0, 0.3, ""),
        (0.3, 1.0, 0.0, ""),
    ],
    ids=["approached", "left", "slow", "far", "at rest"],
)
def test_claim_a(panda: ArmAlone, distance: float, rate: float, speed: float, claim: str) -> None:
    assert claim_of(panda, rate, moving_ball(panda, distance, speed)) == claim


@pytest.mark.parametrize("distance", np.linspace(0.15, 0.35, 9))
def test_claim_a_does_not_depend_on_the_time_step(panda: ArmAlone, distance: float) -> None:
    scene, claims = moving_ball(panda, distance, 0.3), []
    for count in (2, 25):
        t, q = np.linspace(0.0, 0.048, count), np.tile(panda.q, (count, 1))
        q[:, 0] += t
        spheres = panda.arm_spheres.arrays
        claims.append(violated_claim(panda.chain, spheres, t, q, scene, None, V=0.8, v_unseen=1))
    assert claims[0] == claims[1]


@pytest.mark.parametrize(
    ("depth", "rate", "claim"),
    [(np.inf, 1.0, ""), (np.nan, 1.0, "B"), (0.0, 1.0, "B"), (2.2, 1.0, "B"), (np.nan, 0.1, "")],
    ids=["all seen", "no depth", "too near", "hidden", "slow"],
)
def test_claim_b(panda: ArmAlone, depth: float, rate: float, claim: str) -> None:
    # All pixels of the image have this depth.
    image = np.full((240, 320), depth, dtype=np.float32)
    space = FreeSpace((View(image, K, X_WC),), 0.0)
    assert claim_of(panda, rate, CollisionScene.of(0.0, []), space) == claim
