"""What the commands of `drake-oa` share: exit statuses, errors, common options."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Iterator

from drake_oa.common.schema_check import ScenarioError


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
    from drake_oa.runs.simulation import MotionInterruptedError

    try:
        yield
    except MotionInterruptedError:
        raise
    except RuntimeError as error:
        raise ScenarioError(str(error)) from error
