"""Compiled loops of the depth camera's noise; call `drake_oa.world.depth_noise` instead.

Every random number is a hash of (key, stream, row, column), the key being that of a seed and a
frame: nothing is kept between calls, and pixels may be computed in any order. The mixer is the
finaliser of SplitMix64 (Steele, Lea and Flood 2014). Images are float32 and C-contiguous. Depth
is handled as w = 1 / z, which is linear in the image over a plane and proportional to disparity.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import IntArray

Image = NDArray[np.float32]

PHASE, AXIAL, LATERAL, DROPOUT, GRAZING, FLYING, MOVED = range(7)
"""Streams: what the numbers are for."""
PATCH_BITS = 2
"""Of the 4 x 4 pixels in which an edge is displaced together, and shares its holes."""


class Figures(NamedTuple):
    """What the noise is like, all float32.

    Attributes:
        near, far: depths that are measured [m].
        axial_offset, axial_growth, axial_depth, axial_angle: of the axial deviation, see
            `drake_oa.perception.config.CameraNoise` [m, 1/m, m, m^1.5].
        step: of 1 / z from one disparity to the next [1/m].
        per_step: its inverse [m].
        unit: of the depths handed out [m].
        per_unit: its inverse [1/m].
        edge: share of w that is an edge.
        grazing_start, grazing_end: cosines of incidence where pixels begin to be missing, and
            where all are.
        lateral: deviation of an edge's place [pixel].
        holes: normal quantile of the share of missing pixels beside an edge.
        flying: share of flying pixels.
        least: least w [1/m].
        shadow: focal length times baseline, 0 without shadows [pixel m].
        spacing_u, spacing_v: of the axial noise's lattice, across and down [pixel].
    """

    near: Any
    far: Any
    axial_offset: Any
    axial_growth: Any
    axial_depth: Any
    axial_angle: Any
    step: Any
    per_step: Any
    unit: Any
    per_unit: Any
    edge: Any
    grazing_start: Any
    grazing_end: Any
    lateral: Any
    holes: Any
    flying: Any
    least: Any
    shadow: Any
    spacing_u: Any
    spacing_v: Any


@compiled
def mixed(x: Any) -> Any:
    """64 bits that look random, of 64 bits that need not."""
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@compiled
def hashed(key: Any, stream: int, row: int, column: int) -> Any:
    """64 random bits of a place; rows and columns below 2^24."""
    place = (np.uint64(stream) << np.uint64(48)) | (np.uint64(row) << np.uint64(24))
    return mixed(key + (place | np.uint64(column)) * np.uint64(0x9E3779B97F4A7C15))


@compiled
def uniform(bits: Any) -> Any:
    """In [0, 1), of the upper 24 bits."""
    return np.float32(bits >> np.uint64(40)) * np.float32(2.0**-24)


@compiled
def _byte_sums(bits: Any) -> Any:
    """Sums of the bytes of each 32-bit half, as two numbers of 0 ... 1020."""
    mask = np.uint64(0x00FF00FF00FF00FF)
    pairs = (bits & mask) + ((bits >> np.uint64(8)) & mask)
    halves = (pairs + (pairs >> np.uint64(16))) & np.uint64(0x0000FFFF0000FFFF)
    return np.float32(halves & np.uint64(0xFFFF)), np.float32(halves >> np.uint64(32))


@compiled
def normal(bits: Any) -> Any:
    """Nearly standard normal: the sum of eight uniform bytes, which ends at 4.9."""
    first, second = _byte_sums(bits)
    # Variance of a uniform byte: (2^16 - 1) / 12.
    return (first + second - np.float32(1020.0)) * np.float32(1.0 / 209.02152999)


@compiled
def _two_normals(bits: Any) -> Any:
    """Two independent ones, of four bytes each, which end at 3.45."""
    first, second = _byte_sums(bits)
    scale = np.float32(1.0 / 147.80054127)
    return (first - np.float32(510.0)) * scale, (second - np.float32(510.0)) * scale


@compiled
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


@compiled
def lattice_nodes(key: Any, rows: int, columns: int) -> Image:
    """Standard normal numbers, one a node."""
    nodes = np.empty((rows, columns), dtype=np.float32)
    for row in range(rows):
        for column in range(columns):
            nodes[row, column] = normal(hashed(key, AXIAL, row, column))
    return nodes


@compiled
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


@compiled
def spread_over(nodes: Image, cell: IntArray, share: Image, line: Image) -> None:
    """Fills line (W,) with one row of nodes, smooth over their spacing."""
    first, second = share[0], share[1]
    for i in range(len(line)):
        k = cell[i]
        line[i] = nodes[k] * first[i] + nodes[k + 1] * second[i]


@compiled
def fill_between(above: Image, below: Image, first: Any, second: Any, g: Image) -> None:
    """Fills g (W,) with the row of noise between two lines of nodes."""
    for i in range(len(g)):
        g[i] = first * above[i] + second * below[i]


_COUNTS = {"reassoc"}
"""Lets loops that count, in float32 for speed, use vector instructions: whole numbers are exact."""
_BAND = 2
"""Pixels beside an edge which its uncertain place reaches."""


@compiled
def _beyond(last: Any, one_before: Any, share: Any) -> Any:
    """What follows on the same surface; the last one again where an edge is between both."""
    return last + (last - one_before) if abs(last - one_before) <= share * last else last


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def _inverse_depths(
    z: Image, near: Any, far: Any, share: Any, w: Image, valid: NDArray[np.uint8]
) -> None:
    """Fills w (H + 2, W + 2) with 1 / z; the border goes on with the image's surfaces.

    Beyond `far`, and missing, is 0; nearer than `near`, where 0 too counts, is 1 / near:
    what is too near to be measured throws a shadow all the same.
    """
    height, width = z.shape
    nothing, one, nearest = np.float32(0.0), np.float32(1.0), np.float32(1.0 / near)
    least, most = np.float32(near), np.float32(far)
    for row in range(height):
        for column in range(width):
            depth = z[row, column]
            inside = (depth >= least) & (depth <= most)
            valid[row, column] = inside
            w[row + 1, column + 1] = (
                one / depth if inside else (nearest if depth < least else nothing)
            )
        w[row + 1, 0] = _beyond(w[row + 1, 1], w[row + 1, min(2, width)], share)
        w[row + 1, width + 1] = _beyond(w[row + 1, width], w[row + 1, max(width - 1, 1)], share)
    for column in range(width + 2):
        w[0, column] = _beyond(w[1, column], w[min(2, height), column], share)
        w[height + 1, column] = _beyond(w[height, column], w[max(height - 1, 1), column], share)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def _cast_shadows(w: Image, disparity: Any, counts: IntArray, valid: NDArray[np.uint8]) -> None:
    """Takes out what the projector, `disparity` f b [pixel m] to the right, does not light.

    Along a row from the right a lit point is further left in the projector's image than
    all before it: where that is not so something nearer stands in its light. Rows whose
    counts of edges are 0 have no shadow.
    """
    height, width = valid.shape
    for row in range(0, height, 2):
        other = min(row + 1, height - 1)
        if counts[row] == 0 and counts[other] == 0:
            continue
        # Two rows at a time: each pixel of one waits for the pixel before.
        lit, lit_other = np.float32(np.inf), np.float32(np.inf)
        for i in range(width):
            column = width - 1 - i
            place = np.float32(column) - disparity * w[row + 1, column + 1]
            place_other = np.float32(column) - disparity * w[other + 1, column + 1]
            valid[row, column] &= place <= lit
            valid[other, column] &= place_other <= lit_other
            lit = min(lit, place)
            lit_other = min(lit_other, place_other)


@compiled
def _measured(w: Any, cosine: Any, g: Any, p: Figures) -> Any:
    """Depth [m] as the camera tells it: noise g, then steps of disparity and of the unit."""
    one, half = np.float32(1.0), np.float32(0.5)
    z = one / w
    away = z - p.axial_depth
    # pi / 2 - theta; the series is short of it by 0.4 at theta = 0, where it matters least.
    grazing = cosine + cosine * cosine * cosine * np.float32(1.0 / 6.0)
    angle = (np.float32(0.5 * np.pi) - grazing) / grazing
    sigma = p.axial_offset + p.axial_growth * away * away
    sigma += p.axial_angle * np.sqrt(w) * angle * angle
    # The published deviation holds for what the camera tells, rounding included.
    coarse = z * z * p.step
    rounding = (coarse * coarse + p.unit * p.unit) * np.float32(1.0 / 12.0)
    sigma = np.sqrt(max(sigma * sigma - rounding, np.float32(0.0)))
    # 1 / (z + error), to second order.
    error = g * sigma * w
    levels = np.float32(np.int32(w * (one - error + error * error) * p.per_step + half))
    return np.float32(np.int32(p.per_unit / (max(levels, one) * p.step) + half)) * p.unit


@compiled
def _slope(before: Any, after: Any) -> Any:
    # The smaller of both differences: the other one may lie across an edge.
    return before if abs(before) < abs(after) else after


@njit(cache=True, error_model="numpy", fastmath=_COUNTS)
def _incidence_row(
    above: Image,
    centre: Image,
    below: Image,
    rays: Image,
    y: Any,
    fx: Any,
    fy: Any,
    steep: Any,
    cosine: Image,
) -> Any:
    """Fills cosine (W,) with those of incidence of one row; counts the ones below steep."""
    one, tiny = np.float32(1.0), np.float32(1e-20)
    count, nothing = np.float32(0.0), np.float32(0.0)
    for i in range(len(cosine)):
        w, x = centre[i + 1], rays[i]
        n_x = fx * _slope(w - centre[i], centre[i + 2] - w)
        n_y = fy * _slope(w - above[i + 1], below[i + 1] - w)
        n_z = w - n_x * x - n_y * y
        length = (n_x * n_x + n_y * n_y + n_z * n_z) * (one + x * x + y * y)
        cos = w / np.sqrt(length + tiny)
        cosine[i] = cos
        count += one if (cos < steep) & (w > tiny) else nothing
    return count


@njit(cache=True, error_model="numpy", fastmath=_COUNTS)
def _jumps_row(
    above: Image, centre: Image, below: Image, share: Any, jumps: NDArray[np.uint8]
) -> Any:
    """Marks the pixels of a row that differ from a neighbour by a share; counts them."""
    count, one, nothing = np.float32(0.0), np.float32(1.0), np.float32(0.0)
    for i in range(len(centre) - 2):
        w = centre[i + 1]
        across = max(abs(w - centre[i]), abs(w - centre[i + 2]))
        jump = max(max(abs(w - above[i + 1]), abs(w - below[i + 1])), across) > share * w
        jumps[i] = jump
        count += one if jump else nothing
    return count


@compiled
def _measure_row(
    centre: Image,
    cosine: Image,
    valid: NDArray[np.uint8],
    g: Image,
    p: Figures,
    out: Image,
) -> None:
    """One row of measured depths."""
    missing, least = np.float32(np.nan), np.float32(0.02)
    for i in range(len(out)):
        z = _measured(centre[i + 1], max(cosine[i], least), g[i], p)
        out[i] = z if valid[i] else missing


@compiled
def _drop_grazing(key: Any, row: int, cosine: Image, start: float, end: float, out: Image) -> None:
    """Takes out more and more pixels, two by two, between two cosines of incidence."""
    for i in range(len(out)):
        if cosine[i] < start:
            chance = (start - cosine[i]) / (start - end)
            if uniform(hashed(key, GRAZING, row >> 1, i >> 1)) < chance:
                out[i] = np.float32(np.nan)


@compiled
def _join(marks: NDArray[np.uint8], others: NDArray[np.uint8]) -> None:
    for i in range(min(len(marks), len(others))):
        marks[i] |= others[i]


@compiled
def _mark_band(
    jumps: NDArray[np.uint8], counts: IntArray, width: int, near: NDArray[np.uint8]
) -> None:
    """Marks the pixels at most _BAND rows and columns from an edge, of which rows have counts."""
    height = len(jumps)
    wide = np.zeros(width + 2 * _BAND, dtype=np.uint8)
    for row in range(height):
        if not counts[row]:
            continue
        wide[:] = 0
        for shift in range(2 * _BAND + 1):
            _join(wide[shift:], jumps[row])
        for r in range(max(row - _BAND, 0), min(row + _BAND + 1, height)):
            _join(near[r], wide[_BAND : _BAND + width])


@compiled
def _rounded(value: Any) -> int:
    return int(value + np.float32(1000.5)) - 1000


@compiled
def _clamped(value: int, size: int) -> int:
    return min(max(value, 0), size - 1)


@compiled
def _facing(w: Any, g: Any, p: Figures) -> Any:
    """`_measured` at normal incidence."""
    one = np.float32(1.0)
    return _measured(w, one, g, p)


@compiled
def _other_side(row: int, column: int, w: Image, least: Any) -> Any:
    """The neighbour's w that differs most, of those in range."""
    here = w[row, column]
    other = here
    for k in range(4):
        beside = w[row + (k == 0) - (k == 1), column + (k == 2) - (k == 3)]
        if beside >= least and abs(beside - here) > abs(other - here):
            other = beside
    return other


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def _mark_jumps(w: Image, share: Any, jumps: NDArray[np.uint8], counts: IntArray) -> None:
    """`_jumps_row` of each row, and how many it found."""
    for row in range(len(counts)):
        counts[row] = int(_jumps_row(w[row], w[row + 1], w[row + 2], share, jumps[row]))


