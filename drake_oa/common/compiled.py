"""The decorator of compiled functions."""

from __future__ import annotations

from numba import njit

# Said for each: one that says nothing of fastmath takes its caller's, if that is the first to
# have it compiled, and the cache then hands it to everyone, where 0 * inf may be anything.
compiled = njit(cache=True, error_model="numpy", fastmath=False)
"""As `numba.njit`: kept on disk, division by zero as NumPy has it, and no liberties."""

leaf = njit(cache=True, error_model="numpy", fastmath=False, _nrt=False)
"""As `compiled`, for what allocates nothing: references to its arrays are not counted.

Counting them takes 10 ns an array and call, more than a short kernel that is given many.
"""
