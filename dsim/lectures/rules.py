"""What every lecture must have, as checks on its source and on its outputs."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from dsim.lectures.folder import Lecture
from dsim.lectures.notebook import EXERCISE, SOLUTION, tags
from dsim.studies.check import Check

MOST_LINES = 15
MOST_PICTURE = 400_000  # bytes
LINK = re.compile(r"\]\(([^)#\s]+)(?:#[^)\s]*)?\)")


def check_source(lecture: Lecture, notebook: Any) -> Iterator[Check]:
    """Headings, lengths of cells, exercises with solutions, links."""
    subject = lecture.path.stem
    cells = notebook.cells
    prose = "\n\n".join(cell.source for cell in cells if cell.cell_type == "markdown")
    code = [cell for cell in cells if cell.cell_type == "code"]
    heading = re.match(r"# (\d\d) \S", cells[0].source if cells else "")
    yield _true(subject, "the title begins with the number", bool(heading and heading[1] == lecture.number))
    for words in ("What you will be able to do", "Assignment", "Sources"):
        yield _true(subject, f"there is a part: {words}", re.search(rf"^##+ {words}", prose, flags=re.M) is not None)
    longest = max((len(cell.source.splitlines()) for cell in code), default=0)
    yield Check(subject, "lines of the longest cell", longest <= MOST_LINES, longest, f"<= {MOST_LINES}")
    exercises = len(re.findall(r"^### Exercise \d", prose, flags=re.M))
    yield Check(subject, "exercises", 2 <= exercises <= 4, exercises, "2 to 4")
    folded = sum("<details>" in cell.source for cell in cells if SOLUTION in tags(cell))
    yield Check(subject, "folded solutions", folded == exercises, folded, f"= {exercises}")
    started = sum(EXERCISE in tags(cell) for cell in code)
    yield Check(subject, "cells to write in", started == exercises, started, f"= {exercises}")
    guarded = sum(bool(re.search(r"^\s*assert ", cell.source, flags=re.M)) for cell in code)
    yield Check(subject, "cells with asserts", 2 * guarded >= len(code) - started, guarded, "half of the cells")
    yield _true(subject, "the first cell draws a picture", bool(code) and "show(" in code[0].source)
    for target in LINK.findall(prose):
        if not re.match(r"[a-z]+:", target):
            beside = lecture.path.parent / target
            there = beside.with_suffix(".md") if re.fullmatch(r"\d\d_\w+\.ipynb", target) else beside
            yield _true(subject, f"{target} is there", there.exists())
    assigned = [target for target in LINK.findall(prose) if re.fullmatch(r"\.\./assignments/\w+/handout\.md", target)]
    yield _true(subject, "it links its assignment", bool(assigned))


def check_outputs(lecture: Lecture, notebook: Any) -> Iterator[Check]:
    """Pictures: how many, their size and their alternative texts; no machine's path in what is printed."""
    subject = lecture.path.stem
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    pictures = [output for output in outputs if "image/png" in output.get("data", {})]
    sizes = [len(picture["data"]["image/png"]) * 3 // 4 for picture in pictures]
    yield Check(subject, "pictures", len(pictures) >= 2, len(pictures), ">= 2")
    yield Check(subject, "bytes of the largest picture", max(sizes, default=0) < MOST_PICTURE, max(sizes, default=0),
                f"< {MOST_PICTURE}")  # fmt: skip
    named = sum(bool(alt_of(picture)) for picture in pictures)
    yield Check(subject, "pictures with alternative texts", named == len(pictures), named, f"= {len(pictures)}")
    text = "".join(
        str(output.get("text", "")) + str(output.get("data", {}).get("text/plain", "")) for output in outputs
    )
    yield _true(subject, "nothing printed names a place on this machine", str(Path.home()) not in text)
    warned = [output for output in outputs if output.get("name") == "stderr"]
    yield Check(subject, "outputs on stderr", not warned, len(warned), "= 0")


def alt_of(output: Any) -> str:
    """The alternative text of a picture in an output."""
    return str(output.get("metadata", {}).get("image/png", {}).get("alt", ""))


def _true(subject: str, statement: str, passed: bool) -> Check:
    return Check(subject, statement, passed, float(passed), "true")
