"""Simulate, evaluate and execute reactive obstacle avoidance of robot arms, as Drake systems.

For example:

    drake-oa scenarios
    drake-oa run tabletop_box --html box.html --json box.json
    drake-oa run tabletop_box --set 'perception=!GroundTruth {}' --set task.clearance=0.1
    drake-oa new my
    drake-oa check my.scenario.yaml
    drake-oa run my.scenario.yaml --meshcat
    drake-oa replay drake_oa_runs/tabletop_box-20250131T120000Z.npz --meshcat
    drake-oa plot drake_oa_runs/tabletop_box-20250131T120000Z.npz
    drake-oa export drake_oa_runs/tabletop_box-20250131T120000Z.npz box.mcap
    drake-oa graph tabletop_box > layers.svg
"""

from __future__ import annotations

import contextlib
import errno
import gc
import logging
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Any

from cyclopts import App, CycloptsError, Group, Parameter
from rich.console import Console

from drake_oa.common.console import BAD_INPUT, FAILED, INTERRUPTED, complain, is_interrupt
from drake_oa.common.files import OutputError

_COMMANDS = {
    "run": "run",
    "play": "play",
    "station": "run",
    "replay": "replay",
    "plot": "replay",
    "export": "replay",
    "scenarios": "scenarios",
    "new": "scenarios",
    "check": "scenarios",
    "graph": "scenarios",
    "perceive": "perceive",
    "benchmark": "benchmark",
    "evaluate": "evaluate",
    "train": "train",
}
"""Module in `drake_oa.app` of each command, by name. The module has a function or an `App` with the
name of the command."""


def _shown_default(value: Any) -> str | None:
    """Returns the text of an option's default value, for the help; None: the help omits it."""
    if value is None or value is False or value == ():
        return None
    return ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _versions() -> str:
    """Returns one line with the versions of drake_oa and Drake, for `drake-oa --version`."""
    from importlib.metadata import version

    return f"drake-oa {version('drake_oa')} (drake {version('drake')})"


def _app() -> App:
    """Creates the cyclopts `App` of the command line `drake-oa`, which imports the module of a
    command at its first use.
    """
    app = App(
        name="drake-oa",
        help=__doc__,
        help_format="plaintext",
        help_formatter="default" if sys.stdout.isatty() else "plain",
        console=None if sys.stdout.isatty() else Console(width=100),
        version=_versions,
        default_parameter=Parameter(negative=(), allow_repeating=True, show_default=_shown_default),
    )
    app.register_install_completion_command(
        name="--install-completion",
        help="install the completion of commands and options in bash, zsh or fish",
        add_to_startup=False,
    )
    for number, (name, module) in enumerate(_COMMANDS.items()):
        app.command(f"drake_oa.app.{module}:{name}", name=name, sort_key=number)
    return app


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line `drake-oa`, reports errors on stderr, and returns the exit status.

    Args:
        arguments: command and arguments; None: those of the process.
    """
    tokens = sys.argv[1:] if arguments is None else list(arguments)
    # Modules and diagrams have many permanent objects. With the default threshold of 700 new
    # objects, garbage collection costs a tenth of the start time.
    gc.set_threshold(50_000)
    # OpenBLAS starts its threads, which busy-wait, as soon as NumPy is imported.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        status = _run(tokens)
        sys.stdout.flush()
        return status
    except (Exception, KeyboardInterrupt) as error:
        if isinstance(error, OSError) and error.errno in (errno.EPIPE, errno.ENOSPC):
            # The error is of standard output, because `OutputError` has no errno. Python flushes
            # standard output again at exit, so it must not be the broken pipe.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            # A closed pipe needs no message: its reader wants no more output.
            if error.errno == errno.ENOSPC:
                complain(f"cannot write to standard output: {error.strerror}")
            return FAILED
        if not isinstance(error, OutputError) and is_interrupt(error):
            # `Terminated` states its exit status.
            status = getattr(error, "status", INTERRUPTED)
            complain("interrupted" if status == INTERRUPTED else "terminated")
            return status
        if isinstance(error, CycloptsError):
            words = [name for name in tokens[:1] if name in _COMMANDS]
            complain(f"{error} See drake-oa {' '.join([*words, '--help'])}")
            return BAD_INPUT
        if isinstance(error, ValueError | OSError):
            logging.getLogger(__name__).info("traceback of the error", exc_info=True)
            complain(re.sub(r"^\[Errno \d+\] ", "", str(error)))
            return FAILED if isinstance(error, OutputError) else BAD_INPUT
        raise


def _run(tokens: Sequence[str]) -> int:
    """Parses the command line `drake-oa`, calls the command, and returns its exit status.

    Args:
        tokens: command and its arguments.
    """
    app = _app()
    group = app["evaluate"] if "evaluate" in tokens else app
    if group is not app or not any(name in tokens for name in _COMMANDS):
        # The list of commands has the summary of each, from its module.
        for name in group:
            group[name]

    @app.meta.default
    def launch(
        *words: Annotated[str, Parameter(show=False, allow_leading_hyphen=True)],
        verbose: Annotated[bool, Parameter(group=Group("Options of every command"))] = False,
    ) -> int:
        """Runs a command.

        Args:
            words: command and its arguments.
            verbose: write messages of level INFO as well, and the traceback of an error.
        """
        level = logging.INFO if verbose else logging.WARNING
        # This handler writes to the present sys.stderr, which a progress bar may replace.
        handler = logging.lastResort or logging.StreamHandler()
        handler.setLevel(level)
        logging.basicConfig(format="%(levelname)s: %(message)s", level=level, handlers=[handler])
        command, bound, _ = app.parse_args(words, exit_on_error=False, print_error=False)
        with _computing(command, level):
            return command(*bound.args, **bound.kwargs) or 0

    # By default, cyclopts exits without a message.
    app.suppress_keyboard_interrupt = app.meta.suppress_keyboard_interrupt = False
    status: int | None = app.meta(
        tokens, exit_on_error=False, print_error=False, result_action="return_value"
    )
    return (status or 0) if tokens else BAD_INPUT


@contextlib.contextmanager
def _computing(command: Callable[..., Any], level: int) -> Iterator[None]:
    """Limits the BLAS libraries to one thread during a command, and announces the compilation of
    numba kernels.

    Args:
        command: function of the command; `scenarios` and `new` need neither library.
        level: level of Drake's log messages.
    """
    if command.__name__ in ("scenarios", "new"):
        yield
        return
    # This imports pydrake, which sets the level of its log, and the BLAS libraries.
    from threadpoolctl import threadpool_limits

    import drake_oa.scenario.loading  # noqa: F401
    from drake_oa.common.numba_tools import announced_compilation

    logging.getLogger("drake").setLevel(level)
    # With small matrices, more BLAS threads only wait for each other. The limit applies to every
    # BLAS library, also if NumPy was imported before.
    with threadpool_limits(limits=1), announced_compilation():
        yield


if __name__ == "__main__":
    sys.exit(main())
