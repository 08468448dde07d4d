"""Arrays as the compiled kernels take them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from drake_oa.common.messages import FloatArray


def kernel_arrays(*arrays: ArrayLike) -> list[FloatArray]:
    """Copies as float64, C-contiguous and writeable.

    The arrays of frozen values are read-only, for which numba would compile a kernel once
    more.
    """
    return [np.array(array, dtype=float, order="C") for array in arrays]
