"""`dsim verify`: build every section, print it, write the page.  A broken section is a red check."""

from __future__ import annotations

import os
import platform
import signal
import time
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from itertools import chain
from math import nan
from multiprocessing import active_children, get_context
from pathlib import Path

from rich.console import Console

from dsim.report import html, terminal
from dsim.report.model import Page, Progress, Section, SectionJob
from dsim.studies.check import Check

LIMIT = 90.0  # seconds that a plain `dsim verify` promises to stay below
PACKAGES = ("dsim", "numpy", "scipy", "matplotlib")


def run(
    jobs: Sequence[SectionJob],
    directory: str | Path,
    *,
    quiet: bool = False,
    limit: float | None = None,
    command: str = "dsim verify",
    workers: int = 1,
) -> int:
    """Build the sections, write `directory/index.html`, return the exit status.

    workers: processes that share the sections which measure no seconds; those that do follow, alone.
    0: every check passed.  1: a check is red, or a section raised.  2: nothing was checked.
    An interruption leaves the page of the previous run as it was.
    """
    check_jobs(jobs)
    directory = html.check_directory(directory)
    out, err = terminal.console(), None if quiet else terminal.console(stderr=True)
    start = time.perf_counter()
    built: dict[str, Section] = {}
    shared = [job for job in jobs if not job.alone] if workers > 1 else []
    for section in chain(_shared(shared, workers, err), _in_turn([job for job in jobs if job not in shared], err)):
        built[section.key] = section
        if not quiet:
            terminal.print_section(section, out)
    seconds = time.perf_counter() - start
    sections = tuple(built[job.key] for job in jobs)
    page = Page("dsim verify", sections, environment(), seconds, limit, command)
    path = html.write(page, directory)
    out.print(terminal.summary(page, str(path)), soft_wrap=True, markup=False)
    return page.status


def _in_turn(jobs: Sequence[SectionJob], err: Console | None) -> Iterator[Section]:
    """One after the other, in this process."""
    for index, job in enumerate(jobs, start=1):
        with terminal.announce(job, f"{index}/{len(jobs)}", err) as progress:
            yield build(job, progress)


def _shared(jobs: Sequence[SectionJob], workers: int, err: Console | None) -> Iterator[Section]:
    """By several processes of one thread each, in order.  An interruption, or a process that dies, ends them all."""
    if not jobs:
        return
    others = set(active_children())
    with _environment(OPENBLAS_NUM_THREADS="1", OMP_NUM_THREADS="1", MKL_NUM_THREADS="1"):
        pool = ProcessPoolExecutor(min(workers, len(jobs)), get_context("spawn"), _deaf)
        costliest = sorted(jobs, key=lambda job: -job.cost)
        futures = {job.key: pool.submit(build, job, _silent) for job in costliest}
        try:
            for index, job in enumerate(jobs, start=1):
                with terminal.announce(job, f"{index}/{len(jobs)}, {workers} at a time", err):
                    section = _result(job, futures[job.key])
                yield section
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in set(active_children()) - others:
                process.terminate()
                process.join()


def _result(job: SectionJob, future: Future[Section]) -> Section:
    try:
        return future.result()
    except BrokenProcessPool as error:
        return replace(broken(error), key=job.key, title=job.title, command=job.command)


def _deaf() -> None:
    """Ctrl-C is the parent's to handle."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _silent(text: str) -> None:
    """Progress of a process that has no terminal."""


@contextmanager
def _environment(**values: str) -> Iterator[None]:
    """Environment variables for processes to come; those of the user stay as they are."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update({name: value for name, value in values.items() if before[name] is None})
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)


def build(job: SectionJob, progress: Progress) -> Section:
    """One section with its seconds.  An exception becomes a red check with the traceback folded below."""
    start = time.perf_counter()
    try:
        section = job.build(progress)
    except Exception as error:  # whatever it is, the other sections still have to be seen
        section = broken(error)
    return replace(
        section,
        key=job.key,
        title=job.title,
        command=section.command or job.command,
        seconds=time.perf_counter() - start,
    )


def broken(error: Exception) -> Section:
    """The section that stands in for one that raised."""
    lead = "This section stopped with an error, so nothing that it would have checked is known."
    message = f"stopped with {type(error).__name__}: {error}"
    check = Check("this section", message, passed=False, measured=nan, bound="no error")
    return Section(lead, checks=(check,), details="".join(traceback.format_exception(error)))


def select(jobs: Sequence[SectionJob], keys: Sequence[str]) -> tuple[SectionJob, ...]:
    """The jobs named by `keys`, in the report's order; all of them if no key is given."""
    known = [job.key for job in jobs]
    for key in keys:
        if key not in known:
            raise ValueError(f"--only must be one of {', '.join(known)}; got {key!r}")
    return tuple(job for job in jobs if job.key in keys or not keys)


def check_jobs(jobs: Sequence[SectionJob]) -> None:
    """Keys become links inside the page: each must be a word of its own."""
    seen: set[str] = set()
    for job in jobs:
        if not job.key.replace("-", "").isalnum():
            raise ValueError(f"key must be letters, digits and dashes; got {job.key!r}")
        if job.key in seen:
            raise ValueError(f"every section needs a key of its own; got {job.key!r} twice")
        seen.add(job.key)


def environment() -> dict[str, str]:
    """What the numbers were computed with."""
    return (
        {"Python": platform.python_version()}
        | {name: installed(name) for name in PACKAGES}
        | {"machine": f"{platform.system()} {platform.machine()}"}
    )


def installed(package: str) -> str:
    """The version of an installed package; a source tree on the path has none."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"
