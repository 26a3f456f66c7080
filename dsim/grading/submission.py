"""What was handed in: a `.py` file, or the tagged cells of an `.ipynb`, as source text that a worker can load."""

from __future__ import annotations

import ast
import json
from dataclasses import dataclass
from pathlib import Path

MOST_BYTES = 2**20
KINDS = (".py", ".ipynb")
TAG = "submission"


class SubmissionError(ValueError):
    """Nothing that could be graded; the message is for the student."""


@dataclass(frozen=True)
class Submission:
    """name: of the file without its ending, in the grades.  source: Python text."""

    name: str
    path: Path
    source: str


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
    if path.suffix not in KINDS:
        raise SubmissionError(f"{name} must end in {' or '.join(KINDS)}")
    with path.open("rb") as file:
        data = file.read(MOST_BYTES + 1)
    if len(data) > MOST_BYTES:
        raise SubmissionError(f"{name} must have at most {MOST_BYTES} bytes")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise SubmissionError(f"{name} must be UTF-8 text; byte {error.start} is not") from None
    source = from_notebook(text, name) if path.suffix == ".ipynb" else text
    try:
        ast.parse(source)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        line = f" in line {error.lineno}" if isinstance(error, SyntaxError) and error.lineno else ""
        told = error.msg if isinstance(error, SyntaxError) else str(error)
        raise SubmissionError(f"{name} is not Python: {printable(told[:200])}{line}") from None
    return Submission(name_of(path), path, source)


def from_notebook(text: str, name: str) -> str:
    """The code cells tagged "submission", in order; all code cells where none is tagged; lines of magic left out."""
    try:
        cells = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
        tagged = [cell for cell in cells if TAG in cell.get("metadata", {}).get("tags", ())]
        sources = ["".join(cell["source"]) for cell in tagged or cells]
        return "\n\n".join(map(_without_magic, sources))
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise SubmissionError(f"{name} must be a notebook (nbformat 4): {type(error).__name__}") from None


def _without_magic(source: str) -> str:
    return "\n".join(line for line in source.splitlines() if line[:1] not in ("%", "!"))
