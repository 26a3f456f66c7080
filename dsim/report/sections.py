"""The explicit list of sections of `dsim verify`, in the order in which they are read."""

from __future__ import annotations

from dsim.report.environment import build_environment
from dsim.report.model import SectionJob


def jobs(full: bool = False) -> tuple[SectionJob, ...]:
    """Every section; `full` asks for the long studies too."""
    return (SectionJob("environment", "Machine and arithmetic", build_environment),)
