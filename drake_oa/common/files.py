"""File helpers: output checks before long computations, atomic replacement, software versions."""

from __future__ import annotations

import contextlib
import json
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import UTC, datetime
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

# Slow modules are imported where they are used, so that commands without them start quickly.
if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

_SOURCES = {
    "drake_oa": ("*.py",),
    "drake_oa.diagrams": ("*.py", "*.scenario.yaml"),
    "drake_oa.models": ("*.sdf", "*.yaml", "*.urdf", "*.obj", "*.npz", "*.safetensors"),
}
"""Name patterns of the files of which `source_digest` computes a hash, by Python package."""
_NOT_IN_DIGEST = ("app", "benchmark.py", "diagrams", "hardware", "models", "training", "viewing")
"""Folders and files of a package that are not part of the hash that `source_digest` computes.

They do not affect simulated motions, or are packages with their own entry in `_SOURCES`."""

_PLOT_STYLE: tuple[Any, ...] = ("tableau-colorblind10", {"axes.grid": True, "legend.fontsize": 7})
"""Matplotlib styles of all figures of this package, with colors for color-blind readers."""


class OutputError(OSError):
    """Error for a file that cannot be written, with a message that names the file."""


@contextlib.contextmanager
def output_errors(path: Path) -> Iterator[None]:
    """Converts an OSError in the `with` block, which writes a file, to an `OutputError`.

    Args:
        path: path of the file, which the message of the error names.
    """
    try:
        yield
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror or error}") from error


def check_outputs(*paths: Path | None, read: Iterable[Path] = ()) -> None:
    """Creates the folders of output files and checks that the files can be written.

    Existing files stay unchanged.

    Args:
        paths: output files; None: no output.
        read: input files of the command, which no output file may replace.

    Raises:
        ValueError: for the first file that cannot be written; names the file and the reason.
    """
    conflicts = dict.fromkeys((path.resolve() for path in read), "the command reads this file")
    for path in filter(None, paths):
        if reason := conflicts.get(path.resolve()):
            raise ValueError(
                f"cannot write {path}: {reason}; inputs and outputs must name different files"
            )
        conflicts[path.resolve()] = "another output names this file"
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            existed = path.exists()
            path.open("ab").close()
        except OSError as error:
            reason = f"{error.strerror}: {error.filename}"
            raise ValueError(f"cannot write {path}: {reason}") from None
        if not existed:
            path.unlink()


def reserve_file(folder: Path, stem: str, suffix: str) -> Path:
    """Creates an empty file <folder>/<stem>-<time><suffix> whose name is unique among processes.

    Args:
        folder: folder of the file, created if missing.
        stem: beginning of the file name; the current UTC time in microseconds follows.
        suffix: suffix of the file name, with its dot.

    Returns:
        Path of the file.

    Raises:
        ValueError: if the file cannot be created; names the folder and the reason.
    """
    path = folder / f"{stem}-{datetime.now(UTC):%Y%m%dT%H%M%S.%fZ}{suffix}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        path.touch(exist_ok=False)
        return path
    except OSError as error:
        raise ValueError(f"cannot write to the folder {folder}: {error.strerror}") from None


def replace_file(path: Path, write: Callable[[Path], object]) -> None:
    """Replaces a file atomically: readers see the old content until the new one is complete.

    Missing folders are created. A file that is not regular, such as /dev/stdout, is written
    directly.

    Args:
        path: file to replace.
        write: function that writes the content to the path it is called with.

    Raises:
        OutputError: if the file cannot be written.
    """
    with output_errors(path):
        # Checked before the link is resolved: that of /dev/stdout may not be a valid path.
        if path.exists() and not path.is_file():
            write(path)
            return
        target = path.resolve()
        target.parent.mkdir(parents=True, exist_ok=True)
        # The process ID makes the name unique: another process may be writing the same file.
        temporary = target.with_name(f"{target.name}.{os.getpid()}.part")
        try:
            write(temporary)
            os.replace(temporary, target)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise


def replace_text(path: Path, text: str) -> None:
    """Replaces a text file atomically, by `replace_file`; missing folders are created."""
    replace_file(path, lambda temporary: temporary.write_text(text))


