"""File helpers: output checks before long computations, atomic replacement, software versions."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import UTC, datetime
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

# Where it is used: commands that compute nothing answer at once.
if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

_SOURCES = {
    "drake_oa": ("*.py",),
    "drake_oa.diagrams": ("*.py", "*.scenario.yaml"),
    "drake_oa.models": ("*.sdf", "*.yaml", "*.urdf", "*.obj", "*.npz", "*.safetensors"),
}
"""Patterns of the files of each package that `source_digest` covers."""
_NOT_IN_DIGEST = ("app", "benchmark.py", "diagrams", "hardware", "models", "training", "viewing")
"""Parts of drake_oa that no simulated motion depends on, or that are packages of `_SOURCES`."""

_PLOT_STYLE: tuple[Any, ...] = ("tableau-colorblind10", {"axes.grid": True, "legend.fontsize": 7})
"""Matplotlib styles of all figures; color-blind readers can distinguish the colors."""


class OutputError(OSError):
    """A file that could not be written; the message names the file."""


def check_outputs(*paths: Path | None, read: Iterable[Path] = ()) -> None:
    """Makes the folders of files that are to be written; leaves the files as they are.

    Args:
        paths: the files; None for one that is not asked for.
        read: files that the command reads, which no output may replace.

    Raises:
        ValueError: naming the first that cannot be written, and why.
    """
    taken = dict.fromkeys((path.resolve() for path in read), "the command reads this file")
    for path in filter(None, paths):
        if why := taken.get(path.resolve()):
            raise ValueError(
                f"cannot write {path}: {why}; inputs and outputs must name different files"
            )
        taken[path.resolve()] = "another output names this file"
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            known = path.exists()
            path.open("ab").close()
        except OSError as error:
            why = f"{error.strerror}: {error.filename}"
            raise ValueError(f"cannot write {path}: {why}") from None
        if not known:
            path.unlink()


def reserve_file(folder: Path, stem: str, suffix: str) -> Path:
    """Makes an empty file `folder/stem-TIME suffix` that no other process has or will get.

    TIME is UTC, to a microsecond.

    Raises:
        ValueError: if the folder or the file cannot be made; names it, and why.
    """
    path = folder / f"{stem}-{datetime.now(UTC):%Y%m%dT%H%M%S.%fZ}{suffix}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        path.touch(exist_ok=False)
        return path
    except OSError as error:
        raise ValueError(f"cannot write to the folder {folder}: {error.strerror}") from None


def replace_file(path: Path, write: Callable[[Path], object]) -> None:
    """Writes a file, and its folder, in one piece: an earlier file stays whole until then.

    A file that is not regular, as /dev/stdout, is written to.

    Args:
        path: the file.
        write: called with the path to write to.

    Raises:
        OutputError: if the file cannot be written.
    """
    try:
        # Before the link is followed: that of /dev/stdout may lead to no path at all.
        if path.exists() and not path.is_file():
            write(path)
            return
        target = path.resolve()
        target.parent.mkdir(parents=True, exist_ok=True)
        # Of this process alone: another may be writing the same file.
        beside = target.with_name(f"{target.name}.{os.getpid()}.part")
        try:
            write(beside)
            os.replace(beside, target)
        except BaseException:
            beside.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror or error}") from error


def replace_text(path: Path, text: str) -> None:
    """Writes a text file in one piece; see `replace_file`."""
    replace_file(path, lambda beside: beside.write_text(text))


def replace_json(path: Path | None, content: object) -> None:
    """Writes plain data as JSON in one piece; see `replace_file`.

    Args:
        path: the file; None: nothing is written.
        content: plain data.

    Raises:
        OutputError: if the file cannot be written.
        ValueError: if a number is not finite.
    """
    if path is not None:
        replace_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def replace_arrays(path: Path, arrays: Mapping[str, Any]) -> None:
    """Writes arrays by name as a compressed .npz archive in one piece; see `replace_file`."""
    import numpy as np

    def write(beside: Path) -> None:
        # An open file, as NumPy adds .npz to the name of a path.
        with beside.open("wb") as file:
            np.savez_compressed(file, **arrays)

    replace_file(path, write)


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Reads the arrays of an .npz archive by name.

    Raises:
        OSError: if the file cannot be opened.
        ValueError: if it is not such an archive, is damaged, or holds Python objects.
    """
    import numpy as np

    with path.open("rb") as file:
        try:
            with np.load(file, allow_pickle=False) as arrays:
                return dict(arrays)
        except Exception as error:
            # Damage shows in the archive, in its decompression, or in the headers of arrays.
            raise ValueError(f"{path} cannot be read as .npz: {error}") from None


