"""From a MyST source to a notebook with outputs, always the same but for what the cells print."""

from __future__ import annotations

import asyncio
import json
import os
import re
import subprocess
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from dsim.lectures.folder import Lecture
from dsim.pictures.files import write_atomically

SOLUTION, EXERCISE, HIDDEN = "solution", "exercise", "hide-cell"
PATIENCE = 45  # s for one lecture
KERNEL = {"display_name": "Python 3", "language": "python", "name": "python3"}


class LectureError(RuntimeError):
    """A lecture that cannot be read or run; the message names the lecture, the cell and what it said."""


def read(lecture: Lecture) -> Any:
    """The cells of a source, without outputs.  Raises LectureError for what is no MyST notebook."""
    import jupytext

    try:
        notebook = jupytext.read(lecture.path, fmt="md:myst")
    except Exception as error:  # jupytext raises what its parsers raise
        raise LectureError(f"{lecture.path.name} must be a MyST notebook: {error}") from error
    notebook.metadata = {"kernelspec": dict(KERNEL), "language_info": {"name": "python"}}
    for number, cell in enumerate(notebook.cells):
        cell["id"] = f"cell-{number}"
        if cell.cell_type == "markdown":  # other lectures are notebooks, too
            cell["source"] = re.sub(r"\]\((\d\d_\w+)\.md(#[^)]*)?\)", r"](\1.ipynb)", cell.source)
        if HIDDEN in tags(cell) or "hide-input" in tags(cell):
            cell.metadata["jupyter"] = {"source_hidden": True}
        if HIDDEN in tags(cell):  # what a solution prints is its answer
            cell.metadata["jupyter"]["outputs_hidden"] = True
    notebook.nbformat, notebook.nbformat_minor = 4, 5
    return notebook


def tags(cell: Any) -> list[str]:
    """The tags of a cell, none where it has no list of them."""
    return list(cell.metadata.get("tags", ()))


def for_students(notebook: Any) -> Any:
    """Without the cells tagged "solution", and without links to files that students may not have beside it."""
    import copy

    kept = copy.deepcopy(notebook)
    kept.cells = [cell for cell in kept.cells if SOLUTION not in tags(cell)]
    for cell in kept.cells:
        if cell.cell_type == "markdown":
            cell["source"] = re.sub(r"(?<!!)\[([^\]]+)\]\((?![a-z]+:)[^)]+\)", r"\1", cell.source)
    return kept


def execute(lecture: Lecture, notebook: Any) -> float:
    """Run all cells in place, in an empty directory of their own; the seconds it took.

    Raises LectureError with the cell and the last line of its error.
    """
    import nbclient
    from nbclient.exceptions import CellExecutionError, CellTimeoutError, DeadKernelError

    package = str(Path(__file__).parents[2])  # the kernel imports the dsim that runs it
    paths = os.pathsep.join(filter(None, [package, os.environ.get("PYTHONPATH", "")]))
    own = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MPLBACKEND": "agg", "PYTHONPATH": paths}
    start = time.perf_counter()
    with TemporaryDirectory(prefix="dsim-lecture-") as directory:
        client = nbclient.NotebookClient(notebook, timeout=PATIENCE, resources={"metadata": {"path": directory}})
        try:
            quiet: dict[str, Any] = {
                "env": {**os.environ, **own},
                "stderr": subprocess.DEVNULL,
            }  # the kernel's, not the cells'
            asyncio.run(client.async_execute(**quiet))
        except (CellExecutionError, CellTimeoutError, DeadKernelError) as error:
            raise LectureError(f"{lecture.path.name}, {_place(notebook)}: {_last_line(error)}") from error
    for cell in notebook.cells:
        _settle(cell)
    return time.perf_counter() - start


def _place(notebook: Any) -> str:
    """The cell that ended a run: the first one without a complete execution."""
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    for number, cell in enumerate(code, start=1):
        failed = any(output.output_type == "error" for output in cell.outputs)
        if failed or cell.get("execution_count") is None:
            first = next((line for line in cell.source.splitlines() if line.strip()), "")
            return f"code cell {number} ({first[:50]})"
    return "the last cell"


def _last_line(error: Exception) -> str:
    text = re.sub(r"\x1b\[[0-9;]*m", "", str(error)).strip()
    told = getattr(error, "ename", "")
    return f"{told}: {getattr(error, 'evalue', '')}" if told else (text.splitlines() or [type(error).__name__])[-1]


def _settle(cell: Any) -> None:
    """Drop what differs from run to run."""
    cell.metadata.pop("execution", None)
    for output in cell.get("outputs", ()):
        output.pop("execution_count", None) if output.output_type != "execute_result" else None
        if output.output_type == "stream":
            output["text"] = re.sub(r"\x1b\[[0-9;]*m", "", output["text"])


def write(notebook: Any, path: Path) -> None:
    """As JSON with sorted keys, whole or not at all."""
    text = json.dumps(notebook, indent=1, sort_keys=True, ensure_ascii=False) + "\n"
    write_atomically(path, text.encode())


def differences(lecture: Lecture) -> list[str]:
    """Where the committed notebook is not that of the source: nothing, or one line each."""
    import nbformat

    if not lecture.notebook.is_file():
        return [f"{lecture.notebook.name} is missing: dsim lectures build {lecture.number}"]
    try:
        committed = nbformat.read(lecture.notebook, as_version=4)
    except Exception as error:  # nbformat raises what its validators raise
        return [f"{lecture.notebook.name} is no notebook: {str(error)[:80]}"]
    ours, theirs = (
        [(cell.cell_type, "".join(cell.source).strip()) for cell in book.cells] for book in (read(lecture), committed)
    )
    found = []
    for number, (one, other) in enumerate(zip(ours, theirs, strict=False), start=1):
        if one != other:
            found.append(f"{lecture.notebook.name}: cell {number} differs from the source")
    if len(ours) != len(theirs):
        found.append(f"{lecture.notebook.name} has {len(theirs)} cells; the source has {len(ours)}")
    empty = [c for c in committed.cells if c.cell_type == "code" and c.get("execution_count") is None]
    if empty:
        found.append(f"{lecture.notebook.name}: {len(empty)} cells were not run")
    return found
