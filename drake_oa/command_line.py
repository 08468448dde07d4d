"""What the commands of `drake-oa` share: exit statuses, errors, common options."""

from __future__ import annotations

import argparse
import contextlib
import sys
import textwrap
from collections.abc import Iterator

from drake_oa.scenario import ScenarioError

FAILED, BAD_INPUT, INTERRUPTED, TERMINATED = 1, 2, 130, 143
"""Exit statuses other than 0."""
_LONGEST = 2000


def complain(message: str) -> None:
    """Prints an error as one line on stderr; of a very long one, the first `_LONGEST` letters."""
    line = textwrap.shorten(message, _LONGEST, placeholder=" ...")
    print(f"drake-oa: error: {line}", file=sys.stderr)


def add_verbose(parser: argparse.ArgumentParser) -> None:
    """Adds --verbose to a command."""
    parser.add_argument(
        "--verbose", action="store_true", help="more messages, and a traceback with an error"
    )


def add_scenario(parser: argparse.ArgumentParser) -> None:
    """Adds SCENARIO and --set to a command."""
    parser.add_argument(
        "scenario", metavar="SCENARIO", help="a shipped name (see `drake-oa scenarios`) or a file"
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="A.B=C",
        dest="overrides",
        help="replace a field of the scenario; may be repeated",
    )


@contextlib.contextmanager
def build_errors() -> Iterator[None]:
    """Drake refuses a model or a camera by RuntimeError: bad input, not a bug of ours."""
    from drake_oa.simulation import MotionInterruptedError

    try:
        yield
    except MotionInterruptedError:
        raise
    except RuntimeError as error:
        raise ScenarioError(str(error)) from error
