"""`dsim verify`: build every section, print it, write the page.  A broken section is a red check."""

from __future__ import annotations

import platform
import time
import traceback
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from math import nan
from pathlib import Path

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
) -> int:
    """Build the sections in order, write `directory/index.html`, return the exit status.

    0: every check passed.  1: a check is red, or a section raised.  2: nothing was checked.
    An interruption leaves the page of the previous run as it was.
    """
    check_jobs(jobs)
    directory = html.check_directory(directory)
    out, err = terminal.console(), None if quiet else terminal.console(stderr=True)
    start = time.perf_counter()
    sections = []
    for index, job in enumerate(jobs, start=1):
        with terminal.announce(job, f"{index}/{len(jobs)}", err) as progress:
            sections.append(build(job, progress))
        if not quiet:
            terminal.print_section(sections[-1], out)
    seconds = time.perf_counter() - start
    page = Page("dsim verify", tuple(sections), environment(), seconds, limit, command)
    path = html.write(page, directory)
    out.print(terminal.summary(page, str(path)), soft_wrap=True, markup=False)
    return page.status


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
