"""Fixtures shared by all tests."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

# The machine may be busy: no property is judged by the time an example takes.
settings.register_profile("drake_oa", deadline=None)
settings.load_profile("drake_oa")

_SHARED = Path(__file__).resolve().parents[2] / "shared"


@pytest.fixture(scope="session")
def reference() -> Callable[[str], Path]:
    """Path of a reference data file by name; skips the test where it is absent."""

    def find(name: str) -> Path:
        path = _SHARED / "reference" / name
        if not path.is_file():
            pytest.skip(f"reference data {name} is not here")
        return path

    return find


@pytest.fixture(scope="session")
def scan_files() -> list[Path]:
    """The real depth scans; skips the test where they are absent."""
    files = sorted((_SHARED / "scans").glob("*.npz"))
    if not files:
        pytest.skip("the real depth scans are not here")
    return files


@pytest.fixture(scope="session")
def recording_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one recorded cloud: a small box on a table, in the world frame."""
    folder = tmp_path_factory.mktemp("recording")
    grid = np.arange(-0.5, 0.5, 0.004)
    x, y = (axis.ravel() for axis in np.meshgrid(grid, grid))
    table = np.column_stack([x, y, np.zeros_like(x)])
    side = np.arange(-0.05, 0.05, 0.003)
    u, v = (axis.ravel() for axis in np.meshgrid(side, side))
    top = np.column_stack([u, v, np.full_like(u, 0.1)])
    front = np.column_stack([np.full_like(u, 0.05), u, v + 0.05])
    points = np.concatenate([table, top, front]) + [0.45, 0.0, 0.0]
    np.savez(folder / "cloud_0.000.npz", points=points, X_WC=np.eye(4), stamp=0.0)
    return folder