def cached_arrays(
    name: str, compute: Callable[[], Mapping[str, Any]]
) -> Mapping[str, NDArray[Any]]:
    """Reads arrays from a file of the user's cache; computes and writes them if it has none.

    Args:
        name: name of the file without suffix: folder, and digest of all that the arrays depend on.
        compute: makes the arrays by name.
    """
    path = user_cache(f"{name}.npz")
    try:
        return read_arrays(path)
    except (OSError, ValueError):
        arrays = compute()
        with contextlib.suppress(OSError):
            replace_arrays(path, arrays)
        return arrays


@contextlib.contextmanager
def saved_figure(path: Path, width: float, height: float, title: str = "") -> Iterator[Figure]:
    """Provides an empty figure in the common style, and writes it in one piece after the block.

    Args:
        path: the file; its suffix gives the format.
        width: of the figure [inch].
        height: of the figure [inch].
        title: of the figure.

    Raises:
        OutputError: if the file cannot be written.
    """
    from matplotlib import style
    from matplotlib.figure import Figure

    with style.context(_PLOT_STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        figure.suptitle(title)
        yield figure
        kind = path.suffix.removeprefix(".")
        replace_file(path, lambda beside: figure.savefig(beside, format=kind, dpi=140))


def user_cache(name: str) -> Path:
    """Returns the folder of the user's cache for a kind of results; it need not exist."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "drake_oa" / name


def package_folder(name: str) -> Path:
    """Returns the folder of a package."""
    return Path(import_module(name).__path__[0])


def package_file(url_or_file: str) -> Path:
    """Returns the file of a `package://drake_oa/...` URL, or the path itself."""
    name = url_or_file.removeprefix("package://drake_oa/")
    return package_folder("drake_oa.models") / name if name != url_or_file else Path(name)


def import_extra(module: str, extra: str) -> Any:
    """Imports a module of an optional dependency.

    Raises:
        ValueError: naming the package that is not installed, and the extra to install.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise ValueError(
            f"requires the package {error.name}: pip install 'drake_oa[{extra}]'"
        ) from error


def installed_package(name: str) -> Path | None:
    """The folder behind package://NAME of something that is installed for this Python.

    That is share/NAME of the distribution NAME, or the package that is imported as NAME; which
    is not imported here. None: there is neither.
    """
    from importlib import metadata

    with contextlib.suppress(metadata.PackageNotFoundError, ValueError):
        for file in metadata.distribution(name).files or ():
            prefix, share, _ = str(file.locate()).partition(f"/share/{name}/")
            if share:
                return Path(prefix) / "share" / name
    found = find_spec(name) if name.isidentifier() else None
    places = list(found.submodule_search_locations or ()) if found else []
    return Path(places[0]) if places else None


@cache
def source_digest() -> str:
    """SHA-256 of the source and model files that a simulated motion depends on, in hex.

    Computed once per process, so that files edited during a run do not change it.
    """
    import hashlib

    digest = hashlib.sha256()
    for package, patterns in _SOURCES.items():
        folder = package_folder(package)
        for path in sorted(p for pattern in patterns for p in folder.rglob(pattern)):
            relative = path.relative_to(folder)
            if relative.parts[0] not in _NOT_IN_DIGEST:
                digest.update(str(relative).encode())
                digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def provenance() -> dict[str, str]:
    """Version of this package, today's date (UTC) and source digest, to be kept with a result."""
    from importlib.metadata import version

    return {
        "version": version("drake_oa"),
        "date": f"{datetime.now(UTC):%Y-%m-%d}",
        "source_digest": source_digest(),
    }


def software_versions() -> dict[str, str]:
    """Returns versions of packages, date and source digest, on which a result depends."""
    from importlib.metadata import PackageNotFoundError, version

    found = {}
    for name in ("drake_oa", "drake", "numpy", "scipy", "open3d", "open3d-cpu"):
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    made = provenance()
    return found | {key: made[key] for key in ("date", "source_digest")}
