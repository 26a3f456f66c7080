"""What a class gets: results.json (Gradescope), feedback.md, grades.csv and a summary, each file whole or absent."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
import pickle
import re
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from statistics import median
from typing import Any

from dsim.grading.curves import Picture
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
    extra = {"submission": graded.name, "sandboxed": graded.sandboxed, "read": not graded.refused}
    return {"score": graded.score, "max_score": graded.most, "output": loud + graded.refused, "tests": tests,
            "extra_data": extra}  # fmt: skip


def told(outcome: Outcome, why: Callable[[str], str] = str) -> str:
    """Why points were lost, and one hint; inputs are never shown.  why: how the reason, theirs perhaps, is written."""
    if not outcome.lost:
        return ""
    return f"{why(outcome.why)}\n\nHint: {outcome.item.hint}" if outcome.hinted else why(outcome.why)


def alike(outcomes: Sequence[Outcome]) -> str:
    """Why every item scored nothing, where all did in the same way: a file that stops while it is loaded, say."""
    reasons = {outcome.why if outcome.score == 0 else "" for outcome in outcomes}
    return reasons.pop() if len(outcomes) > 1 and len(reasons) == 1 else ""


def picture_of(outcome: Outcome) -> bytes | None:
    """The PNG of an outcome, None where there is none.  A picture that cannot be drawn never costs a grade."""
    if outcome.picture is None or not outcome.lost:
        return None
    public = outcome.item.visible == "public"
    with suppress(Exception):
        if outcome.picture.worth(public):
            return _drawn(_Same(outcome.picture, public))
    return None


class _Same:
    """Equal for pictures of equal numbers: a mistake that many of a class make is drawn once in a process."""

    def __init__(self, picture: Picture, public: bool) -> None:
        self.picture, self.public = picture, public
        self._key = pickle.dumps((picture, public))  # ours, never anything that came from a submission as bytes

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


@lru_cache(maxsize=64)
def _drawn(same: _Same) -> bytes:
    return same.picture.png(same.public)


def feedback(graded: Graded, pictures: Collection[str] = ()) -> str:
    """The same for people.  pictures: ids of the items that have one, ID.png, beside it."""
    lines = [f"# {_plain(graded.name)}: {graded.score:g} of {graded.most}", ""]
    if not graded.sandboxed:
        lines += ["**Graded without a sandbox: do not trust this grade.**", ""]
    if graded.refused:
        lines += [f"No points: {_plain(graded.refused)}", ""]
    if (same := alike(graded.outcomes)) and not graded.refused:
        lines += [f"Nothing could be checked, every item ended like this: {_plain(same)}", ""]
    for outcome in () if graded.refused else graded.outcomes:
        item = outcome.item
        lines.append(f"## {item.title}: {outcome.score:g} of {item.points}")
        lines += ["", told(outcome, _plain), ""] if outcome.lost and not same else [""]
        if item.id in pictures:
            lines += [f"![{item.title}: what came back, and what was asked for]({item.id}.png)", ""]
    if graded.notes.strip():
        lines += ["## What your program printed last", "", "```text", _fenced(graded.notes), "```", ""]
    return "\n".join(lines)


def _plain(text: str) -> str:
    """Text as it stands, in Markdown: nothing in it is a link, a picture, code, HTML, a heading, a list or a fence."""
    text = re.sub(r"([\\`\[\]<&]|(?<=:)/(?=/))", r"\\\1", text)
    return re.sub(r"^(\d+)?([#>~=+*_|-]|(?<=\d)[.)](?=\s))", r"\1\\\2", text)


def _fenced(text: str) -> str:
    """Printable text that cannot close its fence."""
    lines = text.replace("`", "'").splitlines()[-30:]
    return "\n".join("".join(c if c.isprintable() else "?" for c in line)[:200] for line in lines)


def folder_of(path: Path) -> str:
    """The folder of a submission in the directory of grades: its name, where that can be one and nothing else's."""
    safe = re.sub(r"[^\w .+=@,()-]", "_", path.stem).strip()
    if safe == path.stem and not safe.startswith((".", "_")) and safe not in (GRADES, SUMMARY):
        return safe  # what starts with _ is ours: nobody takes the folder of another
    return f"_{safe[:50]}-{hashlib.sha256(os.fsencode(path.stem)).hexdigest()[:16]}"


