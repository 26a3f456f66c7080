"""`dsim lectures` on a terminal."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Table as RichTable
from rich.text import Text

from dsim.grading import folder as assignments
from dsim.lectures import folder, notebook, rules
from dsim.lectures.folder import Lecture
from dsim.lectures.notebook import LectureError
from dsim.report.terminal import console

NEEDED = ("jupytext", "nbclient", "nbformat", "ipykernel")
SITE_NEEDS = ("sphinx", "myst_nb", "furo")
Outcome = tuple[Lecture, Any, float, str]  # its notebook, seconds, and what went wrong


def need(modules: Sequence[str]) -> None:
    """Raises ValueError that says how to install what is missing."""
    missing = [name for name in modules if importlib.util.find_spec(name) is None]
    if missing:
        raise ValueError(f'lectures need {", ".join(missing)}: pip install ".[lectures]" where dsim is checked out')


def listing(where: Path | None) -> None:
    """A row a lecture."""
    table = RichTable(expand=False, padding=(0, 1), box=None, header_style="bold")
    for name in ("NN", "title", "notebook"):
        table.add_column(name)
    for lecture in folder.lectures(folder.root(where)):
        state = lecture.notebook.name if lecture.notebook.is_file() else "not built"
        table.add_row(lecture.number, escape(lecture.title), state)
    console().print(table)


def run_all(chosen: Sequence[Lecture], jobs: int, student: bool = False) -> list[Outcome]:
    """Read and execute; several at a time, each in a kernel of its own."""
    columns = (BarColumn(bar_width=24), MofNCompleteColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=console(stderr=True), transient=True) as bar, ThreadPoolExecutor(jobs) as pool:
        task = bar.add_task("lectures", total=len(chosen))

        def one(lecture: Lecture) -> Outcome:
            try:
                book = notebook.read(lecture)
                book = notebook.for_students(book) if student else book
                seconds = notebook.execute(lecture, book)
                return lecture, book, seconds, ""
            except LectureError as error:
                return lecture, None, 0.0, str(error)
            finally:
                bar.update(task, advance=1, description=escape(lecture.path.stem))

        return list(pool.map(one, chosen))


def build(numbers: Sequence[str], where: Path | None, to: Path | None, html: bool, student: bool, jobs: int) -> int:
    """Execute, write notebooks (beside the sources unless told otherwise), and the site if asked for."""
    need(NEEDED + SITE_NEEDS * html)
    directory = folder.root(where)
    chosen = folder.select(directory, numbers)
    if student and to is None:
        raise ValueError("--to must say where the student edition goes: it must not overwrite the lecturer's")
    outcomes, out = run_all(chosen, jobs, student), console()
    notebooks = directory if to is None or (html and not student) else to
    for lecture, book, seconds, error in outcomes:
        if error:
            out.print(Text(f"{lecture.path.stem}: {error}", style="red"), soft_wrap=True)
            continue
        notebook.write(book, notebooks / lecture.notebook.name)
        out.print(f"{lecture.path.stem}: {seconds:.1f} s", markup=False)
    if any(error for *_, error in outcomes):
        return 1
    if html:
        from dsim.lectures import site

        target = (to or Path("dsim-course")) if not student else notebooks / "site"
        with console(stderr=True).status("site"):
            index = site.build([(lecture, book) for lecture, book, _, _ in outcomes], _assignments(), target)
        out.print(f"open {index}", soft_wrap=True, markup=False)
    return 0


def _assignments() -> Path | None:
    try:
        return assignments.root()
    except ValueError:
        return None


def check(numbers: Sequence[str], where: Path | None, jobs: int) -> int:
    """The rules, the asserts in the cells, and the committed notebooks; what is red is printed."""
    need(NEEDED)
    chosen, out, bad = folder.select(folder.root(where), numbers), console(), 0
    for lecture, book, seconds, error in run_all(chosen, jobs):
        found = [error] if error else []
        if not error:
            checks = [*rules.check_source(lecture, book), *rules.check_outputs(lecture, book)]
            found += [str(each) for each in checks if not each.passed]
            found += notebook.differences(lecture)
        bad += bool(found)
        out.print(Text(f"{lecture.path.stem}: {'red' if found else 'ok'}, {seconds:.1f} s"), soft_wrap=True)
        for line in found:
            out.print(Text(f"    {line}", style="red"), soft_wrap=True)
    return 1 if bad else 0


def open_all(number: str, where: Path | None) -> int:
    """Start Jupyter on the notebooks; on a copy where the folder cannot be written."""
    need(("jupyterlab",))
    directory = folder.root(where)
    lecture = folder.select(directory, [number])[0] if number else None
    if not os.access(directory, os.W_OK):
        copy = Path("dsim-lectures").resolve()
        shutil.copytree(
            directory, copy, dirs_exist_ok=True, ignore=lambda folder, names: [n for n in names if (copy / n).exists()]
        )
        directory = copy
        console().print(f"your copy: {copy}", soft_wrap=True, markup=False)
    words = [sys.executable, "-m", "jupyterlab", *([str(directory / lecture.notebook.name)] if lecture else [])]
    return subprocess.run(words, cwd=directory).returncode
