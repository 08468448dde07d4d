"""`from drake_oa import X` for each layer's system, and nothing before it is asked for."""

import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
from pydrake.systems.framework import LeafSystem

import drake_oa

LAYERS = (
    "perception",
    "descriptor",
    "route",
    "regulation",
    "planning",
    "policy",
    "posture",
    "safety",
    "control",
    "viewing",
)


def systems() -> dict[str, type]:
    """The LeafSystems that the layers' folders define, without base classes."""
    found = {}
    for layer in LAYERS:
        for file in (Path(drake_oa.__file__).parent / layer).glob("*.py"):
            module = import_module(f"drake_oa.{layer}.{file.stem}")
            found |= {
                name: item
                for name, item in vars(module).items()
                if isinstance(item, type)
                and issubclass(item, LeafSystem)
                and item.__module__ == module.__name__
                and not item.__subclasses__()
                and not name.startswith("_")
            }
    return found


def test_every_layer_is_found_in_the_package() -> None:
    assert {name: getattr(drake_oa, name) for name in drake_oa.__all__} == systems()
    assert set(drake_oa.__all__) <= set(dir(drake_oa))


def test_what_is_not_there_is_told() -> None:
    with pytest.raises(ImportError, match="cannot import name 'Lidar'"):
        from drake_oa import Lidar  # noqa: F401
    with pytest.raises(AttributeError, match="'drake_oa' has no attribute 'Lidar'"):
        _ = drake_oa.Lidar


def test_the_package_alone_imports_nothing_heavy() -> None:
    source = (
        "import sys, drake_oa\n"
        "print([name for name in ('pydrake', 'numba', 'numpy') if name in sys.modules])"
    )
    answer = subprocess.run(
        [sys.executable, "-c", source], capture_output=True, text=True, check=True
    )
    assert answer.stdout == "[]\n"
