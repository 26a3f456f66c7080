"""What a picture beside the feedback shows, as plain numbers; drawn outside the sandbox, where points were lost."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from dsim.arrays.checks import Array


@dataclass(frozen=True)
class Entries:
    """An array of theirs beside the one expected.  tolerance: absolute, of one entry."""

    name: str
    expected: Array
    found: Array
    tolerance: float

    def worth(self, public: bool) -> bool:
        """Whether it tells more than the words: where every entry of a hidden item is off, it does not."""
        return public or bool((np.abs(self.found - self.expected) <= self.tolerance).any())

    def png(self, public: bool) -> bytes:
        """Values and errors; of a hidden item the errors alone, for values would tell its inputs."""
        from dsim.pictures import feedback

        return feedback.entries(self.name, self.expected, self.found, self.tolerance, values=public)


@dataclass(frozen=True)
class Lines:
    """Curves that tell no input: errors against steps, an energy against time.  lines: (label, x, y)."""

    title: str
    x: str
    y: str
    lines: tuple[tuple[str, Any, Any], ...]
    log: Literal["", "y", "xy"] = ""

    def worth(self, public: bool) -> bool:
        """Always."""
        return True

    def png(self, public: bool) -> bytes:
        """The picture, the same for public and hidden items."""
        from dsim.pictures import feedback

        return feedback.lines(self.title, (self.x, self.y), self.lines, self.log)


Picture = Entries | Lines