@compiled
def _frame_key(seed: int, frame: int) -> Any:
    return mixed(mixed(np.uint64(seed) + np.uint64(0x9E3779B97F4A7C15)) + np.uint64(frame))


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def _measure(
    seed: int, frame: int, w: Image, valid: NDArray[np.uint8], K: Image, p: Figures, out: Image
) -> None:
    """Depths as measured where no edge is near, and the pixels lost to grazing incidence."""
    height, width = out.shape
    key = _frame_key(seed, frame)
    cell, share = lattice_along(key, 0, int(p.spacing_u), width)
    line, share_down = lattice_along(key, 1, int(p.spacing_v), height)
    nodes = lattice_nodes(key, line[height - 1] + 2, cell[width - 1] + 2)
    rays = ((np.arange(width) - K[2]) / K[0]).astype(np.float32)
    above_g, below_g = np.empty(width, dtype=np.float32), np.empty(width, dtype=np.float32)
    spread = line[0] - 1
    spread_over(nodes[0], cell, share, below_g)
    g = np.empty(width, dtype=np.float32)
    cosine = np.empty(width, dtype=np.float32)
    for row in range(height):
        above, centre, below = w[row], w[row + 1], w[row + 2]
        y = (np.float32(row) - K[3]) / K[1]
        grazing = _incidence_row(above, centre, below, rays, y, K[0], K[1], p.grazing_start, cosine)
        if line[row] != spread:
            spread = line[row]
            above_g, below_g = below_g, above_g
            spread_over(nodes[spread + 1], cell, share, below_g)
        fill_between(above_g, below_g, share_down[0, row], share_down[1, row], g)
        _measure_row(centre, cosine, valid[row], g, p, out[row])
        if grazing > np.float32(0.0):
            _drop_grazing(key, row, cosine, p.grazing_start, p.grazing_end, out[row])


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def _disturb_edges(
    seed: int,
    frame: int,
    w: Image,
    valid: NDArray[np.uint8],
    jumps: NDArray[np.uint8],
    counts: IntArray,
    near: NDArray[np.uint8],
    p: Figures,
    out: Image,
) -> None:
    """Writes what the pixels near an edge show; near is room to mark them in."""
    height, width = valid.shape
    key = _frame_key(seed, frame)
    patches = patch_nodes(key, height, width)
    near[:] = 0
    _mark_band(jumps, counts, width, near)
    # Looked through a patch's width at a time: few pixels are near an edge.
    fours = near.view(np.uint32)
    missing, nothing = np.float32(np.nan), np.float32(0.0)
    for row in range(height):
        for k in range(fours.shape[1]):
            if fours[row, k] == np.uint32(0):
                continue
            # An edge is displaced by patches; its holes come in patches, flying pixels alone.
            i, first = row >> PATCH_BITS, k << PATCH_BITS
            r = _clamped(row + _rounded(p.lateral * patches[i, k, 0]), height)
            shift = _rounded(p.lateral * patches[i, k, 1])
            hole = patches[i, k, 2] < p.holes
            for column in range(first, min(first + (1 << PATCH_BITS), width)):
                if near[row, column] == 0:
                    continue
                here = w[row + 1, column + 1]
                if jumps[row, column] and valid[row, column]:
                    if hole:
                        out[row, column] = missing
                        continue
                    bits = hashed(key, FLYING, row, column)
                    if uniform(bits) < p.flying:
                        share = np.float32(bits & np.uint64(0xFFFF)) * np.float32(1.0 / 65536.0)
                        other = _other_side(row + 1, column + 1, w, p.least)
                        out[row, column] = _facing(here + share * (other - here), nothing, p)
                        continue
                c = _clamped(column + shift, width)
                there = w[r + 1, c + 1]
                alike = abs(there - here) <= p.edge * max(here, there)
                if alike & (valid[r, c] == valid[row, column]):
                    continue
                if valid[r, c]:
                    g = normal(hashed(key, MOVED, row, column))
                    out[row, column] = _facing(there, g, p)
                else:
                    out[row, column] = missing


