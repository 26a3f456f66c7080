"""`dsim assignments` and `dsim check-submission` on a terminal."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from rich.markup import escape
from rich.table import Table as RichTable
from rich.text import Text

from dsim.grading import folder, results, submission
from dsim.grading import gradescope as autograder
from dsim.grading import items as rubrics
from dsim.grading import release as releasing
from dsim.grading.grade import SECRET, secret_of
from dsim.grading.selfcheck import selfcheck
from dsim.grading.student import LocalStudent
from dsim.pictures.files import write_atomically
from dsim.report.terminal import console


def listing(where: Path | None) -> None:
    """A row an assignment."""
    table = RichTable(expand=False, padding=(0, 1), box=None, header_style="bold")
    for name in ("NN", "title", "points", "items"):
        table.add_column(name)
    for found in folder.assignments(folder.root(where)):
        rubric = found.path / "rubric.toml"
        items = rubrics.rubric(rubric)
        title = str(tomllib.loads(rubric.read_text(encoding="utf-8")).get("title", found.topic))
        points = str(sum(item.points for item in items))
        table.add_row(found.number, escape(title.removeprefix(found.number).strip()), points, str(len(items)))
    console().print(table)


def release(numbers: Sequence[str], to: Path, notebook: bool, where: Path | None) -> None:
    """Write the folders for students and say where they are."""
    directory = folder.root(where)
    for chosen in [folder.find(number, directory) for number in numbers]:
        target = releasing.release(chosen, to, notebook)
        console().print(f"written: {target}", soft_wrap=True, markup=False)


def gradescope(number: str, to: Path, secret: Path | None, other_user: bool, where: Path | None) -> None:
    """Write the autograder's zip and say plainly how submissions are held there."""
    if to.suffix != ".zip":
        raise ValueError(f"--to must be a file that ends in .zip; got {to}")
    if secret is not None and not secret.is_file():
        raise FileNotFoundError(f"--secret must be a file that is there; there is none at {secret}")
    assignment = folder.find(number, folder.root(where))
    place = secret or to.parent / SECRET
    autograder.write(assignment, to, secret_of(place), other_user)
    out = console()
    out.print(f"written: {to}\nsecret: {place}; it lies in the zip too, so give the zip to nobody\n", soft_wrap=True,
              markup=False)  # fmt: skip
    out.print(autograder.told(other_user), markup=False, end="")


def check(numbers: Sequence[str], where: Path | None) -> int:
    """Every claim of every assignment; red ones are printed."""
    directory = folder.root(where)
    chosen = numbers or [found.number for found in folder.assignments(directory)]
    out, bad = console(), 0
    for number in chosen:
        found = folder.find(number, directory)
        with console(stderr=True).status(found.path.name) as status:
            checks = list(selfcheck(found, lambda text, name=found.path.name: status.update(f"{name}: {text}")))  # type: ignore[misc]
        red = [each for each in checks if not each.passed]
        bad += len(red)
        for each in red:
            out.print(Text(str(each), style="red"), soft_wrap=True)
        out.print(f"{found.path.name}: {len(checks) - len(red)} passed, {len(red)} failed", markup=False)
    return 1 if bad else 0


def check_submission(file: Path, number: str, where: Path | None, pictures: Path | None = None) -> int:
    """The public items, in this process.  pictures: their directory, FILE-feedback beside the file by default."""
    if not file.is_file():
        raise FileNotFoundError(f"there is no file {file}")
    match = re.match(r"\d\d", file.name)
    if not number and match is None:
        raise ValueError(f"--assignment must say which one, for {file.name} does not begin with its number")
    assignment = folder.find(number or match[0], folder.root(where))  # type: ignore[index]
    items = rubrics.rubric(assignment.path / "rubric.toml")
    checks = rubrics.checks(items, assignment.path / "tests", b"public")
    public = [item for item in items if item.visible == "public"]
    with TemporaryDirectory(prefix="dsim-check-") as directory:
        path = Path(directory) / file.with_suffix(".py").name
        read = submission.read(file)
        path.write_text(read.source, encoding="utf-8")
        student = LocalStudent(path, assignment.path)
        outcomes = rubrics.run(public, checks, student)
    out, to = console(), pictures or file.with_name(f"{file.stem}-feedback")
    if same := results.alike(outcomes):
        out.print(f"Nothing could be checked, every item ended like this:\n    {read.placed(same)}", markup=False)
    for outcome in outcomes:
        style = "bold red" if outcome.lost else "green"
        out.print(Text(f"{outcome.score:g} of {outcome.item.points}  {outcome.item.title}", style=style))
        if outcome.lost and not same:
            hint = f"\n    Hint: {outcome.item.hint}" if outcome.hinted else ""
            out.print(f"    {read.placed(outcome.why)}{hint}", markup=False)
        if (png := results.picture_of(outcome)) is not None:
            path = write_atomically(to / f"{outcome.item.id}.png", png)
            out.print(f"    Picture: {path}", markup=False, soft_wrap=True)
        else:
            (to / f"{outcome.item.id}.png").unlink(missing_ok=True)  # of an earlier try
    got, most = sum(outcome.score for outcome in outcomes), sum(item.points for item in public)
    hidden = sum(item.points for item in items) - most
    out.print(f"{got:g} of {most} public points; {hidden} more are hidden", markup=False)
    if open_parts := submission.unwritten(read.source):
        out.print(f"Not written yet: {', '.join(open_parts)}", markup=False)
    if student.changed:
        names = ", ".join(sorted(student.changed))
        out.print(f"Changes the arrays that it is given: {names}. Return new ones: x = x + h * v, not x += h * v",
                  markup=False)  # fmt: skip
    foreign = submission.foreign_imports(read.source)
    for line, name in foreign:
        told = read.placed(f"imports {name}, which is not there when you are graded (line {line} of your file)")
        out.print(Text(f"{told}: points would be lost", style="bold red"))
    return 0 if got == most and not foreign else 1
