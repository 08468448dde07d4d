"""How likely a motion with the chain's parameters keeps what is asked: a calibrated probability.

It is told for one obstacle at a time, from its descriptor in baselines::

    (lambda1', lambda2', Delta, place of the centre along the baseline, distance beside it)

and is the probability that a motion in the P-plane, from rest and with that obstacle's term alone,
touches nothing, keeps the asked clearance (of it what start and goal leave, if that is less) within
`SHORT` and ends within `MISSED` of the goal. How a section is turned in its plane, and
what of the obstacle stands out of it, the descriptor does not tell: that is left to chance.
`drake_oa.training.confidence` measures it.

A network's output is the logarithm of the odds. It is asked for the nearest descriptor that was
measured; outside of what was, the probability falls off with the distance to it, toward zero.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drake_oa.common.messages import FloatArray, Frozen
from drake_oa.regulation.network import Network, array_of, network_arrays, network_of

N_INPUTS = 5
"""Length of a descriptor."""

SHORT = MISSED = 0.01
"""What may lack of the clearance, and how far from the goal the motion may end, in baselines."""

_FALL = 0.1
"""At this distance from what was measured the probability is down to 1/e, in baselines."""

_NAME = "confidence"
_BOUNDS = ("lower", "upper")


@dataclass(frozen=True, eq=False)
class Confidence(Frozen):
    """The probability that the chain's motion keeps what is asked, given the descriptor.

    Attributes:
        network: from a descriptor to the logarithm of the odds.
        lower: (5,) least values that were measured, in baselines.
        upper: (5,) the greatest.
    """

    network: Network
    lower: FloatArray
    upper: FloatArray

    def probability(self, descriptor: FloatArray) -> FloatArray:
        """The probability in [0, 1] of each descriptor; 0 where it is not finite.

        Args:
            descriptor: (M, 5) in baselines.

        Returns:
            (M,).
        """
        nearest = np.nan_to_num(np.clip(descriptor, self.lower, self.upper))
        # No farther than where nothing is left: the squares of it do not overflow.
        away = np.minimum(np.abs(descriptor - nearest), 1e3) / _FALL
        distance = np.sqrt((away * away).sum(axis=1))
        columns = np.vstack((nearest.T, np.ones(len(nearest))))
        odds = np.clip(self.network.evaluate(columns), -50.0, 50.0)
        found = np.exp(-distance) / (1.0 + np.exp(-odds))
        return np.where(np.isfinite(descriptor).all(axis=1), found, 0.0)


def confidence_arrays(confidence: Confidence) -> dict[str, FloatArray]:
    """Its arrays as the weights' file holds them."""
    bounds = {f"{_NAME}_{key}": getattr(confidence, key) for key in _BOUNDS}
    return network_arrays(_NAME, confidence.network) | bounds


def confidence_of(path: Path, arrays: Mapping[str, Any]) -> Confidence | None:
    """The confidence in a file's arrays; None where the file has none.

    Raises:
        ValueError: naming file and array, if one is missing, misshapen or not finite, or the
            bounds leave nothing between them.
    """
    if not any(key.startswith(f"{_NAME}_") for key in arrays):
        return None
    network = network_of(path, arrays, _NAME, N_INPUTS)
    lower, upper = (array_of(path, arrays, f"{_NAME}_{key}", (N_INPUTS,)) for key in _BOUNDS)
    if not (lower < upper).all():
        raise ValueError(f"{path}: '{_NAME}_upper' must exceed '{_NAME}_lower'")
    return Confidence(network, lower, upper)
