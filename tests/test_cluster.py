"""Grading on a dask.distributed cluster: real schedulers and workers, each a process of its own."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest

from dsim.cli import main
from dsim.grading import cluster, parcel
from dsim.grading import grade as grading
from dsim.grading.sandbox import SandboxError

pytest.importorskip("distributed")

ASSIGNMENT = Path(__file__).parent / "grading_fixture"
SOLUTION = (ASSIGNMENT / "solution.py").read_text()
SLOW = "import time\ntime.sleep(0.1)\n" + SOLUTION
needs_bubblewrap = pytest.mark.skipif(shutil.which("bwrap") is None, reason="bubblewrap is not installed")
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")

BLOCKED = "import sys; sys.modules['dsim'] = None\n"
OTHER = "import dsim.grading.parcel as parcel; parcel.fingerprint = lambda: '0.0.9 (another)'\n"


@contextmanager
def program(tmp_path: Path, name: str, *arguments: str, first: str = "", **variables: str) -> Iterator[int]:
    """`dask scheduler` or `dask worker` as a process; its id."""
    code = f"{first}\nimport sys\nfrom distributed.cli.dask_{name} import main\nsys.exit(main())"
    root = str(Path(__file__).parent.parent)
    environment = {**os.environ, "PYTHONPATH": root, "PYTHONWARNINGS": "ignore",
                   "TMPDIR": str(tmp_path), **variables}  # fmt: skip
    with (tmp_path / f"{name}.log").open("ab") as log:
        process = subprocess.Popen([sys.executable, "-c", code, *arguments], env=environment, cwd=tmp_path, stdout=log,
                                   stderr=log)  # fmt: skip
    try:
        yield process.pid
    finally:
        process.terminate()
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


@contextmanager
def scheduler(tmp_path: Path, **variables: str) -> Iterator[str]:
    told = tmp_path / "scheduler.json"
    with program(tmp_path, "scheduler", "--host", "127.0.0.1", "--port", "0", "--dashboard-address",
                 "127.0.0.1:0", "--no-show", "--scheduler-file", str(told), first=BLOCKED, **variables):  # fmt: skip
        yield json.loads(awaited(told.read_text))["address"]


def awaited(look: object, seconds: float = 30.0) -> str:
    """The first text that look() gives."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            if found := look():  # type: ignore[operator]
                json.loads(found)
                return str(found)
        except (OSError, ValueError):
            pass
        time.sleep(0.05)
    raise AssertionError("nothing came in time")


@contextmanager
def worker(tmp_path: Path, address: str, **more: str) -> Iterator[int]:
    with program(tmp_path, "worker", address, "--no-nanny", "--nthreads", "1", "--no-dashboard", **more) as pid:
        yield pid


@contextmanager
def joined(address: str, workers: int) -> Iterator[cluster.Cluster]:
    with cluster.connected(address) as found:
        found._client.wait_for_workers(workers, timeout=30)
        yield found


def classroom(tmp_path: Path, count: int) -> list[Path]:
    directory = tmp_path / "submissions"
    directory.mkdir()
    for number in range(count):
        wrong = "\ndef double(x): return x\n" if number % 2 else ""
        (directory / f"s{number:02d}.py").write_text(SLOW + wrong)
    (directory / "broken.py").write_text("def double(")
    (directory / "link.py").symlink_to("/etc/passwd")
    return grading.submissions_in(directory)


def files(to: Path) -> dict[str, bytes]:
    """Every file of a run that does not tell seconds."""
    return {str(path.relative_to(to)): path.read_bytes() for path in sorted(to.rglob("*")) if path.is_file()}


@pytest.mark.slow
@needs_bubblewrap
def test_a_worker_that_is_killed_loses_nothing(tmp_path: Path) -> None:
    """The same files as from a run on this machine, each submission told once; the secret is the client's."""
    submissions, to = classroom(tmp_path, 4), tmp_path / "out"
    seen: list[str] = []
    with scheduler(tmp_path) as address, worker(tmp_path, address), worker(tmp_path, address) as victim:
        with joined(address, 2) as found:

            def say(done: int, total: int, name: str) -> None:
                seen.append(name)
                if len(seen) == 3:
                    os.kill(victim, signal.SIGKILL)

            rows = grading.grade(ASSIGNMENT, submissions, to, jobs=found, say=say)
            assert len(found._client.nthreads()) == 1
            again = grading.grade(ASSIGNMENT, submissions, to, jobs=found, say=say)  # nothing is left to do
    assert sorted(seen) == sorted(path.stem for path in submissions) and again == rows
    assert [row["score"] for row in rows] == [0, 0, 7, 5, 7, 5]
    (tmp_path / "here").mkdir()
    shutil.copy(to / grading.SECRET, tmp_path / "here")
    grading.grade(ASSIGNMENT, submissions, tmp_path / "here")
    assert files(to) == files(tmp_path / "here")


def test_a_run_that_was_killed_goes_on_here(tmp_path: Path) -> None:
    submissions, to = classroom(tmp_path, 4), tmp_path / "out"

    def killed(done: int, total: int, name: str) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with scheduler(tmp_path) as address, worker(tmp_path, address), joined(address, 1) as found:
        with pytest.raises(KeyboardInterrupt):
            grading.grade(ASSIGNMENT, submissions, to, jobs=found, sandboxed=False, say=killed)
    assert len(list(to.glob("*/results.json"))) == 3
    seen: list[str] = []
    rows = grading.grade(ASSIGNMENT, submissions, to, sandboxed=False, say=lambda d, t, name: seen.append(name))
    assert len(seen) == 3 and len(rows) == 6


