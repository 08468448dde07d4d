"""The authors' released chain, in the plain layout that it comes in."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from drake_oa.regulation.regressor import TARGETS, ChainWeights, network_of


def load_width_chain(path: Path) -> ChainWeights:
    """Reads a chain that was trained on full widths and a 1 m baseline.

    The keys are ``{kappa,psi,alpha}_{W1.., b1.., in_offset, in_gain, in_min, out_offset,
    out_gain, out_min}``; the range is that of the min-max scaling.
    """
    with np.load(path) as file:
        networks = {n: network_of(path, dict(file), n, 3 + i) for i, n in enumerate(TARGETS)}
    first = networks["kappa"]
    scale = np.array([2.0, 2.0, 1.0])
    upper = first.in_offset - 2.0 * first.in_min / first.in_gain
    return ChainWeights(networks, first.in_offset / scale, upper / scale, scale)
