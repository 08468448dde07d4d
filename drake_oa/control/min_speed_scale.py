"""What several limits of speed come to."""

from __future__ import annotations

from pydrake.systems.framework import BasicVector, Context, LeafSystem


class MinSpeedScale(LeafSystem):
    """The least of several shares of full speed.

    .. pydrake_system::

      name: MinSpeedScale
      input_ports:
      - speed_scale
      - turn_speed_scale (optional)
      output_ports:
      - least

    - speed_scale: (1,) a share of full speed, in [0, 1].
    - turn_speed_scale (optional): (1,) another.
    - least: (1,) the lesser of them.

    There is no state.
    """

    def __init__(self) -> None:
        """Declares the ports."""
        super().__init__()
        self._one = self.DeclareVectorInputPort("speed_scale", 1)
        self._other = self.DeclareVectorInputPort("turn_speed_scale", 1)
        self.DeclareVectorOutputPort("least", 1, self._calc)

    def _calc(self, context: Context, output: BasicVector) -> None:
        least = float(self._one.Eval(context)[0])
        if self._other.HasValue(context):
            least = min(least, float(self._other.Eval(context)[0]))
        output.SetAtIndex(0, least)
