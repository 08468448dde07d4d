"""Claims of passive motion safety along motions of which joint 1 turns and brakes."""

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
# Of a camera 3 m above the base that looks down.
X_WC = np.array(
    [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 3.0], [0.0, 0.0, 0.0, 1.0]]
)
K = np.array([100.0, 100.0, 159.5, 119.5])


def claim_of(
    arm: ArmAlone, rate: float, scene: CollisionScene, space: FreeSpace | None = None
) -> str:
    """Claim that is violated if joint 1 turns at a rate for 0.1 s, then brakes."""
    t = np.arange(0.0, 0.6, 0.03)
    braked = np.clip(t - 0.1, 0.0, abs(rate) / BRAKING)
    way = rate * np.minimum(t, 0.1) + rate * braked - np.sign(rate) * 0.5 * BRAKING * braked**2
    course = np.tile(arm.q, (len(t), 1))
    course[:, 0] += way
    spheres = arm.arm_spheres.arrays
    return violated_claim(arm.chain, spheres, t, course, scene, space, V=0.8, v_unseen=0.25)


def moving_ball(panda: ArmAlone, way: float, speed: float) -> CollisionScene:
    """A ball so far from the tool in the direction in which joint 1 turns [m], that rises."""
    X_WO, p_WE = np.eye(4), panda.X_WE[9:]
    X_WO[:3, 3] = p_WE + way * np.array([-p_WE[1], p_WE[0], 0.0]) / np.hypot(*p_WE[:2])
    ball = replace(geometry_of(drake.Sphere(0.05)), X_WO=X_WO, v_WO=np.array([0.0, 0.0, speed]))
    return CollisionScene.of(0.0, [ball])


@pytest.mark.parametrize(
    ("way", "rate", "speed", "claim"),
    [
        (0.3, 1.0, 0.3, "A"),
        (0.3, -1.0, 0.3, ""),
        (0.3, 0.02, 0.3, ""),
        (0.9, 1.0, 0.3, ""),
        (0.3, 1.0, 0.0, ""),
    ],
    ids=["approached", "left", "slow", "far", "at rest"],
)
def test_claim_a(panda: ArmAlone, way: float, rate: float, speed: float, claim: str) -> None:
    assert claim_of(panda, rate, moving_ball(panda, way, speed)) == claim


@pytest.mark.parametrize("way", np.linspace(0.15, 0.35, 9))
def test_claim_a_counts_at_all_times_of_a_step(panda: ArmAlone, way: float) -> None:
    scene, found = moving_ball(panda, way, 0.3), []
    for count in (2, 25):
        t, course = np.linspace(0.0, 0.048, count), np.tile(panda.q, (count, 1))
        course[:, 0] += t
        spheres = panda.arm_spheres.arrays
        found.append(
            violated_claim(panda.chain, spheres, t, course, scene, None, V=0.8, v_unseen=1)
        )
    assert found[0] == found[1]


@pytest.mark.parametrize(
    ("depth", "rate", "claim"),
    [(np.inf, 1.0, ""), (np.nan, 1.0, "B"), (0.0, 1.0, "B"), (2.2, 1.0, "B"), (np.nan, 0.1, "")],
    ids=["all seen", "no depth", "too near", "hidden", "slow"],
)
def test_claim_b(panda: ArmAlone, depth: float, rate: float, claim: str) -> None:
    # Every pixel has this depth.
    image = np.full((240, 320), depth, dtype=np.float32)
    space = FreeSpace((View(image, K, X_WC),), 0.0)
    assert claim_of(panda, rate, CollisionScene.of(0.0, []), space) == claim
