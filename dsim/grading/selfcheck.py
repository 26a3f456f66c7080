"""Is an assignment fair?  The solution and its alternatives get everything, the stub nothing, a mutant what it must."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from dsim.grading import items as rubrics
from dsim.grading.folder import Assignment
from dsim.grading.items import Outcome
from dsim.grading.regions import stub
from dsim.grading.student import LocalStudent
from dsim.studies.check import Check

LEAST_POINTS, LEAST_ITEMS, LEAST_MUTANTS, LEAST_ALTERNATIVES = 10, 6, 8, 3
LOSES = re.compile(r"# loses: (.+)")


def outcomes(assignment: Assignment, source: str, secret: bytes = b"selfcheck") -> list[Outcome]:
    """Every item on this source, in this process."""
    rows = rubrics.rubric(assignment.path / "rubric.toml")
    found = rubrics.checks(rows, assignment.path / "tests", secret)
    with TemporaryDirectory(prefix="dsim-selfcheck-") as directory:
        path = Path(directory) / "submission.py"
        path.write_text(source, encoding="utf-8")
        return rubrics.run(rows, found, LocalStudent(path, assignment.path))


def selfcheck(
    assignment: Assignment, say: Callable[[str], None] = lambda text: None, every: int = 1
) -> Iterator[Check]:
    """A check a claim; each says what was lost that should not be, or kept.  every: of so many mutants one is run."""
    rows = rubrics.rubric(assignment.path / "rubric.toml")
    solution = (assignment.path / "solution.py").read_text(encoding="utf-8")
    points, subject = sum(item.points for item in rows), assignment.path.name
    mutants = sorted((assignment.path / "mutants").glob("*.py"))
    alternatives = sorted((assignment.path / "alternatives").glob("*.py"))
    for count, least, what in ((points, LEAST_POINTS, "points"), (len(rows), LEAST_ITEMS, "items"),
                               (len(mutants), LEAST_MUTANTS, "mutants"),
                               (len(alternatives), LEAST_ALTERNATIVES, "alternatives")):  # fmt: skip
        yield Check(subject, what, count >= least, float(count), f">= {least}")
    say("solution")
    yield _lost(subject, "solution", outcomes(assignment, solution), set())
    say("stub")
    found = outcomes(assignment, stub(solution))
    score = sum(outcome.score for outcome in found)
    yield Check(subject, "the stub scores nothing", score == 0, score, "= 0")
    for path in alternatives:
        say(path.stem)
        yield _lost(subject, f"alternative {path.stem}", outcomes(assignment, path.read_text(encoding="utf-8")), set())
    for path in mutants[::every]:
        say(path.stem)
        source = path.read_text(encoding="utf-8")
        match = LOSES.match(source)
        if match is None:
            raise ValueError(f"{path} must say in its first line which items it loses: # loses: id, id")
        named, known = set(re.split(r",\s*", match[1].strip())), [item.id for item in rows]
        if unknown := sorted(named - set(known)):
            raise ValueError(f"{path} loses {', '.join(unknown)}, no item of the rubric; items: {', '.join(known)}")
        yield _lost(subject, f"mutant {path.stem}", outcomes(assignment, source), named)


def _lost(subject: str, what: str, found: list[Outcome], expected: set[str]) -> Check:
    lost = {outcome.item.id for outcome in found if outcome.lost}
    words = ", ".join(
        f"{o.item.id}: {o.why}" for o in found if (o.item.id in lost) != (o.item.id in expected) and o.lost
    )
    kept = ", ".join(sorted(expected - lost))
    told = "".join([f"; lost {words}" if words else "", f"; kept {kept}" if kept else ""])
    statement = f"{what} loses {', '.join(sorted(expected)) or 'nothing'}{told}"
    return Check(subject, statement, lost == expected, float(len(lost ^ expected)), "= 0")
