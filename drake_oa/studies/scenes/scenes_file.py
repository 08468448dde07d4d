"""Scenes files: .npz with the fields of `Scenes`, checked on reading.

`baseline` (N,) [m], `center` (N, M, 3) [m], `semi_axes` (N, M, 3) [m], `R` (N, M, 3, 3),
`velocity` (N, M, 3) [m/s], `clearance` (N,) [m]; NaN rows where an obstacle is absent.
"""

from __future__ import annotations

import math
import zipfile
import zlib
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from drake_oa.common.memory import ArrayHeader, archive_headers, check_memory
from drake_oa.common.messages import FloatArray
from drake_oa.studies.scenes.judge import scene_distance
from drake_oa.studies.scenes.scenes import Scenes

_TRAILING: dict[str, tuple[int, ...]] = {
    "center": (3,),
    "semi_axes": (3,),
    "R": (3, 3),
    "velocity": (3,),
}
_KEYS = tuple(item.name for item in fields(Scenes))
_COPIES = 4
"""How many times the arrays are held while they are read and checked."""
_ORTHONORMAL = 1e-6
_LONGEST = 100.0
"""Greatest baseline of a scene [m]."""
_FARTHEST = 100.0
"""A centre may be farther from the start than this many baselines in no scene."""


def save_scenes(path: Path, scenes: Scenes) -> None:
    """Writes a scenes file."""
    with path.open("wb") as file:
        np.savez_compressed(file, **{name: getattr(scenes, name) for name in _KEYS})


def load_scenes(path: Path) -> Scenes:
    """Reads and checks a scenes file.

    Args:
        path: an .npz file.

    Returns:
        The scenes.

    Raises:
        OSError: if the file cannot be read.
        ValueError: if it is no .npz file, a key is missing, a shape does not fit, a value
            cannot be (naming scene and obstacle), or there is not enough memory for it.
    """
    try:
        headers = archive_headers(path)
        _check_shapes(path, headers)
        size = sum(8 * int(np.prod(headers[name].shape)) for name in _KEYS)
        N, M = headers["center"].shape[:2]
        check_memory(f"{path}: {N} scenes of {M} obstacles", _COPIES * size)
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: np.array(file[name], dtype=float, order="C") for name in _KEYS}
    except (zipfile.BadZipFile, zlib.error, EOFError) as error:
        raise ValueError(f"{path} is not a whole .npz file: {error}") from error
    except MemoryError as error:
        raise ValueError(f"{path}: not enough memory for its arrays") from error
    scenes = Scenes(**arrays)
    check_scenes(scenes, str(path))
    return scenes


def _check_shapes(path: Path, headers: dict[str, ArrayHeader]) -> None:
    missing = [name for name in _KEYS if name not in headers]
    if missing:
        there = ", ".join(headers) or "none"
        raise ValueError(
            f"{path} lacks {', '.join(missing)}; needed: {', '.join(_KEYS)}; there: {there}"
        )
    for name in _KEYS:
        if headers[name].dtype.kind not in "fiu":
            raise ValueError(f"{path}: {name} must hold real numbers, not {headers[name].dtype}")
    N = headers["baseline"].shape[0] if len(headers["baseline"].shape) == 1 else -1
    M = headers["center"].shape[1] if len(headers["center"].shape) == 3 else -1
    for name in _KEYS:
        shape = headers[name].shape
        if name in _TRAILING:
            wanted: tuple[int, ...] = (N, M, *_TRAILING[name])
            text = "(N, M, " + ", ".join(map(str, _TRAILING[name])) + ")"
        else:
            wanted, text = (N,), "(N,)"
        if shape != wanted:
            known = [f"N = {N}"] * (N >= 0) + [f"M = {M}"] * (M >= 0 and name in _TRAILING)
            given = f" with {', '.join(known)}" if known else ""
            raise ValueError(f"{path}: {name} must be {text}{given}, not {shape}")
    if N == 0:
        raise ValueError(f"{path} holds no scene")


def check_scenes(scenes: Scenes, source: str = "scenes") -> None:
    """Raises ValueError, naming scene and obstacle, where a value cannot be.

    Args:
        scenes: scenes of the right shapes.
        source: what they were read from.
    """
    _refuse(
        source,
        "baseline",
        scenes.baseline,
        ~((scenes.baseline > 0.0) & (scenes.baseline <= _LONGEST)),
        f"positive and at most {_LONGEST:g} [m]",
    )
    _refuse(
        source,
        "clearance",
        scenes.clearance,
        ~((scenes.clearance > 0.0) & (scenes.clearance <= scenes.baseline)),
        "positive and at most the baseline [m]",
    )
    absent = np.ones(scenes.center.shape[:2], dtype=bool)
    complete = np.ones(scenes.center.shape[:2], dtype=bool)
    for name in _TRAILING:
        size = math.prod(_TRAILING[name])
        values = getattr(scenes, name).reshape(*absent.shape, size)
        absent &= np.isnan(values).all(axis=-1)
        complete &= np.isfinite(values).all(axis=-1)
    _refuse(
        source,
        "center, semi_axes, R or velocity",
        scenes.center,
        ~(absent | complete),
        "finite, or NaN in all four where it is absent",
    )
    _refuse(
        source,
        "semi_axes",
        scenes.semi_axes,
        complete & ~(scenes.semi_axes > 0.0).all(axis=-1),
        "positive [m]",
    )
    distance = np.linalg.norm(scenes.center, axis=-1)
    _refuse(
        source,
        "center",
        scenes.center,
        complete & (distance > _FARTHEST * scenes.baseline[:, None]),
        f"within {_FARTHEST:g} baselines of the start [m] (is it in millimetres?)",
    )
    R = np.where(complete[..., None, None], scenes.R, np.eye(3))
    off = np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)).max(axis=(-1, -2), initial=0.0)
    _refuse(
        source,
        "R",
        scenes.R,
        complete & ((off > _ORTHONORMAL) | (np.linalg.det(R) < 0.0)),
        "a rotation: orthonormal to 1e-6, right-handed",
    )
    distance = scene_distance(scenes, np.zeros((len(scenes), 3)), np.zeros(len(scenes)))
    inside = distance <= 0.0
    if inside.any():
        row = int(np.argmax(inside))
        raise ValueError(
            f"{source}: the start of scene {row} lies {-distance[row]:.3g} m inside an obstacle; "
            f"it must be outside all of them{_more(inside)}"
        )


def _refuse(source: str, name: str, values: FloatArray, bad: Any, valid: str) -> None:
    """Raises ValueError for the first bad row (N,) or (N, M), if any."""
    if not bad.any():
        return
    place = tuple(int(i) for i in np.unravel_index(int(np.argmax(bad)), bad.shape))
    where = f"scene {place[0]}" + (f", obstacle {place[1]}" if len(place) > 1 else "")
    shown = np.array2string(np.asarray(values[place]), separator=", ").replace("\n", "")
    raise ValueError(f"{source}: {name} of {where} must be {valid}, not {shown}{_more(bad)}")


def _more(bad: Any) -> str:
    """How many rows are bad, where it is more than the one that is named."""
    return f" ({int(bad.sum())} such rows)" if bad.sum() > 1 else ""
