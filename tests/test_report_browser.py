"""The report in a real browser: no error, no request, no blank picture, no sideways scroll."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import headless
import numpy as np
import pytest
from PIL import Image

from dsim.report import html, sections, verify
from dsim.report.model import Page, Section, SectionJob, Table
from dsim.studies.check import Check

BROWSER = headless.find_browser()

pytestmark = pytest.mark.skipif(BROWSER is None, reason=f"no browser: none of {', '.join(headless.NAMES)} on the path")


def no_progress(text: str) -> None:
    pass


def wide(progress: verify.Progress) -> Section:
    """What strains a small screen: many columns, long words, a red check and a long command."""
    names = tuple(f"a rather long column {i}" for i in range(12))
    return Section(
        "Long words: `" + "x" * 120 + "`",
        checks=(Check("subject", "statement " * 20, False, 1.0, "<= 1e-7"),),
        tables=(Table(names, (tuple(range(12)),), "Twelve columns"),),
        command="dsim verify " + "--only something-long " * 8,
    )


def crash(progress: verify.Progress) -> Section:
    raise RuntimeError("a long message " * 20)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The real sections, one that strains the layout, one that raises."""
    jobs = [job for job in sections.jobs() if job.key in ("derivatives", "newton", "verdicts", "environment")]
    jobs += [SectionJob("wide", "A wide section", wide), SectionJob("crash", "A broken section", crash)]
    built = tuple(verify.build(job, no_progress) for job in jobs)
    return html.write(Page("dsim verify", built, verify.environment(), 3.2, 90.0), tmp_path_factory.mktemp("report"))


@pytest.fixture(scope="module")
def browser() -> Iterator[headless.Pipe]:
    assert BROWSER is not None
    with headless.connection(BROWSER) as pipe:
        yield pipe


def brightness(screenshot: bytes) -> float:
    """The median grey level: that of the page's background."""
    with Image.open(io.BytesIO(screenshot)) as image:
        return float(np.median(np.asarray(image.convert("L"))))


@pytest.mark.parametrize("width", [1200, 380])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_page_is_sound(browser: headless.Pipe, page: Path, width: int, scheme: str) -> None:
    seen = headless.visit(browser, page, width=width, scheme=scheme, screenshot=True)
    assert seen.faults(width) == []
    assert seen.pictures >= 1
    assert brightness(seen.screenshot) > 200 if scheme == "light" else brightness(seen.screenshot) < 60


def blank_picture() -> bytes:
    buffer = io.BytesIO()
    Image.new("RGB", (60, 40), "white").save(buffer, "PNG")
    return buffer.getvalue()


def replace_picture(data: bytes, text: str) -> str:
    uri = f"data:image/png;base64,{base64.b64encode(data).decode()}"
    return re.sub(r'src="data:[^"]*"', f'src="{uri}"', text, count=1)


def insert(fragment: str, text: str, guarded: bool) -> str:
    """Put `fragment` into the page, with or without the page's own content policy."""
    if not guarded:
        text = re.sub(r"<meta http-equiv[^>]*>", "", text)
    return text.replace("</main>", fragment + "</main>")


OUTSIDE = '<img alt="x" src="http://127.0.0.1:9/picture.png">'
FAULTS = {
    "console error": (
        "console: oops",
        partial(insert, "<script>console.error('oops')</script>", guarded=False),
    ),
    "exception": (
        "console: ReferenceError",
        partial(insert, "<script>undefinedName()</script>", guarded=False),
    ),
    "outside request": ("outside request: http", partial(insert, OUTSIDE, guarded=False)),
    "outside request refused by the policy": (
        "console: Loading the image",
        partial(insert, OUTSIDE, guarded=True),
    ),
    "blank picture": ("blank picture", partial(replace_picture, blank_picture())),
    "broken picture": ("blank picture", partial(replace_picture, b"not a picture")),
    "too wide": ("px wide", partial(insert, "<div style='width:900px'>x</div>", guarded=True)),
    "pale": ("contrast", partial(insert, "<p style='color:#aaa'>pale</p>", guarded=True)),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_seen(browser: headless.Pipe, page: Path, tmp_path: Path, fault: str) -> None:
    expected, mutate = FAULTS[fault]
    mutant = tmp_path / "index.html"
    mutant.write_text(mutate(text=page.read_text(encoding="utf-8")), encoding="utf-8")
    faults = headless.visit(browser, mutant, width=380).faults(380)
    assert any(text.startswith(expected) or expected in text for text in faults), faults
