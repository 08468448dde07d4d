"""`from drake_oa import X` for each layer's system, and nothing before it is asked for."""

import subprocess
import sys

from pydrake.systems.framework import LeafSystem

import drake_oa


def test_every_layer_is_found_in_the_package() -> None:
    assert all(issubclass(getattr(drake_oa, name), LeafSystem) for name in drake_oa.__all__)
    assert set(drake_oa.__all__) <= set(dir(drake_oa))


def test_the_package_alone_imports_nothing_heavy() -> None:
    source = (
        "import sys, drake_oa\n"
        "print([name for name in ('pydrake', 'numba', 'numpy') if name in sys.modules])"
    )
    answer = subprocess.run(
        [sys.executable, "-c", source], capture_output=True, text=True, check=True
    )
    assert answer.stdout == "[]\n"
