"""The methods that can be compared, by name; each is imported when it is asked for.

A method is a function `run(scenes, setting) -> Motions` in a module of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import import_module

from drake_oa.studies.scenes.motions import Motions
from drake_oa.studies.scenes.scenes import Scenes


@dataclass(frozen=True)
class Setting:
    """How the paper's experiments on familiar scenarios vary the method.

    Attributes:
        constrained: RC(lambda', Delta), else RC(lambda'), which asks for no clearance:
            that of the scenes is then 0.
        scale_time: tau = length of the avoiding path over that of the planned one, else
            tau = 1.
    """

    constrained: bool = True
    scale_time: bool = True


Method = Callable[[Scenes, Setting], Motions]


def _imported(module: str, name: str = "run") -> Method:
    try:
        run: Method = getattr(import_module(f"drake_oa.studies.scenes.{module}"), name)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "movement_primitives":
            raise
        raise ValueError(
            "method movement_primitives needs the package of that name: "
            "pip install 'drake_oa[peers]'"
        ) from error
    return run


METHODS: dict[str, Callable[[], Method]] = {
    "paper": partial(_imported, "paper_method"),
    "verified": partial(_imported, "verified"),
    "original": partial(_imported, "original_method"),
    "movement_primitives": partial(_imported, "peers"),
    "verified_constant": partial(_imported, "verified", "run_constant"),
}
"""Name of a method -> what imports it."""

DEFAULT_METHODS = ("paper", "verified")


def check_method(name: str) -> None:
    """Raises ValueError for an unknown name."""
    if name not in METHODS:
        raise ValueError(f"unknown method {name!r}; valid: {', '.join(METHODS)}")


def load_method(name: str) -> Method:
    """The method of a name.

    Raises:
        ValueError: for an unknown name, or one whose package is not installed.
    """
    check_method(name)
    return METHODS[name]()
