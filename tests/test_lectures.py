"""Lectures: the rules that each must keep, their notebooks, the student edition, the commands and the site."""

from __future__ import annotations

import fcntl
import json
import os
import re
import resource
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import headless
import pytest
from typer.testing import CliRunner

from dsim.cli import app, main
from dsim.lectures import folder, notebook, rules, site
from dsim.lectures.sphinx_conf import as_rst
from dsim.pictures.notebook import show
from dsim.pictures.style import canvas
from dsim.report import lectures as report

ROOT = Path(__file__).parent.parent
FIXTURE = Path(__file__).parent / "lecture_fixture"
ALL = folder.lectures(ROOT / "lectures")
EXPECTED = ["01", "02", "03", "04", "05", "09", "10", "12", "13"]
BROWSER = headless.find_browser()


@pytest.fixture
def tiny(tmp_path: Path) -> folder.Lecture:
    """A lecture beside an assignment, to be spoilt."""
    shutil.copytree(FIXTURE, tmp_path / "lectures")
    (tmp_path / "assignments" / "01_time_stepping").mkdir(parents=True)
    (tmp_path / "assignments" / "01_time_stepping" / "handout.md").write_text("# 01 Time stepping\n")
    return folder.lectures(tmp_path / "lectures")[0]


def red(lecture: folder.Lecture) -> list[str]:
    return [check.statement for check in rules.check_source(lecture, notebook.read(lecture)) if not check.passed]


def test_the_course_is_there() -> None:
    assert [lecture.number for lecture in ALL if lecture.number in EXPECTED] == EXPECTED


@pytest.mark.parametrize("lecture", ALL, ids=lambda lecture: lecture.path.stem)
def test_a_lecture_keeps_the_rules_and_its_notebook_is_of_its_source(lecture: folder.Lecture) -> None:
    assert red(lecture) == [] and notebook.differences(lecture) == []
    book = _as_notebook(json.loads(lecture.notebook.read_text()))
    assert [str(check) for check in rules.check_outputs(lecture, book) if not check.passed] == []


def _as_notebook(data: dict[str, Any]) -> Any:
    import nbformat

    return nbformat.from_dict(data)


SPOILT = {
    "the title begins with the number": ("# 01 Tiny", "# 07 Tiny"),
    "there is a part: What you will be able to do": ("## What you will", "## What he will"),
    "there is a part: Sources": ("## Sources", "## Sorcery"),
    "lines of the longest cell": ("x = 1\n", "x = 1\n" * 16),
    "exercises": ("### Exercise 2", "### Another 2"),
    "folded solutions": ("<details>", "<span>"),
    "cells to write in": (":tags: [exercise]", ":tags: [other]"),
    "cells with asserts": ("assert", "print"),
    "the first cell draws a picture": ("show(", "print("),
    "02_other.ipynb is there": ("02_other.md", "03_other.md"),
    "it links its assignment": ("../assignments/01_time_stepping/handout.md", "01_tiny.md"),
}


@pytest.mark.parametrize("statement", SPOILT)
def test_a_rule_can_be_broken(statement: str, tiny: folder.Lecture) -> None:
    """Mutation: each rule turns red."""
    assert red(tiny) == []
    text = tiny.path.read_text()
    tiny.path.write_text(text.replace(*SPOILT[statement]))
    found = red(tiny)
    assert statement in found or statement.replace("02_", "03_") in found


def test_a_lecture_is_run_written_and_compared(tiny: folder.Lecture) -> None:
    book = notebook.read(tiny)
    notebook.execute(tiny, book)
    assert [check for check in rules.check_outputs(tiny, book) if not check.passed] == []
    notebook.write(book, tiny.notebook)
    first = tiny.notebook.read_bytes()
    again = notebook.read(tiny)
    notebook.execute(tiny, again)
    notebook.write(again, tiny.notebook)
    assert tiny.notebook.read_bytes() == first, "a notebook must not change from run to run"
    assert notebook.differences(tiny) == []
    tiny.path.write_text(tiny.path.read_text().replace("y = 2", "y = 3"))
    assert notebook.differences(tiny) == ["01_tiny.ipynb: cell 10 differs from the source"]
    tiny.notebook.write_text("{")
    assert "is no notebook" in notebook.differences(tiny)[0]
    tiny.notebook.unlink()
    assert "is missing" in notebook.differences(tiny)[0]


