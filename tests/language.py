"""Check of the summaries of docstrings, run by `make lint`.

A summary names its subject: a noun phrase for a module, a class or a constant, a verb in the third
person for a function. One that begins with a relative clause ("What is known of ...") or defines
its subject by "what" or "who" is reported.

Cases older than this check are listed in `language_allowed.txt`, one line each, sorted: qualified
name of the object and first words of the summary, so that a module may be moved or merged. The
list only shrinks: the check fails for a case that is not listed, and for a line without a case.

    python -m tests.language             check the summaries
    python -m tests.language --shrink    remove the lines without a case first; never adds one
"""

from __future__ import annotations

import argparse
import ast
import inspect
import re
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
FOLDERS = ("drake_oa", "diagrams")
ALLOWED = Path(__file__).with_name("language_allowed.txt")
KEY_WORDS = 6
"""Words of a summary that are part of its key."""

# "what if" and "what it takes" are idioms, not definitions.
UNCLEAR = re.compile(
    r"^(What|Who|Whoever|Which|Where|How|Of|As|The same|That|So|For which|In which|Round"
    r"|Every so)\b"
    r"|\b(what|who|whoever)\b(?! (if|it takes))"
)
REMEDY = "begin with a noun phrase (class, constant, module) or a verb (function), without what/who"


class Summary(NamedTuple):
    """First paragraph of a docstring, on one line."""

    place: str
    name: str
    text: str

    @property
    def key(self) -> str:
        """Line of the list: qualified name and first words."""
        return f"{self.name}: {' '.join(self.text.split()[:KEY_WORDS])}"


def summaries(path: Path) -> Iterator[Summary]:
    """Yields the summary of each docstring of a file, strings below constants included."""
    place = path.relative_to(ROOT)
    for line, name, doc in docstrings(ast.parse(path.read_text()), ()):
        paragraph = re.split(r"\n\s*\n", inspect.cleandoc(doc).strip())[0]
        yield Summary(f"{place}:{line}", name, " ".join(paragraph.split()))


def docstrings(node: ast.AST, scope: tuple[str, ...]) -> Iterator[tuple[int, str, str]]:
    """Yields line, qualified name and text of each docstring in a node."""
    body = getattr(node, "body", None)
    statements = body if isinstance(body, list) else []
    for before, statement in zip([None, *statements], statements, strict=False):
        match statement:
            case ast.Expr(value=ast.Constant(value=str(text))):
                pass
            case _:
                continue
        match before:
            case None if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)):
                yield statement.lineno, ".".join(scope) or "module", text
            case ast.Assign(targets=[target, *_]) | ast.AnnAssign(target=target):
                yield statement.lineno, ".".join([*scope, ast.unparse(target)]), text
    for child in ast.iter_child_nodes(node):
        is_named = isinstance(child, (ast.ClassDef, ast.FunctionDef))
        yield from docstrings(child, (*scope, child.name) if is_named else scope)


def unclear_summaries() -> list[Summary]:
    """Returns the summaries of the product that do not name their subject."""
    files = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
    return [found for file in files for found in summaries(file) if UNCLEAR.search(found.text)]


def main() -> int:
    """Returns 1 if a case is not listed, or a line of the list has no case."""
    parser = argparse.ArgumentParser(prog="python -m tests.language", description=REMEDY)
    parser.add_argument("--shrink", action="store_true", help="remove lines without a case")
    options = parser.parse_args()
    unclear = unclear_summaries()
    found = Counter(summary.key for summary in unclear)
    allowed = Counter(ALLOWED.read_text().splitlines())
    if options.shrink:
        allowed &= found
        ALLOWED.write_text("".join(f"{key}\n" for key in sorted(allowed.elements())))
    for summary in unclear:
        if found[summary.key] > allowed[summary.key]:
            print(f"{summary.place}: {summary.name}: {summary.text!r}: {REMEDY}")
    for key in sorted(allowed - found):
        print(f"{ALLOWED.relative_to(ROOT)}: no such summary any more, remove the line: {key}")
    if allowed - found:
        print("python -m tests.language --shrink removes such lines")
    return int(found != allowed)


if __name__ == "__main__":
    sys.exit(main())
