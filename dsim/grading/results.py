"""What a class gets: results.json (Gradescope), feedback.md, grades.csv and a summary, each file whole or absent."""

from __future__ import annotations

import csv
import io
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dsim.grading.items import Item, Outcome
from dsim.pictures.files import write_atomically

RESULTS, FEEDBACK, GRADES, SUMMARY = "results.json", "feedback.md", "grades.csv", "summary.md"


@dataclass(frozen=True)
class Graded:
    """One submission: its outcomes, what it printed last, or why it could not be graded at all."""

    name: str
    outcomes: tuple[Outcome, ...]
    notes: str = ""
    refused: str = ""
    sandboxed: bool = True

    @property
    def score(self) -> float:
        return round(sum(outcome.score for outcome in self.outcomes), 2)

    @property
    def most(self) -> int:
        return sum(outcome.item.points for outcome in self.outcomes)


def as_gradescope(graded: Graded) -> dict[str, Any]:
    """The autograder's results.json: hidden items are seen after the due date only."""
    tests = [
        {
            "name": outcome.item.title,
            "number": outcome.item.id,
            "score": outcome.score,
            "max_score": outcome.item.points,
            "status": "failed" if outcome.lost else "passed",
            "visibility": "visible" if outcome.item.visible == "public" else "after_due_date",
            "output": told(outcome),
        }
        for outcome in graded.outcomes
    ]
    loud = "" if graded.sandboxed else "Graded WITHOUT a sandbox: do not trust this grade. "
    return {"score": graded.score, "max_score": graded.most, "output": loud + graded.refused, "tests": tests,
            "extra_data": {"submission": graded.name, "sandboxed": graded.sandboxed}}  # fmt: skip


def told(outcome: Outcome) -> str:
    """Why points were lost, and one hint; inputs are never shown."""
    return f"{outcome.why}\n\nHint: {outcome.item.hint}" if outcome.lost else ""


def feedback(graded: Graded) -> str:
    """The same for people."""
    lines = [f"# {graded.name}: {graded.score:g} of {graded.most}", ""]
    if not graded.sandboxed:
        lines += ["**Graded without a sandbox: do not trust this grade.**", ""]
    if graded.refused:
        lines += [f"Not graded: {graded.refused}", ""]
    for outcome in graded.outcomes:
        item = outcome.item
        lines.append(f"## {item.title}: {outcome.score:g} of {item.points}")
        lines += ["", told(outcome), ""] if outcome.lost else [""]
    if graded.notes.strip():
        lines += ["## What your program printed last", "", "```text", _fenced(graded.notes), "```", ""]
    return "\n".join(lines)


def _fenced(text: str) -> str:
    """Printable text that cannot close its fence."""
    lines = text.replace("`", "'").splitlines()[-30:]
    return "\n".join("".join(c if c.isprintable() else "?" for c in line)[:200] for line in lines)


def write(graded: Graded, directory: Path) -> None:
    """Both files of one submission; results.json comes last: where it is, the submission is done."""
    write_atomically(directory / FEEDBACK, feedback(graded).encode())
    data = as_gradescope(graded)
    write_atomically(directory / RESULTS, (json.dumps(data, indent=1, allow_nan=False) + "\n").encode())


def read(directory: Path, items: Sequence[Item]) -> Mapping[str, Any] | None:
    """A finished submission's row for the class, or None where it is not finished or of another rubric."""
    try:
        data = json.loads((directory / RESULTS).read_bytes())
        scores = {test["number"]: float(test["score"]) for test in data["tests"]}
        whole = {test["number"]: test["max_score"] for test in data["tests"]}
    except (OSError, ValueError, KeyError, TypeError):
        return None
    if whole != {item.id: item.points for item in items}:
        return None
    return {"submission": data["extra_data"]["submission"], "score": data["score"], "max_score": data["max_score"],
            **scores}  # fmt: skip


def write_class(rows: Sequence[Mapping[str, Any]], items: Sequence[Item], directory: Path) -> None:
    """grades.csv, and the items most often lost."""
    columns = ["submission", "score", "max_score", *(item.id for item in items)]
    text = io.StringIO()
    table = csv.DictWriter(text, columns, lineterminator="\n")
    table.writeheader()
    for row in sorted(rows, key=lambda row: str(row["submission"])):
        table.writerow({**row, "submission": _harmless(str(row["submission"]))})
    write_atomically(directory / GRADES, text.getvalue().encode())
    write_atomically(directory / SUMMARY, summary(rows, items).encode())


def _harmless(name: str) -> str:
    """A spreadsheet takes these for formulas."""
    return f"'{name}" if name[:1] in "=+-@\t\r" else name


def summary(rows: Sequence[Mapping[str, Any]], items: Sequence[Item]) -> str:
    """How the class did, items most often lost first."""
    lost = Counter({item.id: sum(1 for row in rows if row[item.id] < item.points) for item in items})
    titles = {item.id: item.title for item in items}
    scores = sorted(float(row["score"]) for row in rows)
    middle = scores[len(scores) // 2] if scores else 0.0
    lines = [f"# {len(rows)} submissions, median {middle:g} of {sum(item.points for item in items)}", "",
             "| item | lost by | of |", "|---|---|---|"]  # fmt: skip
    lines += [f"| {titles[name]} | {count} | {len(rows)} |" for name, count in lost.most_common()]
    return "\n".join(lines) + "\n"