def test_outputs_are_judged(tiny: folder.Lecture) -> None:
    """Mutation: a picture without a text, a warning, a path of this machine, too few pictures."""
    book = notebook.read(tiny)
    code = [cell for cell in book.cells if cell.cell_type == "code"]
    code[0].outputs = [
        _as_notebook({"output_type": "display_data", "metadata": {}, "data": {"image/png": "AA" * 300_000}})
    ]
    code[1].outputs = [_as_notebook({"output_type": "stream", "name": "stderr", "text": f"see {Path.home()}"})]
    found = {check.statement for check in rules.check_outputs(tiny, book) if not check.passed}
    assert found == {"pictures", "bytes of the largest picture", "pictures with alternative texts", "outputs on stderr",
                     "nothing printed names a place on this machine"}  # fmt: skip


def test_students_get_no_solutions(tiny: folder.Lecture) -> None:
    text = json.dumps(notebook.for_students(notebook.read(tiny)))
    assert "secret" not in text and "assert x == 1" not in text and "your code here" in text
    assert "secret" in json.dumps(notebook.read(tiny))


def test_students_get_no_dead_links() -> None:
    """Only notebooks are handed out: links to other files become words, addresses stay."""
    for lecture in ALL:
        kept = notebook.for_students(notebook.read(lecture))
        prose = "\n".join(cell.source for cell in kept.cells if cell.cell_type == "markdown")
        assert (
            not re.search(r"(?<!!)\[[^\]]+\]\((?![a-z]+:)", prose) and "handout" not in prose and "Assignment" in prose
        )


def test_a_false_assert_is_told_with_its_cell(tiny: folder.Lecture, capsys: pytest.CaptureFixture[str]) -> None:
    tiny.path.write_text(tiny.path.read_text().replace("assert x == 1", "assert x == 2, 'one is not two'"))
    assert report.check(["01"], tiny.path.parent, 1) == 1
    out = " ".join(capsys.readouterr().out.split())
    assert "code cell 4 (assert x == 2, 'one is not two')" in out and "AssertionError: one is not two" in out
    assert report.build(["01"], tiny.path.parent, None, False, False, 1) == 1 and not tiny.notebook.exists()


def test_what_is_no_lecture(tmp_path: Path, tiny: folder.Lecture) -> None:
    tiny.path.write_bytes(b"---\njupytext: [\n---\n\xff")
    with pytest.raises(notebook.LectureError, match=r"01_tiny\.md must be a MyST notebook"):
        notebook.read(tiny)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="--lectures must hold lectures"):
        folder.root(tmp_path / "empty")
    with pytest.raises(ValueError, match="NN must be one of 01, 02; got '7'"):
        folder.select(tmp_path / "lectures", ["7"])
    with pytest.raises(ValueError, match="alt must say"):
        show(canvas()[0], " ")


def test_the_commands(tiny: folder.Lecture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                      capsys: pytest.CaptureFixture[str]) -> None:  # fmt: skip
    where = ["--lectures", str(tiny.path.parent)]

    def run(*arguments: str) -> tuple[int, str]:
        result = CliRunner().invoke(app, ["lectures", *arguments, *where])
        return result.exit_code, result.stdout

    assert run("list")[0] == 0 and "not built" in run("list")[1] and "Tiny" in run("list")[1]
    code, _ = run("build", "1", "--student", "--to", str(tmp_path / "out"))
    assert code == 0 and "secret" not in (tmp_path / "out" / "01_tiny.ipynb").read_text()
    assert run("check", "1")[0] == 1  # no notebook beside the source
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    for arguments, words in ((["build"], "pip install"), (["open"], "pip install")):
        monkeypatch.setattr("sys.argv", ["dsim", "lectures", *arguments, *where])
        with pytest.raises(SystemExit) as stop:
            main()
        assert stop.value.code == 2 and words in capsys.readouterr().err


def test_open_starts_jupyter(tiny: folder.Lecture, monkeypatch: pytest.MonkeyPatch) -> None:
    called: list[Any] = []

    class Done:
        returncode = 0

    monkeypatch.setattr("subprocess.run", lambda words, cwd: called.append((words, cwd)) or Done())
    assert report.open_all("01", tiny.path.parent) == 0
    words, cwd = called[0]
    assert words[1:3] == ["-m", "jupyterlab"] and words[3].endswith("01_tiny.ipynb") and cwd == tiny.path.parent


def test_docstrings_become_text() -> None:
    made = as_rst(["A sum `a_i` of a_* and more.", "", "- one,", "  two", "- three", "", "    a = b", "", ">>> 1", "1"])
    assert made[0] == r"A sum ``a_i`` of a\_\* and more." and "::" in made and "    >>> 1" in made and "- one," in made


