"""What the commands of `drake-oa` share: exit statuses, errors on stderr, common options."""

from __future__ import annotations

import argparse
import sys

FAILED, BAD_INPUT, INTERRUPTED = 1, 2, 130
"""Exit statuses other than 0."""


def complain(message: str) -> None:
    """Prints an error as one line on stderr."""
    print(f"drake-oa: error: {' '.join(message.split())}", file=sys.stderr)


def add_verbose(parser: argparse.ArgumentParser) -> None:
    """Adds --verbose to a command."""
    parser.add_argument(
        "--verbose", action="store_true", help="more messages, and a traceback with an error"
    )
