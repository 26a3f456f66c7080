"""What a report is made of.  Plain data: a section knows nothing of HTML or terminals."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from dsim.studies.check import Check

Cell = str | float | int | bool | None
Progress = Callable[[str], None]  # a section says what it is doing: progress("springs, 3 of 10")


@dataclass(frozen=True)
class Table:
    """Rows under named columns.  Numbers are shown with three significant digits; pass text to show more."""

    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    caption: str = ""
    command: str = ""  # reproduces these numbers; "" = the section's command

    def __post_init__(self) -> None:
        for index, row in enumerate(self.rows):
            if len(row) != len(self.columns):
                expected = len(self.columns)
                raise ValueError(f"every row must have {expected} cells, as columns has; got {len(row)} in row {index}")


@dataclass(frozen=True)
class Picture:
    """An encoded picture (PNG, SVG or GIF) with the words that stand in for it."""

    data: bytes = field(repr=False)
    alt: str  # what a reader who cannot see the picture should know
    caption: str
    command: str = ""  # reproduces this picture; "" = the section's command

    def __post_init__(self) -> None:
        if not self.alt.strip():
            raise ValueError("alt must describe the picture; got an empty text")
        _media_type(self.data)

    @property
    def uri(self) -> str:
        """The picture inside the page: a data URI."""
        return f"data:{_media_type(self.data)};base64,{b64encode(self.data).decode('ascii')}"


@dataclass(frozen=True)
class Section:
    """One chapter of the report.  The job supplies key, title, seconds and, if absent, the command."""

    lead: str  # what this shows and why it matters; blank lines part paragraphs, `backticks` mark code
    checks: tuple[Check, ...] = ()
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()
    command: str = ""
    details: str = ""  # long text behind a fold: a traceback
    key: str = ""
    title: str = ""
    seconds: float = 0.0

    @property
    def failed(self) -> tuple[Check, ...]:
        return tuple(check for check in self.checks if not check.passed)

    @property
    def passed(self) -> tuple[Check, ...]:
        return tuple(check for check in self.checks if check.passed)


@dataclass(frozen=True)
class SectionJob:
    """A section still to be built.  `build` is a module-level function, or a partial of one: it pickles.

    alone: it measures seconds, so nothing else may run beside it.  cost: how long it takes beside others, about; the
    costliest are begun first, so that none is left running at the end.
    """

    key: str
    title: str
    build: Callable[[Progress], Section]
    alone: bool = False
    cost: float = 1.0

    @property
    def command(self) -> str:
        return f"dsim verify --only {self.key}"


@dataclass(frozen=True)
class Page:
    """The whole report."""

    title: str
    sections: tuple[Section, ...]
    environment: Mapping[str, str]  # {"Python": "3.11.2", ...}
    seconds: float
    limit: float | None = None  # seconds promised to the reader
    command: str = "dsim verify"

    @property
    def passed(self) -> int:
        return sum(len(section.passed) for section in self.sections)

    @property
    def failed(self) -> int:
        return sum(len(section.failed) for section in self.sections)

    @property
    def status(self) -> int:
        """Exit code: 0 all green, 1 something is red, 2 nothing was checked, hence no verdict."""
        if self.failed:
            return 1
        return 0 if self.passed else 2


def figures(value: Cell) -> str:
    """A cell as text: three significant digits for a float, words for a truth value.

    >>> figures(1.23456e-9), figures(True), figures(1200), figures(None)
    ('1.23e-09', 'yes', '1200', '')
    """
    if value is None:
        return ""
    if isinstance(value, str):
        return value
    if _is_truth(value):
        return "yes" if value else "no"
    return f"{value:.3g}" if _has_fraction(value) else f"{int(value)}"


def is_number(value: Cell) -> bool:
    """Numbers are set flush right."""
    return value is not None and not isinstance(value, str) and not _is_truth(value)


def _is_truth(value: object) -> bool:
    return type(value).__name__ in ("bool", "bool_")  # numpy's truth values are no subclass of bool


def _has_fraction(value: float | int) -> bool:
    return not hasattr(value, "bit_count")  # whole numbers, Python's and numpy's, count their bits; floats cannot


def _media_type(data: bytes) -> str:
    if data.startswith(b"\x89PNG\r\n"):
        return "image/png"
    if data.startswith(b"GIF8"):
        return "image/gif"
    if b"<svg" in data[:1000]:
        return "image/svg+xml"
    raise ValueError(f"data must be a PNG, GIF or SVG picture; got {len(data)} bytes that begin with {data[:8]!r}")