# The whole course and its site: slow


EACH = 45.0  # s of a lecture's kernel
WHOLE = 2 * 300.0  # s of all, on two cores


@pytest.mark.slow
@pytest.mark.parametrize("lecture", ALL, ids=lambda lecture: lecture.path.stem)
def test_a_lecture_runs_in_time_and_is_the_committed_one(lecture: folder.Lecture) -> None:
    """Processor time, which other work hardly changes, and at most a fair share of what all may take together."""
    before, book = resource.getrusage(resource.RUSAGE_CHILDREN), notebook.read(lecture)
    notebook.execute(lecture, book)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    told = [str(check) for check in rules.check_outputs(lecture, book) if not check.passed]
    assert told == [] and notebook.differences(lecture) == []
    assert 0 < seconds <= min(EACH, WHOLE / len(ALL))


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site of the committed notebooks, built once for all processes of the tests."""
    import nbformat

    shared = tmp_path_factory.getbasetemp()
    shared = (shared.parent if "PYTEST_XDIST_WORKER" in os.environ else shared) / "site"
    shared.mkdir(exist_ok=True)
    with (shared / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (shared / "course").exists():
            books = [(lecture, nbformat.read(lecture.notebook, as_version=4)) for lecture in ALL]
            site.build(books, ROOT / "assignments", shared / "course")
    return shared / "course"


@pytest.fixture(scope="module")
def browser() -> Iterator[headless.Pipe]:
    if BROWSER is None:
        pytest.skip(f"no browser: none of {', '.join(headless.NAMES)} on the path")
    with headless.connection(BROWSER) as pipe:
        yield pipe


def faults(visit: headless.Visit, window: int) -> list[str]:
    """Those of a page that may load files beside it, and nothing else."""
    return [fault for fault in visit.faults(window) if not fault.startswith("outside request: file:")]


@pytest.mark.slow
def test_every_page_opens_offline(pages: Path, browser: headless.Pipe) -> None:
    listed = sorted(pages.rglob("*.html"))
    assert len(listed) > 20
    for page in listed:
        visit = headless.visit(browser, page)
        assert faults(visit, 1200) == [], page.name
        if page.parent.name == "lectures":
            assert visit.pictures >= 2, page.name


@pytest.mark.slow
@pytest.mark.parametrize("width, scheme", [(390, "light"), (390, "dark"), (1200, "dark")])
def test_pages_suit_phones_and_the_night(width: int, scheme: str, pages: Path, browser: headless.Pipe) -> None:
    for name in ("index.html", "lectures/02_stability.html", "assignments/01_time_stepping/handout.html",
                 "reference/2_steppers.html"):  # fmt: skip
        visit = headless.visit(browser, pages / name, width=width, scheme=scheme)
        assert faults(visit, width) == [], (name, width, scheme)


@pytest.mark.slow
def test_equations_search_and_folds_work(pages: Path, browser: headless.Pipe) -> None:
    page = pages / "lectures" / "02_stability.html"
    drawn = headless.ask(
        browser,
        page,
        "new Promise(done => setTimeout(() => done(document.querySelectorAll('mjx-container').length), 2000))",
    )
    assert drawn > 20
    opened = (
        "(() => { const d = document.querySelector('details'); const b = d.scrollHeight;"
        " d.open = true; return [b, d.scrollHeight]; })()"
    )
    before, after = headless.ask(browser, page, opened)
    assert after > before
    found = headless.ask(
        browser,
        pages / "search.html",
        "new Promise(done => setTimeout(() => done(document.querySelectorAll('#search-results li').length), 3000))",
        "?q=checkpoints",
    )
    assert found >= 1


def test_a_site_is_whole_or_absent(tiny: folder.Lecture, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("dear")
    with pytest.raises(ValueError, match="must be a new or empty directory"):
        site.build([(tiny, notebook.read(tiny))], None, tmp_path / "mine")
    assert (tmp_path / "mine" / "thesis.txt").read_text() == "dear"


def test_the_readme_lists_the_lectures() -> None:
    text = (ROOT / "README.md").read_text()
    listed = re.findall(r"^\| \[(\d\d)\]\(lectures/(\w+)\.ipynb\) \| (.+) \|$", text, flags=re.M)
    assert listed == [(lecture.number, lecture.path.stem, lecture.title) for lecture in ALL]
