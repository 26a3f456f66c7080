"""Every assignment is fair; stubs come from solutions; students get what they need and nothing else."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from dsim.cli import app, main
from dsim.grading import folder
from dsim.grading.regions import stub
from dsim.grading.release import release
from dsim.grading.selfcheck import outcomes, selfcheck
from dsim.pictures.assignments import SUCCESS
from dsim.pictures.style import to_png

ROOT = Path(__file__).parent.parent / "assignments"
ALL = folder.assignments(ROOT)


@pytest.mark.parametrize("every", [12, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("assignment", ALL, ids=lambda assignment: assignment.path.name)
def test_an_assignment_is_fair(assignment: folder.Assignment, every: int) -> None:
    """Every twelfth mutant in the quick stage, all of them in the slow one."""
    checks = list(selfcheck(folder.find(assignment.number, ROOT), every=every))
    assert len(checks) > (15 if every == 1 else 7) and not [str(check) for check in checks if not check.passed]


@pytest.mark.parametrize("assignment", ALL, ids=lambda assignment: assignment.path.name)
def test_a_handout_has_its_picture_and_its_items(assignment: folder.Assignment) -> None:
    text = (assignment.path / "handout.md").read_text()
    assert "](success.png)" in text and len(to_png(SUCCESS[assignment.number](), dpi=60)) > 1000
    assert 5_000 < (assignment.path / "success.png").stat().st_size < 400_000
    assert f"dsim check-submission {assignment.path.name}.py" in text


def test_an_unfair_assignment_is_found(tmp_path: Path) -> None:
    """Mutation: a mutant that keeps its points, an alternative that loses some, and a stub that earns some."""
    shutil.copytree(ROOT / "01_time_stepping", tmp_path / "01_time_stepping")
    for part, kept in (("mutants", "drag_pushes.py"), ("alternatives", "loops.py")):
        for path in (tmp_path / "01_time_stepping" / part).glob("*.py"):
            if path.name != kept:
                path.unlink()
    assignment = folder.find("01", tmp_path)
    mutant = assignment.path / "mutants" / "drag_pushes.py"
    mutant.write_text(mutant.read_text().replace("# loses: forces", "# loses: energy"))
    alternative = assignment.path / "alternatives" / "loops.py"
    alternative.write_text(alternative.read_text().replace("2 / (stiffness", "3 / (stiffness"))
    solution = assignment.path / "solution.py"
    solution.write_text(solution.read_text().replace("    # BEGIN SOLUTION: part 5 of the handout\n", "", 1).replace(
        "mass / stiffness)\n    # END SOLUTION", "mass / stiffness)"))  # fmt: skip
    red = [str(check) for check in selfcheck(assignment) if not check.passed]
    expected = ("mutants; 1", "alternatives; 1", "the stub scores nothing; 2",
                "alternative loops loses nothing; lost", "mutant drag_pushes loses energy; lost forces")  # fmt: skip
    for words in expected:
        assert any(words in line for line in red), (words, red)
    mutant.write_text(mutant.read_text().replace("# loses: energy", "# loses: energi"))
    with pytest.raises(ValueError, match=r"drag_pushes\.py loses energi, no item of the rubric; items: forces, "):
        list(selfcheck(assignment))


def test_a_stub_is_made_from_the_solution() -> None:
    made = stub("def f(x):\n    # BEGIN SOLUTION: twice x\n    return 2 * x\n    # END SOLUTION\n")
    assert made == "def f(x):\n    # TO DO: twice x\n    raise NotImplementedError\n"
    for source, words in (
        ("x = 1\n", "at least one region"),
        ("# BEGIN SOLUTION: a\nx = 1\n", "line 1 is not ended"),
        ("# END SOLUTION\n", "line 1 does not"),
        ("# BEGIN SOLUTION: a\n# BEGIN SOLUTION: b\n# END SOLUTION\n", "line 2 does not"),
        ("# begin\n# BEGIN SOLUTION\n", "line 2 does not"),
    ):
        with pytest.raises(ValueError, match=words):
            stub(source)


def test_a_stub_loses_everything_without_a_traceback() -> None:
    source = stub((ROOT / "01_time_stepping" / "solution.py").read_text())
    found = outcomes(folder.find("01", ROOT), source)
    assert all(outcome.score == 0 and "NotImplementedError" in outcome.why for outcome in found)
    assert all("Traceback" not in outcome.why for outcome in found)


def test_students_get_nothing_that_is_hidden(tmp_path: Path) -> None:
    target = release(folder.find("01", ROOT), tmp_path)
    names = {str(path.relative_to(target)) for path in target.rglob("*") if path.is_file()}
    assert names == {"01_time_stepping.py", "handout.md", "kit.py", "success.png", "tests/test_public.py"}
    text = "".join(path.read_text() for path in target.rglob("*") if path.suffix in (".py", ".md"))
    assert "SOLUTION" not in text and "np.sqrt(mass / stiffness)" not in text and "test_rk4_order" not in text
    with pytest.raises(ValueError, match="somebody's work"):
        release(folder.find("01", ROOT), tmp_path)


def test_the_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def run(*arguments: str) -> tuple[int, str]:
        result = CliRunner().invoke(app, list(arguments))
        return result.exit_code, result.stdout

    where = ["--assignments", str(ROOT)]
    code, out = run("assignments", "list", *where)
    assert code == 0 and "Time stepping" in out
    assert run("assignments", "release", "1", "--to", str(tmp_path), *where)[0] == 0
    file = tmp_path / "01_time_stepping" / "01_time_stepping.py"
    code, out = run("check-submission", str(file), *where)
    assert code == 1 and "0 of 6 public points; 10 more are hidden" in out and "Hint:" not in out
    assert "Not written yet: forces, forward_euler" in out and "NotImplementedError (line" in out
    file.write_text((ROOT / "01_time_stepping" / "solution.py").read_text())
    code, out = run("check-submission", str(file), *where)
    assert code == 0 and "6 of 6 public points" in out and "Not written yet" not in out
    file.write_text(file.read_text() + "\nimport matplotlib.pyplot as plt\n")
    code, out = run("check-submission", str(file), *where)
    assert code == 1 and "imports matplotlib.pyplot, which is not there when you are graded (line" in out
    right = (ROOT / "01_time_stepping" / "solution.py").read_text()
    file.write_text(right.replace("def symplectic_euler(", "def symplectic_Euler("))
    code, out = run("check-submission", str(file), *where)
    assert out.count("NameError") == 1 and "Nothing could be checked" in out and "Hint" not in out
    assert "did you mean symplectic_Euler?" in " ".join(out.split())
    file.write_text(right + "\ndef forward_euler(a, x, v, t, h):\n    k = h * a(x, v, t)\n    x += h * v\n    v += k\n"
                    "    return x, v\n")  # fmt: skip
    code, out = run("check-submission", str(file), *where)
    assert code == 0 and "Changes the arrays that it is given: forward_euler." in out
    file.write_text(right + "\ndef forces(v, mass, gravity, drag, wind):\n    pass\n")
    code, out = run("check-submission", str(file), *where)
    assert code == 1 and "nothing (None): is there a return?" in " ".join(out.split()) and out.count("Hint:") == 1
    file.rename(tmp_path / "mine.py")
    for arguments, words in ((["check-submission", str(tmp_path / "mine.py"), *where], "--assignment must say which"),
                             (["check-submission", str(file), *where], "there is no file"),
                             (["assignments", "release", "9", "--to", "x", *where], "NN must be one of")):  # fmt: skip
        monkeypatch.setattr("sys.argv", ["dsim", *arguments])
        with pytest.raises(SystemExit) as stop:
            main()
        assert stop.value.code == 2 and words in capsys.readouterr().err
