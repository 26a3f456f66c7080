"""Page -> one static HTML file.  Pictures are inside it and it asks for nothing: it opens offline."""

from __future__ import annotations

import re
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from dsim.pictures.files import write_atomically
from dsim.report.model import Page, Table, figures, is_number


def render(page: Page) -> str:
    """The page as HTML text."""
    environment = Environment(
        loader=PackageLoader("dsim.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,  # a misspelt name in the template is an error, not an empty place
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(figures=figures, prose=prose, numeric=numeric_columns)
    return environment.get_template("page.html.j2").render(page=page)


def write(page: Page, directory: str | Path) -> Path:
    """Write `directory/index.html` and return its path.  Until the new page is complete the old one stays."""
    return write_atomically(Path(directory) / "index.html", render(page).encode())


def check_directory(directory: str | Path) -> Path:
    """Refuse a place that cannot hold a report before any work is done.  Raises ValueError."""
    directory = Path(directory)
    for place in (directory, *directory.parents):
        if place.exists():
            if not place.is_dir():
                raise ValueError(f"the report needs a directory; {place} is a file")
            break
    return directory


def prose(text: str) -> Markup:
    """Paragraphs parted by blank lines, `code` in backticks; everything else is escaped."""
    paragraphs = (part.strip() for part in re.split(r"\n\s*\n", text))
    return Markup("\n").join(Markup("<p>{}</p>").format(_with_code(part)) for part in paragraphs if part)


def numeric_columns(table: Table) -> list[bool]:
    """For each column whether all its cells are numbers (or empty), hence set flush right."""
    columns = zip(*table.rows, strict=True) if table.rows else ((),) * len(table.columns)
    return [any(map(is_number, column)) and all(is_number(c) or c is None for c in column) for column in columns]


def _with_code(text: str) -> Markup:
    pieces = re.split(r"`([^`]+)`", text)  # odd places were between backticks
    marked = (Markup("<code>{}</code>").format(p) if i % 2 else escape(p) for i, p in enumerate(pieces))
    return Markup("").join(marked)
