"""What takes a lasting tracking error away, between policy and controller."""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from drake_oa.common.ports import valid_period

LARGEST_ERROR = 0.01
"""Nothing is summed up while the tool is farther off: something else is wrong then [m]."""
LARGEST_ACCELERATION = 2.0
"""Most that is added along each axis [m/s^2]; a wrong model of the Panda asks for under 1."""


class IntegralAction(LeafSystem):
    """Adds to the desired acceleration what the controller's model lacks of the truth.

    .. pydrake_system::

      name: IntegralAction
      input_ports:
      - tracking_error
      - desired_acceleration
      output_ports:
      - desired_acceleration

    - tracking_error: (3,) desired minus actual position of the tool in the world [m].
    - desired_acceleration (in): (3,) of the tool point in the world [m/s^2].
    - desired_acceleration (out): (3,) the same plus k_i times the integral of the error.

    The law behind it, e'' + k_d e' + k_p e = 0, leaves the error d / k_p under a lasting
    disturbance d; with the integral it goes to zero, and is stable for k_i < k_p k_d. It
    rests while the error is unknown or larger than `LARGEST_ERROR`, and never adds more than
    `LARGEST_ACCELERATION`, so that a tool that is held back does not gather force.
    """

    def __init__(self, gain: float, *, period: float) -> None:
        """Declares ports, state and events.

        Args:
            gain: k_i [1/s^3].
            period: of the sum [s].

        Raises:
            ValueError: for a gain or period that is not positive.
        """
        super().__init__()
        if not 0.0 < gain < np.inf:
            raise ValueError(f"gain must be positive and finite [1/s^3], not {gain}")
        self._gain, self._period = float(gain), valid_period(period)
        self._error = self.DeclareVectorInputPort("tracking_error", 3)
        self._asked = self.DeclareVectorInputPort("desired_acceleration", 3)
        # The acceleration that is added, rather than the integral.
        self._added = self.DeclareDiscreteState(3)
        self.DeclarePeriodicDiscreteUpdateEvent(period, period, self._sum)
        self.DeclareVectorOutputPort(
            "desired_acceleration",
            3,
            self._calc,
            {self._asked.ticket(), self.discrete_state_ticket(self._added)},
        )

    def _sum(self, context: Context, values: DiscreteValues) -> None:
        added = context.get_discrete_state(self._added).value()
        error = self._error.Eval(context)
        if float(error @ error) <= LARGEST_ERROR**2:
            added = np.clip(
                added + self._gain * self._period * error,
                -LARGEST_ACCELERATION,
                LARGEST_ACCELERATION,
            )
        values.set_value(self._added, added)

    def _calc(self, context: Context, output: BasicVector) -> None:
        added = context.get_discrete_state(self._added).value()
        output.SetFromVector(self._asked.Eval(context) + added)
