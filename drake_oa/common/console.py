"""Exit statuses and errors of the commands."""

from __future__ import annotations

import sys
import textwrap

FAILED, BAD_INPUT, INTERRUPTED, TERMINATED = 1, 2, 130, 143
"""Exit statuses other than 0."""


_LONGEST = 2000


def complain(message: str) -> None:
    """Prints an error as one line on stderr; of a very long one, the first `_LONGEST` letters."""
    line = textwrap.shorten(message, _LONGEST, placeholder=" ...")
    print(f"drake-oa: error: {line}", file=sys.stderr)
