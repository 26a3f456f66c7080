"""The autograder's zip, unpacked and run as Gradescope does, with its directories elsewhere."""

from __future__ import annotations

import json
import os
import shutil
import stat
import subprocess
import sys
import sysconfig
import tempfile
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy
import pytest
import scipy
from typer.testing import CliRunner

from dsim.cli import app
from dsim.grading import gradescope
from dsim.grading.another_user import FIRST_USER, end_all_of, processes_of
from dsim.grading.there.__main__ import handed_in

ROOT = Path(__file__).parent.parent
FIXTURE = Path(__file__).parent / "grading_fixture"
SOLUTION = (FIXTURE / "solution.py").read_text()
PUBLIC = f"{sys.version_info.major}.{sys.version_info.minor}"
needs_bubblewrap = pytest.mark.skipif(shutil.which("bwrap") is None, reason="bubblewrap is not installed")
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can run submissions as another user")


def linked(source: str, target: str) -> str:
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)
    return target


@pytest.fixture(scope="module")
def python() -> Iterator[Path]:
    """A Python with NumPy and SciPy that any user may read, as setup.sh makes one: DSIM_HOME."""
    home = Path(tempfile.mkdtemp(prefix="dsim-home-"))
    home.chmod(0o755)
    (home / "bin").mkdir()
    linked(os.path.realpath(sys.executable), str(home / "bin" / f"python{PUBLIC}"))
    (home / "bin" / "python").symlink_to(f"python{PUBLIC}")
    left_out = shutil.ignore_patterns("site-packages", "dist-packages", "test", "idlelib", "ensurepip", "config-*")
    standard = Path(sysconfig.get_path("stdlib"))
    shutil.copytree(standard, home / "lib" / standard.name, ignore=left_out, copy_function=linked)
    for library in Path(sys.base_prefix, "lib").glob("libpython*.so*"):
        linked(str(library), str(home / "lib" / library.name))
    for module in (numpy, scipy):
        place = Path(str(module.__file__)).parent
        for part in (place, place.with_name(f"{place.name}.libs")):
            if part.is_dir():
                shutil.copytree(part, home / "packages" / part.name, copy_function=linked)
    try:
        yield home
    finally:
        shutil.rmtree(home)


class Container:
    """Gradescope's directories below a root of our own."""

    def __init__(self, root: Path, home: Path, sandbox: bool) -> None:
        self.root, self.home = root, home
        if sandbox:  # this Python: the sandbox mounts it wherever it is
            self.home = root.parent / "home"
            (self.home / "bin").mkdir(parents=True)
            (self.home / "bin" / "python").symlink_to(sys.executable)
        places = (str(self.home / "packages"), sysconfig.get_path("purelib"), sysconfig.get_path("platlib"))
        self.environment = {**os.environ, "DSIM_AUTOGRADER": str(root), "DSIM_HOME": str(self.home),
                            "PYTHONPATH": ":".join(places)}  # fmt: skip
        if not sandbox:  # as in a container that may not make namespaces
            fake = root.parent / "bin" / "bwrap"
            fake.parent.mkdir(exist_ok=True)
            fake.write_text("#!/bin/sh\necho 'bwrap: No permissions to create new namespace' >&2\nexit 1\n")
            fake.chmod(0o755)
            self.environment["PATH"] = f"{fake.parent}:{os.environ['PATH']}"

    def run(self, **submissions: str) -> tuple[int, str, dict[str, Any]]:
        """Exit status, what was printed, and results.json (empty if there is none)."""
        for name in ("submission", "results"):
            shutil.rmtree(self.root / name, ignore_errors=True)
            (self.root / name).mkdir()
        for name, source in submissions.items():
            (self.root / "submission" / f"{name}.py").write_text(source)
        done = subprocess.run(["bash", self.root / "source" / "run_autograder"], env=self.environment,
                              capture_output=True, text=True, timeout=120)  # fmt: skip
        path = self.root / "results" / "results.json"
        return done.returncode, done.stdout + done.stderr, json.loads(path.read_text()) if path.exists() else {}


