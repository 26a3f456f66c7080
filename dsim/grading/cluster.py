"""Grading beyond one machine: submissions go to an existing dask.distributed cluster, results come back as bytes.

Workers need dsim and bubblewrap, and share no file system with anybody: a task carries the assignment's files, the
submission and the secret, its result holds the files that a local run would have written, and only the client writes
them.  So a worker that is killed takes nothing along: the scheduler hands its submissions to others.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path, PurePosixPath
from socket import gethostname
from threading import Lock
from typing import Any

from dsim.grading import parcel
from dsim.grading.grade import AHEAD, Task, grade_one
from dsim.grading.results import RESULTS
from dsim.grading.sandbox import SandboxError, check_sandbox
from dsim.grading.scratch import scratch, sweep
from dsim.grading.submission import SubmissionError, name_of, read
from dsim.pictures.files import write_atomically

CONNECT = 10.0  # s until a scheduler must have answered
LONELY = 60.0  # s without any worker, after which a run gives up
PAUSE = 2.0  # s between two looks at which workers there are
STARTING = "dask worker ADDRESS --nworkers -1 --nthreads 1"


class ClusterError(ValueError):
    """The cluster cannot be used as it is; the message says what to do."""


# On a worker

_one_at_a_time = Lock()  # checks share sys.path and the state of random numbers with their process


@lru_cache(maxsize=1)
def _proved() -> None:
    check_sandbox()


@lru_cache(maxsize=1)
def _tidied() -> None:
    sweep()


def ready(sandboxed: bool, expected: str) -> None:
    """This worker may grade: it has the same dsim, and a sandbox that holds.  Raises ClusterError or SandboxError."""
    if (found := parcel.fingerprint()) != expected:
        raise ClusterError(f"dsim must be the same on every worker; it is {found} on {gethostname()}, {expected} here")
    try:
        if sandboxed:
            _proved()
    except SandboxError as error:
        raise SandboxError(f"on {gethostname()}: {error}") from None


def grade_there(
    name: str, submission: bytes, assignment: bytes, secret: bytes, sandboxed: bool, expected: str
) -> dict[str, bytes]:
    """The files of one submission's results, by relative name.  expected: the fingerprint of the client's dsim."""
    with _one_at_a_time, scratch("parcel") as directory:
        ready(sandboxed, expected)
        _tidied()
        file, to = directory / "in" / name, directory / "out"
        file.parent.mkdir()
        file.write_bytes(submission)
        course = parcel.unpacked(assignment, directory)  # anew each time: nothing hidden stays on a worker
        grade_one(Task(course, file, to, secret, sandboxed))
        return {path.relative_to(to).as_posix(): path.read_bytes() for path in sorted(to.rglob("*")) if path.is_file()}


def _travelling(name: str) -> Callable[..., Any]:
    """A function that calls dsim.grading.cluster.NAME, and travels whole: it can say that dsim is missing.

    Anything of dsim in a task's bytes would end a worker that has none, and a scheduler needs none.
    """

    def call(*arguments: Any) -> Any:
        import importlib
        import socket

        try:
            module = importlib.import_module("dsim.grading.cluster")
        except Exception as error:
            return (f"dsim cannot be imported on {socket.gethostname()} ({type(error).__name__}: {error}); install the "
                    'same dsim there: pip install "dsim[cluster]"')  # fmt: skip
        return getattr(module, name)(*arguments)

    return call


# On the client


def written(files: dict[str, bytes], to: Path) -> None:
    """Write what came back; results.json comes last: where it is, the submission is done."""
    for name in sorted(files, key=lambda name: name == RESULTS):
        path = PurePosixPath(name)
        if path.is_absolute() or ".." in path.parts:
            raise ClusterError(f"a worker sent a file that does not belong to a result: {name!r:.80}")
        write_atomically(to / path, files[name])


class Cluster:
    """The workers of a scheduler at `address`, as `grade(..., jobs=cluster)` takes them; made by `connected`."""

    def __init__(self, address: str, client: Any) -> None:
        self.address, self._client = address, client
        self._grade = _travelling("grade_there")
        self._lost: list[str] = []  # submissions that several workers were lost with

    def prove(self, sandboxed: bool) -> None:
        """Every worker there is now must be ready; those that come later prove it before their first submission."""
        workers = sorted(self._client.nthreads())
        if not workers:
            told = STARTING.replace("ADDRESS", self.address)
            raise ClusterError(f"the cluster at {self.address} has no workers; start some: {told}")
        look = _travelling("ready")
        asked = {name: self._client.submit(look, sandboxed, parcel.fingerprint(), workers=[name], pure=False)
                 for name in workers}  # fmt: skip
        wrong = {name: trouble for name, future in asked.items() if (trouble := _trouble(future))}
        if wrong:
            name, trouble = min(wrong.items())
            raise _told(trouble, f"{name} ({len(wrong)} of {len(workers)} workers cannot grade)")

    def graded(self, tasks: Iterator[Task], sandboxed: bool) -> Iterator[str]:
        """Names of submissions as they are done; a few ahead of what the workers do, so memory does not grow."""
        waiting: dict[Any, Task] = {}
        lonely, more = time.monotonic(), True
        while more or waiting:
            workers = sum(self._client.nthreads().values())
            lonely = time.monotonic() if workers else lonely
            if time.monotonic() - lonely > LONELY:
                raise ClusterError(f"the cluster at {self.address} has lost all its workers; run the same command "
                                   "again to go on")  # fmt: skip
            while more and len(waiting) < AHEAD * max(workers, 1):
                task = next(tasks, None)
                if task is None:
                    more = False
                elif (data := _readable(task)) is None:
                    yield grade_one(task)  # says why it cannot be read; nothing of it runs
                else:
                    given = task.submission.name, data, _packed(task.assignment), task.secret, sandboxed
                    waiting[self._client.submit(self._grade, *given, parcel.fingerprint(), pure=False)] = task
            yield from self._finished(waiting)
        if self._lost:
            raise ClusterError(f"several workers were lost with each of {', '.join(self._lost)}, which therefore have "
                               "no grade; the others do. The same command tries again; without --scheduler the "
                               "grading of these, and of nothing else, is done here")  # fmt: skip

    def _finished(self, waiting: dict[Any, Task]) -> Iterator[str]:
        from distributed import wait

        if not waiting:
            return
        with suppress(TimeoutError):
            wait(list(waiting), timeout=PAUSE, return_when="FIRST_COMPLETED")
        for future in [future for future in waiting if future.done()]:
            task = waiting.pop(future)
            trouble = _trouble(future)
            if type(trouble).__name__ == "KilledWorker":
                self._lost.append(task.submission.name)
            elif trouble:
                raise _told(trouble, f"that had to grade {task.submission.name}")
            else:
                written(future.result(), task.to)
                yield name_of(task.submission)


@lru_cache(maxsize=4)
def _packed(assignment: Path) -> bytes:
    return parcel.packed(assignment)


def _readable(task: Task) -> bytes | None:
    """The bytes of a submission, or None where it is none."""
    try:
        return read(task.submission).path.read_bytes()
    except (SubmissionError, OSError):
        return None


def _trouble(future: Any) -> BaseException | str:
    """Why a task gave no result, or ""; waits for it."""
    if future.status in ("cancelled", "lost"):
        return "the scheduler has gone"
    error: BaseException | None = future.exception()
    if error is not None:
        return error
    result = future.result()
    return result if isinstance(result, str) else ""


def _told(trouble: BaseException | str, where: str) -> ClusterError | SandboxError:
    """What a user can do about what went wrong on a worker."""
    if isinstance(trouble, SandboxError):
        return SandboxError(f"worker {where}: {trouble}")
    if isinstance(trouble, ClusterError | str):
        return ClusterError(f"worker {where}: {trouble}")
    return ClusterError(f"worker {where}: {type(trouble).__name__}: {trouble}")


@contextmanager
def connected(address: str) -> Iterator[Cluster]:
    """The cluster at an address such as tcp://host:8786.

    TLS is dask's own configuration.  Raises ClusterError where `distributed` is missing or nobody answers.
    """
    try:
        from distributed import Client
    except ImportError:
        raise ClusterError('--scheduler needs dask.distributed: pip install "dsim[cluster]"') from None
    try:
        client = Client(address, timeout=CONNECT)
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        told = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ClusterError(f"--scheduler must be the address of a running scheduler, such as tcp://host:8786; "
                           f"{address} does not answer ({told:.160})") from None  # fmt: skip
    try:
        yield Cluster(address, client)
    finally:
        client.close()
