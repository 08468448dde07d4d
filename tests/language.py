"""Check of the language of docstrings, docs and command-line help, run by `make lint`.

Summaries: the first paragraph of a docstring names its subject by a noun phrase (module, class,
constant) or begins with a verb in the third person (function). A summary that defines its subject
by a relative clause or a pronoun ("What is known of ...", "The same for ...") is reported.

Terms: docs and help must not contain the terms of `TERMS`, whose standard terms are in
`docs/glossary.md`.

    python -m tests.language             check summaries and terms
    python -m tests.language --draw 60 1000    print 60 docstrings, drawn with seed 1000, for review
"""

from __future__ import annotations

import ast
import inspect
import random
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
"""Root folder of the repository."""
FOLDERS = ("drake_oa", "diagrams")
"""Folders of the product, whose summaries are checked."""
HELP = ROOT / "drake_oa" / "app"
"""Folder of the command line; its strings are help and messages."""
EXEMPT = ("CHANGELOG.md", "CONTRIBUTING.md", "docs/glossary.md")
"""Pages that may contain the terms of `TERMS`, to explain their replacement."""

UNCLEAR = re.compile(
    r"^(What|Who|Whoever|Which|Where|When|How|Of|As|The same|That|Those|These|This|They|It|Its"
    r"|So|Such|For which|In which|Round|Every so)\b"
    r"|\b(what|who|whoever)\b(?! (if|it takes))"
)
"""Beginnings and words that define the subject of a summary by a clause or a pronoun."""
REMEDY = "begin with a noun phrase (class, constant, module) or a verb (function), without what/who"
"""Remedy that is printed with an unclear summary."""

TERMS = re.compile(
    r"(?i)\b((asked|feasible|kept) clearance|clearance asked|short by|pre-?planned|(un)?modulated"
    r"|(the|its|in|than) print|round (obstacles?|it|them|the|a)|(goes|way) round|cut short|led by"
    r"|of (one's|your) own|anew|afresh|besides|whoever|turn error|ended by|judge[ds]?|things?"
    r"|solids|thinking|surroundings|lookout|in force|rehears\w*|commander|tally|hopeless|towards"
    r"|looked at|evading|under way|peers?|studies|(centre|metre|colour|neighbour|behaviour)s?)\b"
)
"""Home-made terms, whose standard terms are in `docs/glossary.md`."""


class Summary(NamedTuple):
    """First paragraph of a docstring on one line, with file and line, and qualified name."""

    place: str
    name: str
    text: str


def product_files() -> list[Path]:
    """Returns the files whose docstrings are checked, in order."""
    return [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))]


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
        if not (
            isinstance(statement, ast.Expr)
            and isinstance(statement.value, ast.Constant)
            and isinstance(text := statement.value.value, str)
        ):
            continue
        match before:
            case None if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)):
                yield statement.lineno, ".".join(scope) or "module", text
            case ast.Assign(targets=[target, *_]) | ast.AnnAssign(target=target):
                yield statement.lineno, ".".join([*scope, ast.unparse(target)]), text
    for child in ast.iter_child_nodes(node):
        is_named = isinstance(child, (ast.ClassDef, ast.FunctionDef))
        yield from docstrings(child, (*scope, child.name) if is_named else scope)


def drawn_docstrings(count: int, seed: int) -> str:
    """Returns docstrings of the product, drawn at random, each below its name and file."""
    texts = [
        f"--- {name}  ({path.relative_to(ROOT)})\n{inspect.cleandoc(doc)}\n"
        for path in product_files()
        for _, name, doc in docstrings(ast.parse(path.read_text()), ())
    ]
    return "\n".join(random.Random(seed).sample(texts, count))


def texts() -> Iterator[tuple[Path, int, str]]:
    """Yields file, line and text of each line of the docs and each string of the command line."""
    for path in [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]:
        if "_build" not in path.parts and str(path.relative_to(ROOT)) not in EXEMPT:
            yield from ((path, n, text) for n, text in enumerate(path.open(), 1))
    for path in HELP.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                lines = enumerate(node.value.splitlines(), node.lineno)
                yield from ((path, n, text) for n, text in lines)


def wrong_terms() -> Iterator[str]:
    """Yields a message for each term of `TERMS` in docs and help."""
    for path, line, text in texts():
        for match in TERMS.finditer(text):
            yield f"{path.relative_to(ROOT)}:{line}: {match[0]!r}: see docs/glossary.md"


def wrong_summaries() -> Iterator[str]:
    """Yields a message for each unclear summary."""
    for summary in (summary for path in product_files() for summary in summaries(path)):
        if UNCLEAR.search(summary.text):
            yield f"{summary.place}: {summary.name}: {summary.text!r}: {REMEDY}"


def main() -> int:
    """Prints all errors, or drawn docstrings; returns 1 if there are errors."""
    if "--draw" in sys.argv:
        print(drawn_docstrings(*map(int, sys.argv[2:4])))
        return 0
    errors = [*wrong_summaries(), *wrong_terms()]
    print("\n".join(errors), end="\n" if errors else "")
    return 1 if errors else 0


if __name__ == "__main__":
    sys.exit(main())