def write(graded: Graded, directory: Path) -> None:
    """The files of one submission; results.json comes last: where it is, the submission is done."""
    drawn = {outcome.item.id: png for outcome in graded.outcomes if (png := picture_of(outcome)) is not None}
    for outcome in graded.outcomes:
        if outcome.item.id in drawn:
            write_atomically(directory / f"{outcome.item.id}.png", drawn[outcome.item.id])
        else:  # of an earlier run
            (directory / f"{outcome.item.id}.png").unlink(missing_ok=True)
    write_atomically(directory / FEEDBACK, feedback(graded, drawn).encode())
    data = as_gradescope(graded)
    write_atomically(directory / RESULTS, (json.dumps(data, indent=1, allow_nan=False) + "\n").encode())


def read(directory: Path, items: Sequence[Item], sandboxed: bool = False) -> Mapping[str, Any] | None:
    """A finished submission's row for the class, or None where it is not finished or of another rubric.

    sandboxed: None as well where it was graded without a sandbox.
    """
    try:
        data = json.loads((directory / RESULTS).read_bytes())
        scores = {test["number"]: float(test["score"]) for test in data["tests"]}
        whole = {test["number"]: test["max_score"] for test in data["tests"]}
    except (OSError, ValueError, KeyError, TypeError):
        return None
    if sandboxed and not data["extra_data"]["sandboxed"]:
        return None
    if whole != {item.id: item.points for item in items}:
        return None
    return {"submission": data["extra_data"]["submission"], "score": data["score"], "max_score": data["max_score"],
            **scores}  # fmt: skip


def remarks(directories: Sequence[Path]) -> list[str]:
    """What a class must know of its results: files that could not be read, grades that are not to be trusted."""
    found = [json.loads((path / RESULTS).read_bytes())["extra_data"] for path in directories]
    unread = sum(not extra.get("read", True) for extra in found)
    loose = sum(not extra["sandboxed"] for extra in found)
    lines = [f"{unread} of them could not be read; feedback.md says why."] if unread else []
    return lines + ([f"{loose} of them graded WITHOUT a sandbox: do not trust these."] if loose else [])


def write_class(
    rows: Sequence[Mapping[str, Any]], items: Sequence[Item], directory: Path, told: Sequence[str] = ()
) -> None:
    """grades.csv, and the items most often lost.  told: remarks, a line each."""
    columns = ["submission", "score", "max_score", *(item.id for item in items)]
    text = io.StringIO()
    table = csv.DictWriter(text, columns, lineterminator="\n", quoting=csv.QUOTE_NONNUMERIC)  # also for ";" readers
    table.writeheader()
    for row in sorted(rows, key=lambda row: str(row["submission"])):
        table.writerow({**row, "submission": _harmless(str(row["submission"]))})
    write_atomically(directory / GRADES, text.getvalue().encode())
    write_atomically(directory / SUMMARY, summary(rows, items, told).encode())


def _harmless(name: str) -> str:
    """A spreadsheet takes these for formulas."""
    return f"'{name}" if name[:1] in "=+-@\t\r" else name


def summary(rows: Sequence[Mapping[str, Any]], items: Sequence[Item], told: Sequence[str] = ()) -> str:
    """How the class did: scores in ten bands, then the items most often lost first."""
    lost = Counter({item.id: sum(1 for row in rows if row[item.id] < item.points) for item in items})
    titles = {item.id: item.title for item in items}
    scores = sorted(float(row["score"]) for row in rows)
    most = sum(item.points for item in items)
    middle = median(scores) if scores else 0.0
    count = f"{len(rows)} submission{'s' * (len(rows) != 1)}"
    lines = [f"# {count}, median {middle:g} of {most}", "", *(f"{line}\n" for line in told), *_bands(scores, most), "",
             "| item | lost by | of |", "|---|---|---|"]  # fmt: skip
    lines += [f"| {titles[name]} | {count} | {len(rows)} |" for name, count in lost.most_common()]
    return "\n".join(lines) + "\n"


def _bands(scores: Sequence[float], most: int) -> list[str]:
    """A bar for each tenth of the points; full marks have a row of their own."""
    counts = Counter(min(int(10 * score / most), 10) for score in scores)
    unit = max(max(counts.values(), default=1) / 40, 1.0)
    rows = ["| points | submissions | |", "|---|---|---|"]
    for band in range(min(counts, default=0), max(counts, default=10) + 1):
        points = f"{most}" if band == 10 else f"{band * most / 10:g} to below {(band + 1) * most / 10:g}"
        rows.append(f"| {points} | {counts[band]} | {'█' * round(counts[band] / unit)} |")
    return rows
