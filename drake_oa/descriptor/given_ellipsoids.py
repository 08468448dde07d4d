"""Ellipsoids that are known beforehand."""

from __future__ import annotations

from pydrake.common.value import Value
from pydrake.systems.framework import LeafSystem

from drake_oa.common.messages import EllipsoidSet


class GivenEllipsoidSource(LeafSystem):
    """Hands out one set of ellipsoids, always the same.

    .. pydrake_system::

      name: GivenEllipsoidSource
      output_ports:
      - ellipsoids_W

    - ellipsoids_W: abstract `EllipsoidSet` in the world frame.

    Drake's `ConstantValueSource` counts as new at every instant, and with it all that is
    computed from it; this output depends on nothing.
    """

    def __init__(self, ellipsoids: EllipsoidSet) -> None:
        """Declares the port.

        Args:
            ellipsoids: what is handed out; with a stamp of `np.inf` they are never out of
                date, with another one the policy is held when it has become too old.

        Raises:
            TypeError: if it is no `EllipsoidSet`.
        """
        super().__init__()
        if not isinstance(ellipsoids, EllipsoidSet):
            raise TypeError(
                f"ellipsoids must be an EllipsoidSet, not a {type(ellipsoids).__name__}"
            )
        self.DeclareAbstractOutputPort(
            "ellipsoids_W",
            lambda: Value(ellipsoids),
            lambda context, output: output.set_value(ellipsoids),
            prerequisites_of_calc={self.nothing_ticket()},
        )