def made(tmp_path: Path, *more: str) -> str:
    """Make the zip by the command and unpack it; what the command said."""
    shutil.copytree(FIXTURE, tmp_path / "assignments" / "01_tiny")
    (tmp_path / "assignments" / "01_tiny" / "handout.md").write_text("# Tiny\n")
    words = ["assignments", "gradescope", "1", "--to", str(tmp_path / "out" / "01.zip")]
    found = CliRunner().invoke(app, [*words, "--assignments", str(tmp_path / "assignments"), *more])
    assert found.exit_code == 0, found.output
    (tmp_path / "autograder").mkdir()
    with zipfile.ZipFile(tmp_path / "out" / "01.zip") as archive:
        archive.extractall(tmp_path / "autograder" / "source")
    return found.stdout


# The zip


def test_the_zip_holds_what_grading_needs_and_no_more(tmp_path: Path) -> None:
    said = made(tmp_path)
    with zipfile.ZipFile(tmp_path / "out" / "01.zip") as archive:
        names = archive.namelist()
        modes = {name: archive.getinfo(name).external_attr >> 16 & 0o777 for name in names}
    outside = {name for name in names if not name.startswith("package/")}
    course = {f"assignment/01_tiny/{name}" for name in ("kit.py", "rubric.toml", *TESTS)}
    ours = {"setup.sh", "run_autograder", "README.md", "requirements.txt", "settings.json", "secret"}
    assert outside == ours | course
    assert "package/dsim/grading/inside/worker.py" in names and not [name for name in names if "solution" in name]
    assert modes["setup.sh"] == modes["run_autograder"] == 0o755
    assert stat.S_IMODE((tmp_path / "out" / "01.zip").stat().st_mode) == 0o600
    secret = tmp_path / "out" / ".dsim-secret"
    assert (tmp_path / "autograder" / "source" / "secret").read_bytes() == secret.read_bytes() and str(secret) in said
    readme = (tmp_path / "autograder" / "source" / "README.md").read_text()
    assert gradescope.SANDBOX_OR_NOTHING in said and gradescope.SANDBOX_OR_NOTHING in readme


def test_a_secret_that_is_given_and_the_weaker_isolation_are_told(tmp_path: Path) -> None:
    (tmp_path / "mine").write_bytes(b"mine")
    said = made(tmp_path, "--secret", str(tmp_path / "mine"), "--other-user-there")
    source = tmp_path / "autograder" / "source"
    assert (source / "secret").read_bytes() == b"mine" and not (tmp_path / "out" / ".dsim-secret").exists()
    assert gradescope.OTHER_USER in said and gradescope.OTHER_USER in (source / "README.md").read_text()
    assert "network is open" in said and "ANOTHER USER" in said


def test_it_asks_pip_for_what_dsim_depends_on() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert sorted(gradescope.NEEDS) == sorted(project["dependencies"])


@pytest.mark.parametrize("name", gradescope.STARTED)
def test_the_scripts_are_bash(name: str) -> None:
    assert subprocess.run(["bash", "-n", ROOT / "dsim" / "grading" / "there" / name]).returncode == 0


