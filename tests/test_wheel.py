"""What is installed works away from the checkout: assignments and lectures travel with the wheel."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from dsim.cli import main
from dsim.grading import folder

ROOT = Path(__file__).parent.parent
pytest.importorskip("hatchling")


def ran(*words: str | Path, cwd: Path, python_path: str = "", status: int = 0) -> str:
    """What a command prints."""
    environment = {**os.environ, "PYTHONPATH": python_path, "COLUMNS": "80"}
    done = subprocess.run([sys.executable, *words], cwd=cwd, env=environment, capture_output=True, text=True)
    assert done.returncode == status, done.stdout + done.stderr
    return done.stdout + done.stderr


def built(source: Path, to: Path) -> Path:
    ran("-m", "hatchling", "build", "-t", "wheel", "-d", to, cwd=source)
    return next(to.glob("*.whl"))


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built(ROOT, tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("installed")
    ran("-m", "pip", "install", "-q", "--no-deps", "--no-index", "--target", target, wheel, cwd=target)
    return target


def tracked(directory: str) -> set[str]:
    """Files of a directory that a wheel must hold."""
    found = (path for path in (ROOT / directory).rglob("*") if path.is_file() and "__pycache__" not in path.parts)
    return {path.relative_to(ROOT).as_posix() for path in found}


def test_the_wheel_carries_the_course(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    expected = {f"dsim/course/{name}" for directory in ("assignments", "lectures") for name in tracked(directory)}
    assert expected <= names and any(name.endswith("test_hidden.py") for name in expected)


def test_the_source_archive_gives_the_same_wheel(wheel: Path, tmp_path: Path) -> None:
    ran("-m", "hatchling", "build", "-t", "sdist", "-d", tmp_path, cwd=ROOT)
    with tarfile.open(next(tmp_path.glob("*.tar.gz"))) as archive:
        archive.extractall(tmp_path / "source", filter="data")
    again = built(next((tmp_path / "source").iterdir()), tmp_path / "wheel")
    assert set(zipfile.ZipFile(again).namelist()) == set(zipfile.ZipFile(wheel).namelist())


@pytest.mark.slow
def test_a_student_and_an_instructor_with_the_wheel_alone(installed: Path, tmp_path: Path) -> None:
    """From an empty directory: list, release, check a submission inside the released folder, grade."""

    def dsim(*words: str, cwd: Path = tmp_path, status: int = 0) -> str:
        return ran("-m", "dsim", *words, cwd=cwd, python_path=str(installed), status=status)

    assert str(installed) in ran("-c", "import dsim; print(dsim.__file__)", cwd=tmp_path, python_path=str(installed))
    assert "Time stepping" in dsim("assignments", "list")
    dsim("assignments", "release", "01", "--to", ".")
    released = tmp_path / "01_time_stepping"
    assert "0 of 6 public points" in dsim("check-submission", "01_time_stepping.py", cwd=released, status=1)
    (tmp_path / "handed-in").mkdir()
    solution = installed / "dsim" / "course" / "assignments" / "01_time_stepping" / "solution.py"
    shutil.copy(solution, tmp_path / "handed-in" / "ann.py")
    shutil.copy(released / "01_time_stepping.py", tmp_path / "handed-in" / "bob.py")
    how = [] if shutil.which("bwrap") else ["--unsandboxed"]
    assert "2 submissions" in dsim("grade", "01", "handed-in", "--to", "grades", *how)
    scores = [json.loads((tmp_path / "grades" / name / "results.json").read_text())["score"] for name in ("ann", "bob")]
    assert scores == [16, 0]
    dsim("assignments", "gradescope", "01", "--to", "01.zip")
    names = zipfile.ZipFile(tmp_path / "01.zip").namelist()
    assert {"setup.sh", "run_autograder", "package/dsim/grading/there/__main__.py"} <= set(names)
    assert not [name for name in names if "course" in name or "solution" in name]  # none of what the wheel carries


def test_where_there_are_none_the_error_says_where_it_looked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(folder, "__file__", str(tmp_path / "site" / "dsim" / "grading" / "folder.py"))
    monkeypatch.setattr("sys.argv", ["dsim", "assignments", "list"])
    with pytest.raises(SystemExit) as stop:
        main()
    told = capsys.readouterr().err
    assert stop.value.code == 2 and "--assignments DIR" in told
    for place in (
        tmp_path / "assignments",
        tmp_path / "site" / "assignments",
        tmp_path / "site/dsim/course/assignments",
    ):
        assert str(place) in told
    (tmp_path / "site/dsim/course/assignments/01_a").mkdir(parents=True)
    assert folder.root() == tmp_path / "site/dsim/course/assignments"
    (tmp_path / "assignments/02_b").mkdir(parents=True)
    assert folder.root() == tmp_path / "assignments"