def test_a_submission_that_takes_its_workers_along(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is named and has no result; the others have theirs.  (It takes a submission without a sandbox to do so.)"""
    submissions, to = classroom(tmp_path, 2), tmp_path / "out"
    submissions[-2].write_text("import os\nif 'DYING' in os.environ: os.kill(os.getpid(), 9)\n" + SOLUTION)
    monkeypatch.setattr(cluster, "AHEAD", 1)
    never = {"DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0"}
    start = partial(worker, tmp_path, DYING="1")
    with scheduler(tmp_path, **never) as address, start(address=address), start(address=address):
        with (
            joined(address, 2) as found,
            pytest.raises(cluster.ClusterError, match=r"lost with each of s00\.py, which"),
        ):
            grading.grade(ASSIGNMENT, submissions, to, jobs=found, sandboxed=False)
    assert sorted(path.parent.name for path in to.glob("*/results.json")) == ["broken", "link", "s01"]
    rows = grading.grade(ASSIGNMENT, submissions, to, sandboxed=False)
    assert [row["score"] for row in rows] == [0, 0, 7, 5]


@needs_bubblewrap
def test_workers_that_may_not_grade(tmp_path: Path) -> None:
    """No dsim, another dsim, no sandbox: found before the first submission, or by a worker that comes later."""
    submissions, to = classroom(tmp_path, 1), tmp_path / "out"
    with scheduler(tmp_path) as address:
        with cluster.connected(address) as nobody, pytest.raises(cluster.ClusterError, match="has no workers; start"):
            grading.grade(ASSIGNMENT, submissions, to, jobs=nobody)
        for more, error, words in (
            ({"first": BLOCKED}, cluster.ClusterError, r"dsim cannot be imported on .*pip install"),
            ({"first": OTHER}, cluster.ClusterError, r"must be the same on every worker; it is 0\.0\.9 \(another\) on"),
            ({"PATH": str(tmp_path)}, SandboxError, r"on \w.*: grading needs bwrap"),
        ):  # fmt: skip
            with worker(tmp_path, address, **more), joined(address, 1) as found:
                with pytest.raises(error, match=words):
                    grading.grade(ASSIGNMENT, submissions, to, jobs=found)
                with pytest.raises(error, match=words):
                    task = grading.Task(ASSIGNMENT, submissions[-1], to / "late", b"secret")
                    list(found.graded(iter([task]), True))
    assert not list(to.glob("*/results.json"))


def test_an_address_that_nobody_answers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cluster, "CONNECT", 0.5)
    shutil.copytree(ASSIGNMENT, tmp_path / "assignments" / "01_tiny")
    (tmp_path / "assignments" / "01_tiny" / "handout.md").write_text("# Tiny\n")
    classroom(tmp_path, 1)
    arguments = ["dsim", "grade", "01", str(tmp_path / "submissions"), "--to", str(tmp_path / "out"),
                 "--assignments", str(tmp_path / "assignments")]  # fmt: skip
    for more, words in ((["--scheduler", "tcp://127.0.0.1:9"], "tcp://127.0.0.1:9 does not answer"),
                        (["--scheduler", "nonsense://x"], "must be the address of a running scheduler"),
                        (["--scheduler", "tcp://127.0.0.1:9", "--jobs", "2"], "not both")):  # fmt: skip
        monkeypatch.setattr("sys.argv", [*arguments, *more])
        with pytest.raises(SystemExit) as stop:
            main()
        assert stop.value.code == 2 and words in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "distributed", None)
    monkeypatch.setattr("sys.argv", [*arguments, "--scheduler", "tcp://127.0.0.1:9"])
    with pytest.raises(SystemExit):
        main()
    assert 'pip install "dsim[cluster]"' in capsys.readouterr().err
    assert not (tmp_path / "out" / "grades.csv").exists()


def test_what_travels_is_what_grading_needs(tmp_path: Path) -> None:
    names = {path.as_posix() for path in parcel.needed(ASSIGNMENT)}
    assert names == {"kit.py", "rubric.toml", "tests/test_hidden.py", "tests/test_public.py"}
    assert parcel.packed(ASSIGNMENT) == parcel.packed(ASSIGNMENT)
    found = parcel.unpacked(parcel.packed(ASSIGNMENT), tmp_path)
    assert found == tmp_path / ASSIGNMENT.name
    assert (found / "tests" / "test_hidden.py").read_bytes() == (ASSIGNMENT / "tests/test_hidden.py").read_bytes()


def test_a_worker_cannot_write_elsewhere(tmp_path: Path) -> None:
    for name in ("../grades.csv", "/etc/grades.csv", "a/../../b"):
        with pytest.raises(cluster.ClusterError, match="does not belong"):
            cluster.written({name: b""}, tmp_path / "ann")
    assert not list(tmp_path.iterdir())


def test_the_fingerprint_changes_with_the_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = parcel.fingerprint()
    shutil.copytree(parcel.PACKAGE, tmp_path / "dsim", ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(parcel, "PACKAGE", tmp_path / "dsim")
    try:
        for change, same in (("", True), ("# another line\n", False)):
            with (tmp_path / "dsim" / "grading" / "compare.py").open("a") as file:
                file.write(change)
            parcel.fingerprint.cache_clear()
            assert (parcel.fingerprint() == before) is same
    finally:
        parcel.fingerprint.cache_clear()
