"""The methods that can be compared, by name; each is imported when it is asked for.

A method is a function `run(scenes, setting) -> Motions`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import import_module

from drake_oa.common.messages import BoolArray, FloatArray, Frozen
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


@dataclass(frozen=True, eq=False)
class Motions(Frozen):
    """N motions at S + 1 equally spaced instants from t = 0 to their duration.

    Attributes:
        path: (N, S + 1, 3) positions [m].
        velocity: (N, S + 1, 3) velocities dp/dt at those instants [m/s].
        duration: (N,) tau T, the end of the scaled duration [s].
        seconds: computing time of the whole batch [s], regulation included,
            compilation excluded.
        in_range: (N,) whether the regressor chain was asked within its trained range; None:
            there is none, or it does not tell.
    """

    path: FloatArray
    velocity: FloatArray
    duration: FloatArray
    seconds: float
    in_range: BoolArray | None = None

    def __len__(self) -> int:
        return len(self.path)

    @property
    def steps(self) -> int:
        """Steps of each motion."""
        return self.path.shape[1] - 1


Method = Callable[[Scenes, Setting], Motions]


def _imported(module: str, name: str = "run") -> Method:
    try:
        run: Method = getattr(import_module(f"drake_oa.studies.scenes.{module}"), name)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in ("movement_primitives", "pytransform3d"):
            raise
        raise ValueError(
            f"method movement_primitives needs the package {error.name}: "
            "pip install 'drake_oa[peers]'"
        ) from error
    return run


METHODS: dict[str, Callable[[], Method]] = {
    "paper": partial(_imported, "paper_method"),
    "verified": partial(_imported, "verified"),
    "original": partial(_imported, "paper_method", "run_original"),
    "movement_primitives": partial(_imported, "peers"),
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
