"""The report: data in, one page out; a broken section is red; an interruption leaves the old page."""

from __future__ import annotations

import io
import os
import pickle
import re
import sys
from functools import partial
from html.parser import HTMLParser
from multiprocessing import active_children
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

from dsim.cli import app
from dsim.pictures import files, style
from dsim.report import environment, html, sections, terminal, verify
from dsim.report.model import Page, Picture, Progress, Section, SectionJob, Table, figures
from dsim.studies.check import Check

GREEN = Check("springs", "dq against differences of force", True, 3.2e-9, "<= 1e-7")
RED = Check("drag <b>", "order", False, 0.97, "2 +- 0.1")
SVG = b'<svg xmlns="http://www.w3.org/2000/svg" width="9" height="9"><circle r="4"/></svg>'


def section(*checks: Check, **parts: object) -> Section:
    return Section("A lead with `code`.\n\nA second paragraph.", checks=checks, **parts)  # type: ignore[arg-type]


def of_checks(progress: Progress, checks: tuple[Check, ...]) -> Section:
    progress("working")
    return section(*checks)


def crash(progress: Progress) -> Section:
    raise ZeroDivisionError("stiffness was 0")


def interrupt(progress: Progress) -> Section:
    raise KeyboardInterrupt


def job(key: str, *checks: Check) -> SectionJob:
    return SectionJob(key, f"The {key} section", partial(of_checks, checks=checks))


def page_of(*parts: Section) -> Page:
    named = tuple(
        verify.build(SectionJob(f"s{i}", f"Section {i}", lambda p, x=x: x), print) for i, x in enumerate(parts)
    )
    return Page("dsim verify", named, {"Python": "3"}, 1.25, 90.0)


