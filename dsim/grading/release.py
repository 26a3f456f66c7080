"""What students get of an assignment: the stub, the handout with its picture, the kit and the public checks."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from dsim.grading.folder import Assignment
from dsim.grading.notebook import notebook
from dsim.grading.regions import stub

GIVEN = ("handout.md", "kit.py", "tests/test_public.py")


def release(assignment: Assignment, directory: Path, as_notebook: bool = False) -> Path:
    """Write NN_topic/ into `directory`, whole or not at all; nothing of the solution, rubric or hidden checks in it.

    The stub is NN_topic.py, or NN_topic.ipynb.
    Raises ValueError where NN_topic is there already: a student's work may be in it.
    """
    target = Path(os.path.abspath(directory)) / assignment.path.name
    if directory.exists() and not directory.is_dir():
        raise ValueError(f"--to must be a directory; {directory} is a file")
    if target.exists():
        raise ValueError(f"--to must not hold {target.name} yet; {target} is there, and may be somebody's work")
    source = stub((assignment.path / "solution.py").read_text(encoding="utf-8"))
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f".{target.name}.{os.getpid()}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    (partial / "tests").mkdir(parents=True)
    try:
        text = notebook(source, target.name) if as_notebook else source
        (partial / f"{target.name}{'.ipynb' if as_notebook else '.py'}").write_text(text, encoding="utf-8")
        pictures = [path.name for path in sorted(assignment.path.glob("*.png"))]
        for name in (*GIVEN, *pictures):
            shutil.copyfile(assignment.path / name, partial / name)
        if as_notebook:  # the handout names the file that there is
            handout = (partial / "handout.md").read_text(encoding="utf-8")
            (partial / "handout.md").write_text(handout.replace(f"{target.name}.py", f"{target.name}.ipynb"),
                                                encoding="utf-8")  # fmt: skip
        partial.rename(target)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return target
