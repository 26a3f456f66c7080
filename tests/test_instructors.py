"""The instructor's guide says what is true: its five commands work, its small assignment is one."""

from __future__ import annotations

import csv
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from dsim.cli import app
from dsim.grading import folder
from dsim.grading.regions import stub
from dsim.grading.selfcheck import outcomes

ROOT = Path(__file__).parent.parent
GUIDE = (ROOT / "assignments" / "INSTRUCTORS.md").read_text()
BLOCKS = re.findall(r"```(\w+)\n(.*?)```", GUIDE, flags=re.S)
FIVE = BLOCKS[0][1].splitlines()
SMALL = {match[1]: text for _, text in BLOCKS if (match := re.match(r"# (\S+\.(?:py|toml))\n", text))}


def test_there_are_five_commands_and_the_readme_knows_the_guide() -> None:
    assert len(FIVE) == 5 and BLOCKS[0][0] == "sh"
    assert "(assignments/INSTRUCTORS.md)" in (ROOT / "README.md").read_text()
    assert "INSTRUCTORS" not in {found.path.name for found in folder.assignments(ROOT / "assignments")}


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("bwrap") or not (ROOT / ".git").exists(), reason="needs bubblewrap and a clone")
def test_the_five_commands(tmp_path: Path) -> None:
    """From a clone of this repository: each line as it stands, but for the address, the place, and what is there."""
    clone, packages = tmp_path / "dsim", tmp_path / "packages"
    equivalents = {
        "git clone ADDRESS dsim": f"git clone -q '{ROOT}' dsim",
        "sudo apt-get install bubblewrap": "command -v bwrap",
        "python -m pip install .": f"'{sys.executable}' -m pip install -q --no-deps --no-build-isolation --target "
        f"'{packages}' .",
        "dsim assignments": f"'{sys.executable}' -m dsim assignments",
        "dsim grade": f"cd '{tmp_path}' && '{sys.executable}' -m dsim grade",
    }
    for line in FIVE:
        known = [ours for ours in equivalents if line.startswith(ours)]
        assert len(known) == 1, line
        if line.startswith("dsim grade"):  # what students hand in
            (tmp_path / "handed-in").mkdir()
            shutil.copy(clone / "assignments/01_time_stepping/solution.py", tmp_path / "handed-in/ann.py")
            shutil.copy(clone / "handouts/01_time_stepping/01_time_stepping.py", tmp_path / "handed-in/bob.py")
        command = line.replace(known[0], equivalents[known[0]])
        environment = {**os.environ, "PYTHONPATH": str(packages)}
        done = subprocess.run(["bash", "-c", command], cwd=clone if clone.exists() else tmp_path, env=environment,
                              capture_output=True, text=True)  # fmt: skip
        assert done.returncode == 0, (line, done.stdout + done.stderr)
    rows = list(csv.DictReader((tmp_path / "grades" / "grades.csv").read_text().splitlines()))
    assert [(row["submission"], float(row["score"])) for row in rows] == [("ann", 16), ("bob", 0)]


def small(tmp_path: Path) -> folder.Assignment:
    for name, text in SMALL.items():
        path = tmp_path / "21_falling" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text.split("\n", 1)[1])
    for name in ("handout.md", "kit.py"):
        (tmp_path / "21_falling" / name).touch()
    return folder.find("21", tmp_path)


def test_the_small_assignment_is_one(tmp_path: Path) -> None:
    """Its solution gets everything, its stub nothing, its mutant loses what its first line says."""
    assignment = small(tmp_path)
    solution = (assignment.path / "solution.py").read_text()
    assert [outcome.score for outcome in outcomes(assignment, solution)] == [2, 3]
    assert [outcome.score for outcome in outcomes(assignment, stub(solution))] == [0, 0]
    mutant = (assignment.path / "mutants" / "forgets_the_two.py").read_text()
    assert mutant.startswith("# loses: fall\n")
    assert [outcome.score for outcome in outcomes(assignment, mutant)] == [0.5, 3]


def test_files_that_are_not_graded_are_named_and_those_that_have_changed(tmp_path: Path) -> None:
    small(tmp_path / "assignments")
    handed_in = tmp_path / "handed-in"
    (handed_in / "dee").mkdir(parents=True)
    (handed_in / "ann.py").write_text("def fall(height, gravity): return height\n")
    (handed_in / "bob.zip").touch()
    (handed_in / ".hidden").touch()
    words = ["grade", "21", str(handed_in), "--assignments", str(tmp_path / "assignments"), "--unsandboxed"]
    found = CliRunner().invoke(app, [*words, "--to", str(tmp_path / "out")])
    assert found.exit_code == 0 and "not graded, for they are no .py or .ipynb files: bob.zip, dee/" in found.stderr
    assert "changed since" not in found.stderr
    os.utime(handed_in / "ann.py", (2e9, 2e9))
    found = CliRunner().invoke(app, [*words, "--to", str(tmp_path / "out")])
    assert found.exit_code == 0 and "changed since they were graded: ann;" in found.stderr
    (handed_in / "ann.py").unlink()
    found = CliRunner().invoke(app, [*words, "--to", str(tmp_path / "out")])
    assert isinstance(found.exception, ValueError) and "it has directories: copy" in str(found.exception)
