"""Tests of perception in the diagram of a scenario, with one camera and with two."""

from typing import Any

import numpy as np
from pydrake.systems.analysis import Simulator

from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.scenario.loading import load_scenario

BOARD = [[0.3, -0.01, 0.0], [0.7, 0.01, 0.3]]
"""Lowest and highest point of the board [m]."""
POST = [[0.425, 0.125, 0.0], [0.475, 0.175, 0.14]]
"""Lowest and highest point of the post [m]."""
TIN = [[0.56, -0.18, 0.0], [0.64, -0.1, 0.14]]
"""Lowest and highest point of the tin [m]."""


def perceived_extents(*overrides: str) -> list[np.ndarray]:
    """Returns the extents (2, 3) of the obstacles perceived in `two_cameras` after 0.05 s."""
    diagram = build_avoidance(load_scenario("two_cameras", overrides))
    simulator = Simulator(diagram)
    simulator.AdvanceTo(0.05)
    perception: Any = diagram.GetSubsystemByName("perception")
    context = perception.GetMyContextFromRoot(simulator.get_context())
    obstacles = perception.GetOutputPort("obstacles_W").Eval(context)
    assert obstacles.note == ""
    return [np.array([cloud.min(axis=0), cloud.max(axis=0)]) for cloud in obstacles.clouds_W]


def test_two_cameras_perceive_objects_that_are_occluded_from_each() -> None:
    def contains(extents: list[np.ndarray], object: list[list[float]]) -> bool:
        return any(np.abs(extent - object).max() < 0.025 for extent in extents)

    one, both = "perception.cameras=[]", perceived_extents()
    assert len(both) == 3
    assert all(contains(both, object) for object in (BOARD, POST, TIN))
    left, right = (
        perceived_extents(one, f"perception.camera={name}") for name in ("left", "right")
    )
    assert len(left) == len(right) == 2
    assert contains(left, POST)
    assert contains(right, TIN)
