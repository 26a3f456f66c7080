"""Where assignments lie: folders `NN_topic`, each with a handout, a kit, a solution, a rubric and tests."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

NEEDED = ("handout.md", "kit.py", "solution.py", "rubric.toml", "tests/test_public.py", "tests/test_hidden.py")


@dataclass(frozen=True)
class Assignment:
    """number: "01".  topic: words of the folder's name."""

    number: str
    topic: str
    path: Path


def root(given: Path | None = None) -> Path:
    """The directory of the assignments: the one given, ./assignments, or the one beside the package in a checkout."""
    places = [given] if given is not None else [Path("assignments"), Path(__file__).parents[2] / "assignments"]
    for place in places:
        if place.is_dir() and any(re.match(r"\d\d_", path.name) for path in place.iterdir()):
            return place.resolve()
    told = "--assignments" if given is not None else "the working directory"
    raise ValueError(f"{told} must hold assignments, folders such as 01_time_stepping; looked at {places[0]}")


def assignments(directory: Path) -> list[Assignment]:
    """All of them, by number."""
    found = []
    for path in sorted(directory.iterdir()):
        if path.is_dir() and (match := re.fullmatch(r"(\d\d)_(\w+)", path.name)):
            found.append(Assignment(match[1], match[2].replace("_", " "), path))
    return found


def find(number: str, directory: Path) -> Assignment:
    """The assignment of this number.  Raises ValueError for one nobody knows, or that lacks a file."""
    known = {assignment.number: assignment for assignment in assignments(directory)}
    if number.zfill(2) not in known:
        raise ValueError(f"NN must be one of {', '.join(known)}; got {number!r}")
    found = known[number.zfill(2)]
    if missing := [name for name in NEEDED if not (found.path / name).is_file()]:
        raise ValueError(f"{found.path.name} must hold {', '.join(missing)}")
    return found
