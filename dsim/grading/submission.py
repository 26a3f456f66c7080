"""What was handed in: a `.py` file, or the tagged cells of an `.ipynb`, as source text that a worker can load."""

from __future__ import annotations

import ast
import json
import re
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

MOST_BYTES = 2**20
KINDS = (".py", ".ipynb")
TAG = "submission"
THERE = sys.stdlib_module_names | {"numpy", "scipy", "kit"}  # what a submission may import


class SubmissionError(ValueError):
    """Nothing that could be graded; the message is for the student."""


@dataclass(frozen=True)
class Submission:
    """name: of the file without its ending, in the grades.  source: Python text.

    cells: of a notebook, the line of the source at which each begins, and its first line of code.  outside: names that
    its other cells define.
    """

    name: str
    path: Path
    source: str
    cells: tuple[tuple[int, str], ...] = ()
    outside: frozenset[str] = frozenset()

    def placed(self, why: str) -> str:
        """A reason with "line N of your file" in words that lead to the cell of a notebook."""
        found = re.search(r" \(line (\d{1,7}) of your file\)$", why) if self.cells else None
        missing = re.match(r"NameError: name '(\w{1,60})' is not defined", why)
        if missing and missing[1] in self.outside:
            lost = f'; {missing[1]} is in a cell that is not tagged "{TAG}": move it into one that is'
        else:
            lost = ""
        return f"{why[: found.start()]} ({_place(self.cells, int(found[1]))}){lost}" if found else why + lost


def printable(text: str) -> str:
    """The text without what moves a cursor, starts a line or cannot be encoded."""
    return "".join(c if c.isprintable() else "?" for c in text)


def name_of(path: Path) -> str:
    """Its name in the grades: of the file without its ending, printable."""
    return printable(path.stem)


def read(path: Path) -> Submission:
    """The submission in a file.  Raises SubmissionError for a link, a wrong kind, size or coding, or bad syntax."""
    name = printable(path.name)
    if path.is_symlink() or not path.is_file():
        raise SubmissionError(f"{name} must be a plain file, not a link or a directory")
    if path.suffix.lower() not in KINDS:
        raise SubmissionError(f"{name} must end in {' or '.join(KINDS)}")
    with path.open("rb") as file:
        data = file.read(MOST_BYTES + 1)
    if len(data) > MOST_BYTES:
        raise SubmissionError(f"{name} must have at most {MOST_BYTES} bytes")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise SubmissionError(f"{name} must be UTF-8 text; byte {error.start} is not") from None
    parts = from_notebook(text, name) if path.suffix.lower() == ".ipynb" else [text]
    source = "\n\n".join(parts)
    cells = _beginnings(parts) if path.suffix.lower() == ".ipynb" else ()
    try:
        ast.parse(source)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        line = f" in {_place(cells, error.lineno)}" if isinstance(error, SyntaxError) and error.lineno else ""
        told = error.msg if isinstance(error, SyntaxError) else str(error)
        raise SubmissionError(f"{name} is not Python{line}: {printable(told[:200])}") from None
    return Submission(name_of(path), path, source, cells, _outside(text) if cells else frozenset())


def foreign_imports(source: str) -> list[tuple[int, str]]:
    """(line, module) of imports that fail where it is graded: of anything but Python's own, numpy, scipy and kit."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found.append((node.lineno, node.module))
    return sorted((line, name) for line, name in found if name.split(".")[0] not in THERE)


def unwritten(source: str) -> list[str]:
    """The functions that still end as the stub does, with `raise NotImplementedError`."""
    names = []
    for part in ast.parse(source).body:
        last = part.body[-1] if isinstance(part, ast.FunctionDef) else None
        if isinstance(part, ast.FunctionDef) and isinstance(last, ast.Raise) and last.exc is not None:
            names += [part.name] * ast.unparse(last.exc).startswith("NotImplementedError")
    return names


def _beginnings(parts: list[str]) -> tuple[tuple[int, str], ...]:
    lines, found = 1, []
    for part in parts:
        first = next((line.strip() for line in part.splitlines() if line.strip()), "nothing")
        shown = printable(first)
        found.append((lines, shown if len(shown) <= 40 else f"{shown[:37]}..."))
        lines += part.count("\n") + 2
    return tuple(found)


def _place(cells: tuple[tuple[int, str], ...], line: int) -> str:
    """Where a line of the source is, for somebody who sees the file or the notebook."""
    before = [(start, first) for start, first in cells if start <= line]
    return f'line {line - before[-1][0] + 1} of the cell that begins "{before[-1][1]}"' if before else f"line {line}"


def from_notebook(text: str, name: str) -> list[str]:
    """The code cells tagged "submission", in order; all code cells where none is tagged; lines of magic are empty."""
    try:
        cells = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
        tagged = [cell for cell in cells if TAG in cell.get("metadata", {}).get("tags", ())]
        sources = ["".join(cell["source"]) for cell in tagged or cells]
        return list(map(_without_magic, sources))
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise SubmissionError(f"{name} must be a notebook (nbformat 4): {type(error).__name__}") from None


def _outside(text: str) -> frozenset[str]:
    """Names that the untagged code cells of a notebook define."""
    names: set[str] = set()
    for cell in json.loads(text)["cells"]:
        if cell["cell_type"] == "code" and TAG not in cell.get("metadata", {}).get("tags", ()):
            with suppress(SyntaxError, ValueError, RecursionError, MemoryError):
                for node in ast.walk(ast.parse(_without_magic("".join(cell["source"])))):
                    if isinstance(node, ast.FunctionDef | ast.ClassDef):
                        names.add(node.name)
                    elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                        names.add(node.id)
    return frozenset(names)


def _without_magic(source: str) -> str:
    return "\n".join("" if line[:1] in ("%", "!") else line for line in source.split("\n"))
