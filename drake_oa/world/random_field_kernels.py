"""Compiled random numbers and smooth random fields that are functions of their place.

Every number is a hash of (key, stream, row, column): nothing is kept between calls, and
pixels may be computed in any order. The mixer is the finaliser of SplitMix64 (Steele,
Lea and Flood 2014). Images are float32 and C-contiguous.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from drake_oa.common.messages import IntArray

Image = NDArray[np.float32]

PHASE, AXIAL, LATERAL, DROPOUT, GRAZING, FLYING, MOVED = range(7)
"""Streams: what the numbers are for."""
PATCH_BITS = 2
"""Of the 4 x 4 pixels in which an edge is displaced together, and shares its holes."""


@njit(cache=True, error_model="numpy")
def mixed(x: Any) -> Any:
    """64 bits that look random, of 64 bits that need not."""
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@njit(cache=True, error_model="numpy")
def hashed(key: Any, stream: int, row: int, column: int) -> Any:
    """64 random bits of a place; rows and columns below 2^24."""
    place = (np.uint64(stream) << np.uint64(48)) | (np.uint64(row) << np.uint64(24))
    return mixed(key + (place | np.uint64(column)) * np.uint64(0x9E3779B97F4A7C15))


@njit(cache=True, error_model="numpy")
def uniform(bits: Any) -> Any:
    """In [0, 1), of the upper 24 bits."""
    return np.float32(bits >> np.uint64(40)) * np.float32(2.0**-24)


@njit(cache=True, error_model="numpy")
def _byte_sums(bits: Any) -> Any:
    """Sums of the bytes of each 32-bit half, as two numbers of 0 ... 1020."""
    mask = np.uint64(0x00FF00FF00FF00FF)
    pairs = (bits & mask) + ((bits >> np.uint64(8)) & mask)
    halves = (pairs + (pairs >> np.uint64(16))) & np.uint64(0x0000FFFF0000FFFF)
    return np.float32(halves & np.uint64(0xFFFF)), np.float32(halves >> np.uint64(32))


@njit(cache=True, error_model="numpy")
def normal(bits: Any) -> Any:
    """Nearly standard normal: the sum of eight uniform bytes, which ends at 4.9."""
    first, second = _byte_sums(bits)
    # Variance of a uniform byte: (2^16 - 1) / 12.
    return (first + second - np.float32(1020.0)) * np.float32(1.0 / 209.02152999)


@njit(cache=True, error_model="numpy")
def _two_normals(bits: Any) -> Any:
    """Two independent ones, of four bytes each, which end at 3.45."""
    first, second = _byte_sums(bits)
    scale = np.float32(1.0 / 147.80054127)
    return (first - np.float32(510.0)) * scale, (second - np.float32(510.0)) * scale


@njit(cache=True, error_model="numpy")
def lattice_along(key: Any, axis: int, spacing: int, size: int) -> tuple[IntArray, Image]:
    """Where pixels along an axis lie on the lattice of the axial noise.

    Returns:
        (size,) the node before each pixel, and (2, size) the shares of that and the next
        one: together they are of unit variance everywhere.
    """
    cell = np.empty(size, dtype=np.int64)
    share = np.empty((2, size), dtype=np.float32)
    # Each frame its own lattice: one at rest would show in a mean over frames.
    phase = np.int64(hashed(key, PHASE, 0, axis) % np.uint64(spacing))
    one = np.float32(1.0)
    for i in range(size):
        cell[i] = (i + phase) // spacing
        t = np.float32((i + phase) % spacing) / np.float32(spacing)
        scale = one / np.sqrt((one - t) * (one - t) + t * t)
        share[0, i], share[1, i] = (one - t) * scale, t * scale
    return cell, share


@njit(cache=True, error_model="numpy")
def lattice_nodes(key: Any, rows: int, columns: int) -> Image:
    """Standard normal numbers, one a node."""
    nodes = np.empty((rows, columns), dtype=np.float32)
    for row in range(rows):
        for column in range(columns):
            nodes[row, column] = normal(hashed(key, AXIAL, row, column))
    return nodes


@njit(cache=True, error_model="numpy")
def patch_nodes(key: Any, height: int, width: int) -> Image:
    """Three standard normal numbers for each patch of 2^PATCH_BITS by as many pixels."""
    rows, columns = (height >> PATCH_BITS) + 1, (width >> PATCH_BITS) + 1
    nodes = np.empty((rows, columns, 3), dtype=np.float32)
    for row in range(rows):
        for column in range(columns):
            a, b = _two_normals(hashed(key, LATERAL, row, column))
            nodes[row, column, 0], nodes[row, column, 1] = a, b
            nodes[row, column, 2] = normal(hashed(key, DROPOUT, row, column))
    return nodes


@njit(cache=True, error_model="numpy")
def spread_over(nodes: Image, cell: IntArray, share: Image, line: Image) -> None:
    """Fills line (W,) with one row of nodes, smooth over their spacing."""
    first, second = share[0], share[1]
    for i in range(len(line)):
        k = cell[i]
        line[i] = nodes[k] * first[i] + nodes[k + 1] * second[i]


@njit(cache=True, error_model="numpy")
def fill_between(above: Image, below: Image, first: Any, second: Any, g: Image) -> None:
    """Fills g (W,) with the row of noise between two lines of nodes."""
    for i in range(len(g)):
        g[i] = first * above[i] + second * below[i]