def replace_json(path: Path | None, content: object) -> None:
    """Replaces a JSON file atomically, by `replace_file`.

    Args:
        path: file to replace; None: nothing is written.
        content: dictionaries, lists, texts, numbers and None.

    Raises:
        OutputError: if the file cannot be written.
        ValueError: if a number is not finite.
    """
    if path is not None:
        replace_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def replace_arrays(path: Path, arrays: Mapping[str, Any]) -> None:
    """Replaces a compressed .npz archive atomically, by `replace_file`.

    Args:
        path: file to replace.
        arrays: arrays by name.

    Raises:
        OutputError: if the file cannot be written.
    """
    import numpy as np

    def write(temporary: Path) -> None:
        # NumPy would append .npz to the name of a path, but not to an open file.
        with temporary.open("wb") as file:
            np.savez_compressed(file, **arrays)

    replace_file(path, write)


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Reads an .npz archive, and returns its arrays by name.

    Raises:
        OSError: if the file cannot be opened.
        ValueError: if the file is not an .npz archive, is damaged, or contains Python objects.
    """
    import numpy as np

    with path.open("rb") as file:
        try:
            with np.load(file, allow_pickle=False) as arrays:
                return dict(arrays)
        except Exception as error:
            # Depending on the damage, zipfile, zlib or NumPy raises, each with its own errors.
            raise ValueError(f"{path} cannot be read as .npz: {error}") from None


def cached_arrays(
    name: str, compute: Callable[[], Mapping[str, Any]]
) -> Mapping[str, NDArray[Any]]:
    """Returns the results of a slow computation, which are cached in a file in the user's cache.

    If the file is missing or damaged, the results are computed and, if possible, saved.

    Args:
        name: <folder>/<digest>, the name of the file in the cache without suffix. The digest must
            be a hash of all inputs of the computation.
        compute: function that computes the results, arrays by name.

    Returns:
        Arrays by name.
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
    """Provides an empty figure in the style of this package, and saves it after the `with` block.

    The file is replaced atomically.

    Args:
        path: output file; its suffix determines the format.
        width: width of the figure [inch].
        height: height of the figure [inch].
        title: title of the figure.

    Yields:
        Matplotlib figure without axes.

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
        replace_file(path, lambda temporary: figure.savefig(temporary, format=kind, dpi=140))


def user_cache(name: str) -> Path:
    """Returns the path of a file or folder in the user's cache, which may not exist yet.

    Args:
        name: path relative to the cache folder of this package, ~/.cache/drake_oa by default.
    """
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "drake_oa" / name


def package_folder(name: str) -> Path:
    """Imports a Python package and returns its folder."""
    return Path(import_module(name).__path__[0])


def package_file(url_or_file: str) -> Path:
    """Returns the path of a file that is given as a path or as a `package://drake_oa/...` URL.

    Such a URL names a file in the package's folder `models`.
    """
    name = url_or_file.removeprefix("package://drake_oa/")
    return package_folder("drake_oa.models") / name if name != url_or_file else Path(name)


def import_extra(module: str, extra: str) -> Any:
    """Imports a module of an optional dependency, and returns the module.

    Args:
        module: name of the module.
        extra: name of the pip extra of this package that installs the dependency.

    Raises:
        ValueError: if the dependency is not installed; names the missing package and the extra.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise ValueError(
            f"requires the package {error.name}: pip install 'drake_oa[{extra}]'"
        ) from error


def installed_package(name: str) -> Path | None:
    """Returns the folder of package://<name> if a package `name` is installed in the environment.

    The folder is share/<name> among the installed files of the Python distribution `name`,
    otherwise the folder of the Python package `name`. The package is not imported.

    Returns:
        Path of the folder; None if there is neither.
    """
    from importlib import metadata

    with contextlib.suppress(metadata.PackageNotFoundError, ValueError):
        for file in metadata.distribution(name).files or ():
            prefix, share, _ = str(file.locate()).partition(f"/share/{name}/")
            if share:
                return Path(prefix) / "share" / name
    spec = find_spec(name) if name.isidentifier() else None
    places = list(spec.submodule_search_locations or ()) if spec else []
    return Path(places[0]) if places else None


_TEXT = re.compile(rb'^\s*(?:#.*$|r?"""(?s:.*?)"""\s*$)|("""(?s:.*?)""")', re.MULTILINE)
"""Regular expression of the parts of a Python file that do not enter the hash of `source_digest`:
comment lines and docstrings, with blank lines before them. The capture group matches other strings
in triple quotes, which do enter the hash."""


@cache
def source_digest() -> str:
    """Returns the hexadecimal SHA-256 of all source and model files that affect simulated motions.

    Comment lines and docstrings are ignored. The digest is computed once per process, so that
    editing files during a run does not change it.
    """
    import hashlib

    digest = hashlib.sha256()
    for package, patterns in _SOURCES.items():
        folder = package_folder(package)
        for path in sorted(p for pattern in patterns for p in folder.rglob(pattern)):
            relative = path.relative_to(folder)
            if relative.parts[0] not in _NOT_IN_DIGEST:
                content = path.read_bytes()
                code = _TEXT.sub(rb"\1", content) if path.suffix == ".py" else content
                digest.update(str(relative).encode())
                digest.update(hashlib.sha256(code).digest())
    return digest.hexdigest()


def provenance() -> dict[str, str]:
    """Returns the provenance of a result as texts by name.

    These are "version" (of this package), "date" (UTC) and "source_digest", the hash of the source
    and model files that affect simulated motions.
    """
    from importlib.metadata import version

    return {
        "version": version("drake_oa"),
        "date": f"{datetime.now(UTC):%Y-%m-%d}",
        "source_digest": source_digest(),
    }


def software_versions() -> dict[str, str]:
    """Returns the versions of drake_oa, Drake, NumPy, SciPy and Open3D, as far as they are
    installed, by package name.

    The keys "date" (UTC) and "source_digest" are added. The latter is the hash of the source and
    model files of this package that affect simulated motions.
    """
    from importlib.metadata import PackageNotFoundError, version

    versions = {}
    for name in ("drake_oa", "drake", "numpy", "scipy", "open3d", "open3d-cpu"):
        with contextlib.suppress(PackageNotFoundError):
            versions[name] = version(name)
    source = provenance()
    return versions | {key: source[key] for key in ("date", "source_digest")}