def add_noise(
    z: Image,
    K: Image,
    seed: int,
    frame: int,
    p: Figures,
    w: Image,
    valid: NDArray[np.uint8],
    marks: NDArray[np.uint8],
) -> None:
    """Turns a true depth image, in place, into what a structured-light camera tells.

    Args:
        z: (H, W) depth [m]; afterwards NaN is missing.
        K: (4,) fx, fy, cx, cy [pixel].
        seed: of the noise; a whole number.
        frame: of the image; a whole number.
        p: of the camera.
        w, valid, marks: room to work in, (H + 2, W + 2), (H, W) and (2, H, W4), W4 being W
            rounded up to whole patches; whatever it holds is overwritten.
    """
    # Calls from Python, microseconds each: as one kernel the stages are inlined, and lose a
    # third of their speed.
    _inverse_depths(z, p.near, p.far, p.edge, w, valid)
    # All that follows reads w alone.
    out, counts = z, np.empty(len(z), dtype=np.int64)
    jumps, near = marks
    _mark_jumps(w, p.edge, jumps, counts)
    if p.shadow > 0.0:
        _cast_shadows(w, p.shadow, counts, valid)
    _measure(seed, frame, w, valid, K, p, out)
    if counts.any():
        _disturb_edges(seed, frame, w, valid, jumps, counts, near, p, out)
