"""The layers of the paper, in their order, in every shipped scenario with a camera."""

from itertools import pairwise

import pytest
from pydrake.systems.framework import Diagram

from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.regulation.config import Verified
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.perception import CameraSource
from drake_oa.scenario.shipped import missing_package, shipped_scenarios

WITH_CAMERA = [
    name
    for name, path in shipped_scenarios().items()
    if not missing_package(path) and isinstance(load_scenario(name).perception, CameraSource)
]


def edges(diagram: Diagram) -> set[tuple[str, str]]:
    """Names of the classes of connected systems."""
    return {
        (type(source).__name__, type(sink).__name__)
        for (sink, _), (source, _) in diagram.connection_map().items()
    }


@pytest.mark.parametrize("name", WITH_CAMERA)
def test_the_layers_are_connected_in_their_order(name: str) -> None:
    scenario = load_scenario(name)
    diagram = build_avoidance(scenario)
    order = ["DepthPerception", "EllipsoidDescriptor", "RegressorChain", "CostRingSelector"]
    if isinstance(scenario.regulation, Verified):
        order += ["MotionVerifier", "DmpIntegrator", "MotionGuard", "JointInverseDynamics"]
    else:
        order += ["DmpIntegrator", "CartesianInverseDynamics"]
    classes = [type(system).__name__ for system in diagram.GetSystems()]
    assert [
        found for found in classes if found in {*order, "MotionVerifier", "MotionGuard"}
    ] == order
    assert set(pairwise(order)) <= edges(diagram)
    if "MotionVerifier" in order:
        assert ("CostRingSelector", "DmpIntegrator") not in edges(diagram)