@pytest.mark.parametrize("arguments, words", [
    (["01", "--to", "a.tar"], "ends in .zip"), (["01", "--to", "a.zip", "--secret", "none"], "--secret must be"),
    (["77", "--to", "a.zip"], "NN must be one of"),
])  # fmt: skip
def test_bad_usage(arguments: list[str], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    found = CliRunner().invoke(app, ["assignments", "gradescope", *arguments])
    assert isinstance(found.exception, ValueError | FileNotFoundError) and words in str(found.exception)
    assert not list(tmp_path.iterdir())


# A run where the sandbox can be made


@needs_bubblewrap
def test_a_run_in_the_sandbox(tmp_path: Path, python: Path) -> None:
    made(tmp_path)
    container = Container(tmp_path / "autograder", python, sandbox=True)
    status, said, found = container.run(anything=SOLUTION, kit="nothing = 1\n")
    assert status == 0 and found["score"] == 7 and found["extra_data"]["isolation"] == "sandbox", said
    assert found["output"] == "" and "graded: 7 of 7" in said and len(found["tests"]) == 3
    found = container.run(anything=SOLUTION + "\ndef double(x): return x\n")[2]
    assert found["score"] == 5
    found = container.run()[2]
    assert found["score"] == 0 and "hand in one file, 01_tiny.py or 01_tiny.ipynb; there is none" in found["output"]


@pytest.mark.parametrize("names, chosen", [
    (["mine.py"], "mine.py"), (["mine.ipynb", "kit.py", "tests/test_public.py", "notes.txt"], "mine.ipynb"),
    (["a.py", "01_tiny.py"], "01_tiny.py"), (["a.py", "b.py"], "there are a.py, b.py"),
    (["01_tiny.py", "01_tiny.ipynb"], "there are 01_tiny.ipynb, 01_tiny.py"), (["notes.txt"], "there is none"),
])  # fmt: skip
def test_which_file_is_graded(names: list[str], chosen: str, tmp_path: Path) -> None:
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    found = handed_in(tmp_path, "01_tiny")
    assert found.endswith(chosen) if isinstance(found, str) else found == tmp_path / chosen, found


# And where it cannot


def test_without_a_sandbox_nothing_is_graded(tmp_path: Path, python: Path) -> None:
    """No submission runs, and no result says 0."""
    made(tmp_path)
    container = Container(tmp_path / "autograder", python, sandbox=False)
    status, said, found = container.run(me=f"open({str(tmp_path / 'ran')!r}, 'w')\n")
    assert status == 1 and found == {} and not (tmp_path / "ran").exists()
    assert "NOT GRADED" in said and "--other-user-there" in said


TESTS = ("tests/test_public.py", "tests/test_hidden.py")
LOOP = "\ndef solve(A, b):\n    while True: pass\n"
ATTACKS = {
    "right": (SOLUTION, 7.0, ""),
    "loop": (SOLUTION + LOOP, 4.0, "too long"),
    "exit": (SOLUTION + "\ndef solve(A, b):\n    import os\n    os._exit(0)\n", 4.0, "ended its process"),
    "memory": (SOLUTION + "\ndef solve(A, b):\n    return np.ones(2**30)[:4]\n", 4.0, "Memory"),
    "forks": (SOLUTION + "\nimport os\ndef solve(A, b):\n    while True:\n        os.fork()\n", 4.0, ""),
    "stays": (
        SOLUTION + "\nimport os, time\nif os.fork() == 0:\n    os.setsid()\n    if os.fork() == 0:\n"
        "        while True: time.sleep(1)\n    os._exit(0)\n", 7.0, ""),
    "searches": (
        "import os\ndef double(x):\n    for root, d, files in os.walk('/tmp'):\n"
        "        if 'site-packages' in root: d.clear()\n        if 'settings.json' in files:\n"
        "            if 'other_user' in open(os.path.join(root, 'settings.json'), errors='replace').read():\n"
        "                raise RuntimeError(root)\n    return 3 * x\n", 0.0, "off by"),
    "knows": (
        "def double(x):\n    try: return len(open('ROOT/source/secret').read())\n"
        "    except PermissionError: raise ValueError('closed')\n", 0.0, "ValueError: closed"),
    "forges": (
        SOLUTION + "\nimport os, glob\ndef solve(A, b):\n    open('ROOT/results/results.json', 'w').write('{}')\n",
        4.0, "PermissionError"),
    "becomes root": (SOLUTION + "\nimport os\ndef solve(A, b):\n    os.setuid(0)\n", 4.0, "PermissionError"),
    "kills": (
        SOLUTION + "\nimport os\ndef solve(A, b):\n    os.kill(os.getppid(), 9)\n    while True: pass\n", 4.0, ""),
    "kills the grader": (
        SOLUTION + "\nimport os\ndef solve(A, b):\n    os.kill(int(open(f'/proc/{os.getppid()}/stat').read()"
        ".rpartition(')')[2].split()[1]), 9)\n", 4.0, "PermissionError"),
}  # fmt: skip


@pytest.fixture(scope="module")
def weaker(tmp_path_factory: pytest.TempPathFactory, python: Path) -> Container:
    tmp_path = tmp_path_factory.mktemp("weaker")
    tmp_path.chmod(0o755)
    made(tmp_path, "--other-user-there")
    return Container(tmp_path / "autograder", python, sandbox=False)


@needs_root
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if i % 3 else []) for i, name in enumerate(ATTACKS)]
)
def test_an_attack_on_the_weaker_isolation(name: str, weaker: Container) -> None:
    """Each gets what it earned, the weaker isolation is told in the result, nothing is left running."""
    source, score, why = ATTACKS[name]
    status, said, found = weaker.run(me=source.replace("ROOT", str(weaker.root)))
    assert status == 0 and found["score"] == score, (said, found)
    assert why in " | ".join(test["output"] for test in found["tests"])
    assert "weaker isolation" in found["output"] and found["extra_data"] == {
        "submission": "me", "sandboxed": False, "read": True, "isolation": "another user"}  # fmt: skip
    assert "the submission runs as another user" in said
    assert not [
        line for line in everything() if FIRST_USER <= line[0] < FIRST_USER + 4096 and str(weaker.home) in line[1]
    ]


