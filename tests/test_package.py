"""Systems that the package exports, and its lazy imports."""

import subprocess
import sys

from pydrake.systems.framework import LeafSystem

import drake_oa


def test_package_exports_the_system_of_each_layer() -> None:
    assert all(issubclass(getattr(drake_oa, name), LeafSystem) for name in drake_oa.__all__)
    assert set(drake_oa.__all__) <= set(dir(drake_oa))


def test_package_import_loads_no_large_package() -> None:
    source = (
        "import sys, drake_oa\n"
        "print([name for name in ('pydrake', 'numba', 'numpy') if name in sys.modules])"
    )
    answer = subprocess.run(
        [sys.executable, "-c", source], capture_output=True, text=True, check=True
    )
    assert answer.stdout == "[]\n"
