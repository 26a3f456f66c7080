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
    """The directory of the assignments: the one given, or the first of `places` that holds any."""
    looked = [given] if given is not None else places()
    for place in looked:
        if place.is_dir() and assignments(place):
            return place.resolve()
    if given is not None:
        raise ValueError(f"--assignments must hold assignments, folders such as 01_time_stepping; {given} holds none")
    raise ValueError("there are no assignments, folders such as 01_time_stepping, in any of "
                     f"{', '.join(map(str, looked))}; say where they lie with --assignments DIR")  # fmt: skip


def places() -> list[Path]:
    """Where assignments are looked for: ./assignments, those of a checkout, those that the installed wheel carries."""
    package = Path(__file__).parents[1]
    return [Path("assignments").absolute(), package.parent / "assignments", package / "course" / "assignments"]


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
