"""`drake-oa`: its commands, its messages and its exit statuses."""

from __future__ import annotations

import contextlib
import logging
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Any, TextIO

from cyclopts import App, CycloptsError, Group, Parameter
from rich.console import Console

from drake_oa.common.console import BAD_INPUT, FAILED, INTERRUPTED, complain

_COMPILATION = {
    "run": "2 to 4 minutes",
    "play": "2 to 4 minutes",
    "station": None,
    "replay": None,
    "plot": None,
    "graph": None,
    "check": None,
    "perceive": "half a minute",
    "benchmark": "2 minutes",
    "synthetic": "2 to 4 minutes",
    "panda": "2 to 4 minutes",
    "mbm": "2 to 4 minutes",
    "train": "half a minute",
}
"""Functions that compute -> about how long their kernels take to compile, where that is known."""

_HELP = """\
Reactive obstacle avoidance for a manipulator, as Drake systems.

For example:

    drake-oa scenarios
    drake-oa run tabletop_box --html box.html --json box.json
    drake-oa run tabletop_box --set 'perception=!GroundTruth {}' --set task.clearance=0.1
    drake-oa new my
    drake-oa check my.scenario.yaml
    drake-oa run my.scenario.yaml --meshcat
    drake-oa replay drake_oa_runs/tabletop_box-20250131T120000Z.npz --meshcat
    drake-oa plot drake_oa_runs/tabletop_box-20250131T120000Z.npz
    drake-oa graph tabletop_box > wiring.svg
"""


_COMMANDS = {
    "run": "run",
    "play": "play",
    "station": "run",
    "replay": "replay",
    "plot": "replay",
    "scenarios": "scenarios",
    "new": "scenarios",
    "check": "scenarios",
    "graph": "scenarios",
    "perceive": "perceive",
    "benchmark": "benchmark",
    "evaluate": "evaluate",
    "train": "train",
}
"""Command -> module of this package, where it is a function or an `App` of that name."""


def _shown_default(value: Any) -> str | None:
    if value is None or value is False or value == ():
        return None
    return ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _versions() -> str:
    from importlib.metadata import version

    return f"drake-oa {version('drake_oa')} (drake {version('drake')})"


def _app() -> App:
    """The commands; the module of one is imported when it is asked for."""
    app = App(
        name="drake-oa",
        help=_HELP,
        help_format="plaintext",
        help_formatter="default" if sys.stdout.isatty() else "plain",
        console=None if sys.stdout.isatty() else Console(width=100),
        version=_versions,
        default_parameter=Parameter(negative=(), allow_repeating=True, show_default=_shown_default),
    )
    app.register_install_completion_command(
        name="--install-completion",
        help="complete commands and options in bash, zsh or fish",
        add_to_startup=False,
    )
    for number, (name, module) in enumerate(_COMMANDS.items()):
        app.command(f"drake_oa.app.{module}:{name}", name=name, sort_key=number)
    return app


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line; returns the exit status."""
    tokens = sys.argv[1:] if arguments is None else list(arguments)
    app = _app()
    if not any(name in tokens for name in _COMMANDS):
        # For the list of commands, what each is for is read from its module.
        for name in _COMMANDS:
            app[name]

    @app.meta.default
    def launch(
        *words: Annotated[str, Parameter(show=False, allow_leading_hyphen=True)],
        verbose: Annotated[bool, Parameter(group=Group("With every command"))] = False,
    ) -> int:
        """Runs a command.

        Args:
            words: the command and its arguments.
            verbose: more messages, and a traceback with an error.
        """
        level = logging.INFO if verbose else logging.WARNING
        logging.basicConfig(
            format="%(levelname)s: %(message)s", level=level, handlers=[_StderrHandler()]
        )
        command, bound, _ = app.parse_args(words, exit_on_error=False, print_error=False)
        with _computing(command, level):
            return command(*bound.args, **bound.kwargs) or 0

    try:
        status: int | None = app.meta(
            tokens, exit_on_error=False, print_error=False, result_action="return_value"
        )
        sys.stdout.flush()
        return (status or 0) if tokens else BAD_INPUT
    except BrokenPipeError:
        # Whoever read our output has seen enough. Python flushes once more at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except CycloptsError as error:
        words = [name for name in tokens[:1] if name in _COMMANDS]
        complain(f"{error} See drake-oa {' '.join([*words, '--help'])}")
        return BAD_INPUT
    except (ValueError, OSError) as error:
        logging.getLogger(__name__).info("where it happened", exc_info=True)
        complain(str(error))
        return BAD_INPUT
    except KeyboardInterrupt:
        complain("interrupted")
        return INTERRUPTED


@contextlib.contextmanager
def _computing(command: Callable[..., Any], level: int) -> Iterator[None]:
    """Round a command that computes: one BLAS thread, and a word when kernels are compiled."""
    name = command.__name__
    if name not in _COMPILATION:
        yield
        return
    # Loads pydrake, which sets the level of its log anew, and the libraries to be limited.
    from threadpoolctl import threadpool_limits

    import drake_oa.scenario.loading  # noqa: F401
    from drake_oa.common.numba_tools import announced_compilation

    logging.getLogger("drake").setLevel(level)
    # Many small matrices: more BLAS threads only wait for each other.
    with threadpool_limits(limits=1), announced_compilation(_COMPILATION[name]):
        yield


class _StderrHandler(logging.StreamHandler[TextIO]):
    """Writes to what stderr is by then: a progress display may stand in for it."""

    @property
    def stream(self) -> TextIO:
        return sys.stderr

    @stream.setter
    def stream(self, value: TextIO) -> None:
        pass


if __name__ == "__main__":
    sys.exit(main())