class Outline(HTMLParser):
    """Headings, links, ids, addresses and pictures of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.headings: list[int] = []
        self.ids: list[str] = []
        self.addresses: list[str] = []
        self.alts: list[str] = []
        self.language = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        if re.fullmatch("h[1-6]", tag):
            self.headings.append(int(tag[1]))
        self.ids += [given["id"]] if "id" in given else []
        self.addresses += [given[name] for name in ("src", "href", "action", "data") if name in given]
        self.alts += [given.get("alt", "")] if tag == "img" else []
        self.language = given.get("lang", self.language)


# the data


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (np.float64(1.5), "1.5"),
        (np.int64(12345), "12345"),
        (np.bool_(True), "yes"),
        (0.1234567, "0.123"),
        ("a", "a"),
    ],
)
def test_figures(value: object, text: str) -> None:
    assert figures(value) == text  # type: ignore[arg-type]


def test_bad_parts_are_refused() -> None:
    with pytest.raises(ValueError, match=r"every row must have 2 cells.*got 1 in row 1"):
        Table(("a", "b"), ((1, 2), (3,)))
    with pytest.raises(ValueError, match="alt must describe"):
        Picture(SVG, " ", "caption")
    with pytest.raises(ValueError, match="PNG, GIF or SVG"):
        Picture(b"hello", "alt", "caption")


def test_status() -> None:
    assert page_of(section(GREEN)).status == 0
    assert page_of(section(GREEN), section(RED)).status == 1
    assert page_of(section()).status == 2


# the page


def test_page_is_one_accessible_document() -> None:
    picture = Picture(SVG, "a disc", "A disc.", command="dsim draw disc")
    table = Table(("name", "error"), (("a", 1.0), ("b", None)), "Errors", command="dsim table")
    text = html.render(page_of(section(GREEN, RED, pictures=(picture,), tables=(table,)), section(GREEN)))
    seen = Outline(text)
    assert seen.language == "en" and seen.headings[0] == 1 and seen.headings.count(1) == 1
    assert all(below <= above + 1 for above, below in zip(seen.headings, seen.headings[1:], strict=False))
    assert seen.alts == ["a disc"]
    assert all(address.startswith(("#", "data:")) for address in seen.addresses)
    assert len(set(seen.ids)) == len(seen.ids) and {"s0", "s1", "content"} <= set(seen.ids)
    assert all(a[1:] in seen.ids for a in seen.addresses if a.startswith("#"))
    for command in ("dsim verify --only s0", "dsim draw disc", "dsim table"):
        assert f"<code>{command}</code>" in text
    assert 'name="viewport"' in text and "prefers-color-scheme: dark" in text and "<script" not in text


def test_verdict_is_in_words() -> None:
    assert "All 1 checks passed" in html.render(page_of(section(GREEN)))
    red = html.render(page_of(section(GREEN, RED)))
    assert "1 of 2 checks failed" in red and "FAIL" in red
    assert "Nothing was checked" in html.render(page_of(section()))


def test_text_is_escaped() -> None:
    text = html.render(page_of(section(RED), section(GREEN, details="<script>")))
    assert "drag &lt;b&gt;" in text and "<b>" not in text and "<script>" not in text
    assert html.prose("a `x < y` b\n\n<i>") == "<p>a <code>x &lt; y</code> b</p>\n<p>&lt;i&gt;</p>"


def test_seconds_over_the_limit_are_named() -> None:
    assert "limit 90 s, exceeded" in html.render(Page("t", (), {}, 91.0, 90.0))
    assert "limit" not in Outline(html.render(Page("t", (), {}, 91.0))).ids


# files


def test_an_interruption_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = files.write_atomically(tmp_path / "new" / "index.html", b"old")

    def half(self: Path, data: bytes) -> int:
        with self.open("wb") as file:
            file.write(data[: len(data) // 2])
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "write_bytes", half)
    with pytest.raises(KeyboardInterrupt):
        files.write_atomically(target, b"the new content")
    assert target.read_bytes() == b"old"
    assert [path.name for path in target.parent.iterdir()] == ["index.html"]


def test_an_interrupted_run_leaves_the_old_report(tmp_path: Path) -> None:
    assert verify.run([job("a", GREEN)], tmp_path, quiet=True) == 0
    before = (tmp_path / "index.html").read_bytes()
    with pytest.raises(KeyboardInterrupt):
        verify.run([job("a", RED), SectionJob("b", "b", interrupt)], tmp_path, quiet=True)
    assert (tmp_path / "index.html").read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 1


def test_a_file_in_the_way_is_named_before_any_work(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("x")
    with pytest.raises(ValueError, match=r"needs a directory; .*taken is a file"):
        verify.run([SectionJob("a", "a", interrupt)], tmp_path / "taken" / "report")


# running


def test_a_broken_section_hides_no_other(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    jobs = [job("a", GREEN), SectionJob("broken", "Broken", crash), job("c", GREEN)]
    assert verify.run(jobs, tmp_path, limit=90.0) == 1
    text = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert "stopped with ZeroDivisionError: stiffness was 0" in text
    assert "Traceback (most recent call last)" in text and "The c section" in text
    printed = capsys.readouterr()
    assert "The c section  (1 passed, 0 failed" in printed.out
    assert re.search(r"2 passed, 1 failed in [\d.]+ s of 90 s: \S", printed.out.strip().splitlines()[-1])
    assert "[2/3] Broken" in printed.err


def test_quiet_prints_the_closing_line_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert verify.run([job("a", GREEN)], tmp_path, quiet=True) == 0
    printed = capsys.readouterr()
    assert printed.err == "" and printed.out.startswith("1 passed, 0 failed") and printed.out.count("\n") == 1


def test_jobs_are_checked_and_selected(tmp_path: Path) -> None:
    jobs = (job("a"), job("b"), job("c"))
    assert [j.key for j in verify.select(jobs, ["c", "a"])] == ["a", "c"]
    assert verify.select(jobs, []) == jobs
    with pytest.raises(ValueError, match="--only must be one of a, b, c; got 'd'"):
        verify.select(jobs, ["d"])
    with pytest.raises(ValueError, match="key of its own; got 'a' twice"):
        verify.run([job("a"), job("a")], tmp_path)
    with pytest.raises(ValueError, match="letters, digits and dashes"):
        verify.run([job("a b")], tmp_path)


@pytest.mark.parametrize("full", [False, True])
def test_real_jobs_are_sound_and_pickle(full: bool) -> None:
    jobs = sections.jobs(full)
    verify.check_jobs(jobs)
    assert [j.key for j in pickle.loads(pickle.dumps(jobs))] == [j.key for j in jobs]


def test_environment_is_green_and_can_be_red(monkeypatch: pytest.MonkeyPatch) -> None:
    built = environment.build_environment(lambda text: None)
    assert built.failed == () and len(built.passed) >= 9 and built.pictures
    solve = np.linalg.solve
    monkeypatch.setattr(np.linalg, "solve", lambda a, b: solve(a, b) * (1 + 1e-12))
    assert [c.statement for c in environment.build_environment(lambda text: None).failed] == [
        "backward error of a dense solve, 80 unknowns"
    ]


# the terminal


def test_tables_fit_80_columns() -> None:
    long = Check("subject " * 6, "statement " * 12, False, 1.2345e-300, "<= 1e-7 and more words")
    paper = io.StringIO()
    terminal.print_section(section(GREEN, long, *[GREEN] * 40, title="t"), Console(width=80, file=paper))
    lines = paper.getvalue().splitlines()
    assert max(map(len, lines)) <= 80
    assert sum("FAIL" in line for line in lines) == 1 and any("and 29 more passed" in line for line in lines)
    assert any("1.23e-300" in line for line in lines)


# the command


def test_command(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["verify", "--only", "environment", "--to", str(tmp_path), "--quiet"])
    assert done.exit_code == 0, done.output
    assert re.search(r"^\d+ passed, 0 failed in [\d.]+ s of 90 s: .*index.html$", done.stdout.strip())
    assert "dsim verify --only environment" in (tmp_path / "index.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(("build", "code"), [(crash, 1), (interrupt, 2)])
def test_command_exit_codes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, build: object, code: int) -> None:
    monkeypatch.setattr(sections, "jobs", lambda full: (SectionJob("a", "a", build),))  # type: ignore[arg-type]
    done = CliRunner().invoke(app, ["verify", "--to", str(tmp_path)])
    assert done.exit_code == code
    assert ("interrupted" in done.stderr) == (code == 2)


def test_unknown_section_is_one_clear_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    from dsim import cli

    monkeypatch.setattr(sys, "argv", ["dsim", "verify", "--only", "nothing"])
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    assert stopped.value.code == 2
    assert re.fullmatch(r"dsim: --only must be one of .*; got 'nothing'\n", capsys.readouterr().err)


def test_help_shows_examples() -> None:
    shown = CliRunner().invoke(app, ["verify", "--help"]).output
    assert "Examples" in shown and "dsim verify --only environment" in shown


# pictures


@style.style()
def draw() -> style.Figure:
    figure, axes = style.canvas()
    for index in range(9):
        axes.plot([1, 2, 3], [index, index + 1, index], **style.look(index), label=str(index))
    style.label(axes, "time (s)", "height (m)")
    axes.legend()
    return figure


def test_pictures_are_the_same_bytes_and_are_saved_whole(tmp_path: Path) -> None:
    assert style.to_svg(draw()) == style.to_svg(draw())
    assert style.save(draw(), tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    assert b"<svg" in style.save(draw(), tmp_path / "deep" / "a.svg").read_bytes()
    assert sorted(path.name for path in tmp_path.rglob("*.*")) == ["a.png", "a.svg"]
    with pytest.raises(ValueError, match=r"path must end in .svg or .png; got 'a.bmp'"):
        style.save(draw(), "a.bmp")


def test_curves_differ_by_more_than_colour() -> None:
    looks = [style.look(i) for i in range(len(style.COLOURS))]
    assert len({(look["marker"], look["linestyle"]) for look in looks}) == len(looks)


def test_pictures_are_what_savefig_gives_and_the_figure_stays_as_it_was() -> None:
    """They are drawn once, where `savefig` draws twice."""
    with style.style():
        figure, axes = style.canvas()
        axes.loglog([1e-3, 1.0], [1e-9, 1e-2], label="backward Euler")
        axes.legend()
        style.label(axes, "h (s)", "error (m)")
        canvas, dpi = figure.canvas, figure.dpi
        for drawn, options in (
            (style.to_png(figure, dpi=90), {"format": "png", "dpi": 90, "metadata": {"Software": None}}),
            (style.to_svg(figure), {"format": "svg", "metadata": {"Date": None}}),
        ):
            assert figure.canvas is canvas and figure.dpi == dpi
            by_savefig = io.BytesIO()
            figure.savefig(by_savefig, **options)  # type: ignore[arg-type]
            assert drawn == by_savefig.getvalue()


def test_axes_need_names() -> None:
    _, axes = style.canvas()
    with pytest.raises(ValueError, match="the y axis must have a label"):
        style.label(axes, "time (s)", "")


# Several processes


def dies(progress: Progress) -> Section:
    os._exit(3)


def whose(progress: Progress, parent: int) -> Section:
    progress("working")
    elsewhere = os.getpid() != parent
    threads = os.environ.get("OPENBLAS_NUM_THREADS")
    return section(Check(str(threads), "in another process", elsewhere, float(elsewhere), "= 1"))


def test_sections_are_shared_and_those_that_measure_seconds_are_not(tmp_path: Path, capsys: Any) -> None:
    """The page keeps its order; what measures seconds runs in this process, when the others are done."""
    shared, own = partial(whose, parent=os.getpid()), partial(whose, parent=0)
    jobs = [
        SectionJob("clock", "Clock", own, alone=True),
        SectionJob("one", "One", shared),
        SectionJob("crash", "Crash", crash),
        SectionJob("two", "Two", shared),
    ]
    assert verify.run(jobs, tmp_path, workers=2) == 1
    out = capsys.readouterr().out
    assert [out.index(title) for title in ("One", "Crash", "Two", "Clock")] == sorted(
        out.index(title) for title in ("One", "Crash", "Two", "Clock")
    )
    page = (tmp_path / "index.html").read_text()
    places = [page.index(f'id="{key}"') for key in ("clock", "one", "crash", "two")]
    assert places == sorted(places) and "ZeroDivisionError" in page
    assert "3 passed, 1 failed" in out
    assert "OPENBLAS_NUM_THREADS" in os.environ and not active_children()  # set by the tests' own configuration


def begun(progress: Progress, key: str, log: Path) -> Section:
    with log.open("a") as lines:
        lines.write(key + "\n")
    return section(GREEN)


def test_the_costliest_sections_are_begun_first_and_the_page_keeps_its_order(tmp_path: Path) -> None:
    log = tmp_path / "log"
    costs = {"short": 1.0, "long": 20.0, "middle": 5.0, "other": 1.0}
    jobs = [SectionJob(key, key, partial(begun, key=key, log=log), cost=cost) for key, cost in costs.items()]
    assert [built.key for built in verify._shared(jobs, 1, None)] == list(costs)
    assert log.read_text().split() == ["long", "middle", "short", "other"]


def test_a_process_that_dies_is_red_and_ends_nothing_else(tmp_path: Path, capsys: Any) -> None:
    jobs = [SectionJob("dies", "Dies", dies), SectionJob("clock", "Clock", partial(of_checks, checks=(GREEN,)), True)]
    assert verify.run(jobs, tmp_path, workers=2) == 1
    assert (
        "BrokenProcessPool" in (tmp_path / "index.html").read_text() and "1 passed, 1 failed" in capsys.readouterr().out
    )


def test_an_interruption_ends_the_processes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*arguments: Any) -> Section:
        raise KeyboardInterrupt

    monkeypatch.setattr(verify, "_result", interrupted)
    with pytest.raises(KeyboardInterrupt):
        verify.run([SectionJob("one", "One", partial(of_checks, checks=(GREEN,)))], tmp_path, workers=2)
    assert not active_children() and not list(tmp_path.iterdir())
