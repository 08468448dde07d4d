"""Makes the system that turns the tool along the motion."""

from __future__ import annotations

from drake_oa.policy.orientation_integrator import OrientationIntegrator
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.tool_orientation import tool_orientation


def make_orientation_integrator(scenario: Scenario) -> OrientationIntegrator | None:
    """The action level of the orientation; None: the tool keeps `robot.rpy_WE`.

    Raises:
        ScenarioError: naming the field that does not fit.
    """
    held = tool_orientation(scenario)
    if held is None:
        return None
    return OrientationIntegrator(
        held.primitive, held.R_WS, held.R_WG, period=scenario.policy.period
    )