def everything() -> list[tuple[int, str]]:
    out = subprocess.run(["ps", "-eo", "uid,args"], capture_output=True, text=True, check=True).stdout
    return [(int(line.split()[0]), line) for line in out.splitlines()[1:]]


WITHOUT = (
    "command = a.OtherUser.command\n"
    "a.OtherUser.command = lambda self: [word for word in command(self) if not word.startswith({!r})]"
)
PROVE = """
import sys
from pathlib import Path
from dsim.grading import another_user as a
{}
a.check_other_user([Path(sys.argv[1])])
"""


@needs_root
@pytest.mark.parametrize("mutation, words", [
    ("", "the course and the results cannot be read"),
    (WITHOUT.format("--nproc"), "a fork burst is stopped"),
    ("a.MEMORY = 2**34", "8 GB are refused"),
    ("a.end_all_of = lambda user: None", "nothing is left running"),
    (WITHOUT.format("--no-new-privs"), "the user has no rights"),
])  # fmt: skip
def test_a_weaker_isolation_that_does_not_hold_is_found(
    mutation: str, words: str, weaker: Container, tmp_path: Path
) -> None:
    """Mutation: something can be read, limits that do not bind, processes that stay, rights that could be got."""
    readable = weaker.home / "open"
    readable.write_text("anybody may read this")
    closed = readable if not mutation else weaker.root / "source" / "secret"
    code = PROVE.format(mutation)
    path = f"{ROOT}:{weaker.environment['PYTHONPATH']}"
    done = subprocess.run([weaker.home / "bin" / "python", "-B", "-c", code, closed], capture_output=True, text=True,
                          env={**weaker.environment, "PYTHONPATH": path}, timeout=120)  # fmt: skip
    assert done.returncode == 1 and f"not so: {words}" in done.stderr, done.stderr
    for user in {user for user, line in everything() if user >= FIRST_USER and str(weaker.home) in line}:
        end_all_of(user)
        assert not processes_of(user)


def test_only_our_own_users_can_be_ended() -> None:
    for user in (0, 1000, os.getuid()):
        with pytest.raises(ValueError, match="one of ours"):
            end_all_of(user)


# With what setup.sh installs

SYSTEM = "/usr/bin:/bin:/usr/sbin:/sbin"
SUITABLE = "import ensurepip, sys, venv; sys.exit(sys.version_info < (3, 11))"


def system_python() -> bool:
    try:
        return subprocess.run(["/usr/bin/python3", "-c", SUITABLE], capture_output=True).returncode == 0
    except OSError:
        return False


@pytest.mark.slow
@needs_root
@needs_bubblewrap
@pytest.mark.skipif(not system_python(), reason="/usr/bin/python3 is older than 3.11, or cannot make environments")
def test_from_setup_to_results(tmp_path: Path) -> None:
    """setup.sh with the system's Python and pip, then both ways to run."""
    made(tmp_path, "--other-user-there")
    home = Path(tempfile.mkdtemp(prefix="dsim-home-"))
    try:
        home.chmod(0o755)
        for sandbox, expected in ((True, "sandbox"), (False, "another user")):
            container = Container(tmp_path / "autograder", home, sandbox=False)
            path = SYSTEM if sandbox else f"{tmp_path / 'bin'}:{SYSTEM}"
            container.environment |= {"PYTHONPATH": "", "PATH": path}
            if sandbox:
                setup = ["bash", str(container.root / "source" / "setup.sh")]
                done = subprocess.run(setup, env=container.environment, capture_output=True, text=True)
                assert done.returncode == 0, done.stdout + done.stderr
            status, said, found = container.run(me=SOLUTION)
            assert status == 0 and found["score"] == 7 and found["extra_data"]["isolation"] == expected, said
    finally:
        shutil.rmtree(home)
