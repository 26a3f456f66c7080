"""Where the lectures lie: MyST notebooks `NN_name.md`, each beside the notebook that was made of it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

NAME = re.compile(r"(\d\d)_(\w+)\.md")


@dataclass(frozen=True)
class Lecture:
    """number "01", title "Particles and forces", path of the source."""

    number: str
    title: str
    path: Path

    @property
    def notebook(self) -> Path:
        return self.path.with_suffix(".ipynb")


def root(given: Path | None = None) -> Path:
    """The directory of the lectures: the one given, ./lectures, beside the package in a checkout, or in the wheel.

    Raises ValueError where there is none.
    """
    package = Path(__file__).parents[1]
    places = [Path("lectures").absolute(), package.parent / "lectures", package / "course" / "lectures"]
    looked = [given] if given is not None else places
    for place in looked:
        if place.is_dir() and lectures(place):
            return place.resolve()
    if given is not None:
        raise ValueError(f"--lectures must hold lectures, files such as 01_time_stepping.md; {given} holds none")
    raise ValueError("there are no lectures, files such as 01_time_stepping.md, in any of "
                     f"{', '.join(map(str, looked))}; say where they lie with --lectures DIR")  # fmt: skip


def lectures(directory: Path) -> list[Lecture]:
    """All of them, by number."""
    found = []
    for path in sorted(directory.iterdir()):
        if match := NAME.fullmatch(path.name):
            heading = re.search(r"^# (?:\d\d )?(.+)$", path.read_text(encoding="utf-8", errors="replace"), flags=re.M)
            found.append(Lecture(match[1], heading[1].strip() if heading else match[2], path))
    return found


def select(directory: Path, numbers: Sequence[str]) -> list[Lecture]:
    """Those with the given numbers, or all.  Raises ValueError for a number that there is not."""
    known = {lecture.number: lecture for lecture in lectures(directory)}
    for number in numbers:
        if number.zfill(2) not in known:
            raise ValueError(f"NN must be one of {', '.join(known)}; got {number!r}")
    return [known[number.zfill(2)] for number in numbers] if numbers else list(known.values())
