"""A class graded: every submission once, in a sandbox of its own, resumable, several at a time."""

from __future__ import annotations

import os
import secrets
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass, replace
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from typing import Protocol

from dsim.grading import items as rubrics
from dsim.grading import results
from dsim.grading.items import Item, Outcome
from dsim.grading.results import Graded
from dsim.grading.sandbox import Jail, SandboxedStudent, SandboxError, check_sandbox
from dsim.grading.scratch import scratch, sweep
from dsim.grading.student import LocalStudent
from dsim.grading.submission import KINDS, SubmissionError, name_of, printable, read
from dsim.pictures.files import write_atomically

Say = Callable[[int, int, str], None]  # (done, total, name)
SECRET = ".dsim-secret"
ASSIGNMENT = ".dsim-assignment"  # in a directory of grades: whose they are
AHEAD = 4  # submissions handed to each process before it asks again: memory does not grow with the class


@dataclass(frozen=True)
class Task:
    """One submission to grade, as a process gets it."""

    assignment: Path
    submission: Path
    to: Path
    secret: bytes
    sandboxed: bool = True
    student: type[SandboxedStudent] = SandboxedStudent  # or one that is held otherwise


class Workers(Protocol):
    """Who grades instead of processes of this machine: `dsim.grading.cluster.Cluster`."""

    def prove(self, sandboxed: bool) -> None: ...
    def graded(self, tasks: Iterator[Task], sandboxed: bool) -> Iterator[str]: ...


def secret_of(path: Path) -> bytes:
    """The instructor's secret, made on first use and readable by nobody else."""
    try:
        return path.read_bytes()
    except FileNotFoundError:
        write_atomically(path, secrets.token_bytes(32))
        path.chmod(0o600)
        return path.read_bytes()


def submissions_in(directory: Path) -> list[Path]:
    """Everything that might be a submission, by name; not the `._NAME` that macOS puts beside each file in a zip.

    Raises ValueError where there is none, or two of one name.
    """
    if directory.is_file():
        raise ValueError(f"SUBMISSIONS must be a directory; {directory} is a file: put it into one of its own")
    if not directory.is_dir():
        raise ValueError(f"SUBMISSIONS must be a directory; there is none at {directory}")
    found = sorted(
        path for path in directory.iterdir() if path.suffix.lower() in KINDS and not path.name.startswith("._")
    )
    if not found:
        hint = "; it has directories: copy each student's file out of its own" if any(directory.glob("*/")) else ""
        raise ValueError(f"SUBMISSIONS must hold {' or '.join(KINDS)} files; {directory} has none{hint}")
    names = [path.stem for path in found]
    if doubled := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"SUBMISSIONS must have one file a name; {printable(doubled[0])} is there twice")
    return found


def grade(
    assignment: Path,
    submissions: Sequence[Path],
    to: Path,
    jobs: int | Workers = 1,
    sandboxed: bool = True,
    say: Say = lambda done, total, name: None,
) -> list[dict[str, object]]:
    """Grade what has no result yet; then the class's files.  The rows of grades.csv.

    jobs: so many processes of this machine, or workers elsewhere.
    A run that was killed goes on where it was: results.json is written last, whole, and what has one is done; not what
    was graded without a sandbox, when there is one now.
    Raises SandboxError where there is no sandbox that holds, ValueError for an assignment that is none.
    """
    sweep()
    items = rubrics.rubric(assignment / "rubric.toml")
    if not isinstance(jobs, int):
        jobs.prove(sandboxed)
    elif sandboxed:
        check_sandbox()
    _of_one_assignment(to, assignment.resolve().name)
    secret = secret_of(to / SECRET)
    rubrics.checks(items, assignment / "tests", secret)  # a mistake of ours shows before the first submission
    missing = [path for path in submissions if results.read(to / results.folder_of(path), items, sandboxed) is None]
    done = len(submissions) - len(missing)
    tasks = (Task(assignment, path, to / results.folder_of(path), secret, sandboxed) for path in missing)
    for name in _graded(tasks, jobs) if isinstance(jobs, int) else jobs.graded(tasks, sandboxed):
        done += 1
        say(done, len(submissions), name)
    graded = [
        (folder, results.read(folder, items)) for path in submissions for folder in [to / results.folder_of(path)]
    ]
    rows = [row for _, row in graded if row is not None]
    results.write_class(rows, items, to, results.remarks([folder for folder, row in graded if row is not None]))
    return [dict(row) for row in rows]


def _of_one_assignment(to: Path, name: str) -> None:
    """Raises ValueError where `to` holds grades of another assignment: a wrong number would overwrite them."""
    place = to / ASSIGNMENT
    if not place.is_file():
        write_atomically(place, name.encode())
    elif (held := place.read_text(encoding="utf-8", errors="replace")) != name:
        raise ValueError(f"--to must not hold grades of another assignment; {to} holds those of {printable(held)[:60]}")


def _graded(tasks: Iterator[Task], jobs: int) -> Iterator[str]:
    """Names of submissions as they are done."""
    if jobs == 1:
        yield from map(grade_one, tasks)
        return
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        waiting: set[Future[str]] = set()
        for task in tasks:
            waiting.add(pool.submit(grade_one, task))
            if len(waiting) >= AHEAD * jobs:
                finished, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                yield from (future.result() for future in finished)
        for future in waiting:
            yield future.result()


@lru_cache(maxsize=4)
def _loaded(assignment: Path, secret: bytes) -> tuple[tuple[Item, ...], dict[str, Callable[..., object]]]:
    items = rubrics.rubric(assignment / "rubric.toml")
    return items, rubrics.checks(items, assignment / "tests", secret)


def grade_one(task: Task) -> str:
    """One submission, from file to results."""
    items, checks = _loaded(task.assignment, task.secret)
    try:
        submission = read(task.submission)
    except (SubmissionError, OSError) as error:
        lost = tuple(Outcome(item, 0.0, "the submission could not be read") for item in items)
        refused = rubrics.one_line(str(error))
        results.write(Graded(name_of(task.submission), lost, refused=refused, sandboxed=task.sandboxed), task.to)
        return name_of(task.submission)
    with scratch("submission") as directory:
        path = directory / "submission.py"
        path.write_text(submission.source, encoding="utf-8")
        if task.sandboxed:
            jail = Jail(path, task.assignment, slot=os.getpid() % 4096)
            with task.student(jail) as student:
                outcomes = rubrics.run(items, checks, student)
            graded = Graded(submission.name, tuple(outcomes), student.notes)
        else:
            outcomes = rubrics.run(items, checks, LocalStudent(path, task.assignment))
            graded = Graded(submission.name, tuple(outcomes), sandboxed=False)
    told = tuple(replace(outcome, why=submission.placed(outcome.why)) for outcome in graded.outcomes)
    results.write(replace(graded, outcomes=told), task.to)
    return submission.name


__all__ = ["SandboxError", "Task", "grade", "grade_one", "secret_of", "submissions_in"]
