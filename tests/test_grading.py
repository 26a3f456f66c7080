"""The grader's parts: values over the pipe, rubrics, submissions, results, a class that is resumed."""

from __future__ import annotations

import csv
import importlib
import json
import os
import shutil
import signal
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.sparse import csr_array
from typer.testing import CliRunner

from dsim.cli import app, main
from dsim.grading import compare, folder, items, results, submission
from dsim.grading import grade as grading
from dsim.grading.inside import protocol
from dsim.grading.results import Graded
from dsim.grading.student import Awards, ItemLost, LocalStudent, StudentError, StudentReply, StudentTimeout
from dsim.grading.submission import SubmissionError, read

ASSIGNMENT = Path(__file__).parent / "grading_fixture"
SOLUTION = (ASSIGNMENT / "solution.py").read_text()
needs_bubblewrap = pytest.mark.skipif(shutil.which("bwrap") is None, reason="bubblewrap is not installed")


def through(value: Any) -> Any:
    frame, place = protocol.encode("value", value), [0]

    def take(size: int) -> bytes:
        place[0] += size
        return frame[place[0] - size : place[0]]

    return protocol.read(take)[1]


def same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.dtype == b.dtype and np.array_equal(a, b, equal_nan=a.dtype.kind in "fc")
    if isinstance(a, list | tuple):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    return type(a) is type(b) and (a == b or (a != a and b != b))


PLAIN = st.none() | st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats() | st.text(max_size=20)
ARRAYS = hnp.arrays(st.sampled_from(["<f8", "<i8", "|b1", "<c16", "<f4"]), hnp.array_shapes(min_dims=0, min_side=0))
VALUES = st.recursive(
    PLAIN | ARRAYS,
    lambda inner: st.lists(inner, max_size=4) | st.tuples(inner, inner) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=12,
)


# The protocol


@given(VALUES)
def test_values_come_out_as_they_went_in(value: Any) -> None:
    assert same(value, through(value))


@given(st.binary(max_size=200), st.binary(max_size=64))
def test_no_bytes_do_anything_but_raise(header: bytes, body: bytes) -> None:
    with pytest.raises(protocol.ProtocolError):
        protocol.decode(header, body)


@given(st.recursive(PLAIN, lambda inner: st.lists(inner, max_size=4), max_leaves=20))
def test_no_json_does_anything_but_raise(tree: Any) -> None:
    header = json.dumps({"kind": "value", "value": tree, "arrays": [["<f8", [2]]]}).encode()
    try:
        protocol.decode(header, np.zeros(2).tobytes())
    except protocol.ProtocolError:
        pass


@pytest.mark.parametrize(
    "value",
    [object(), {1: 2}, np.array([object()]), 2**70, np.zeros(2**24), "x" * 2**21, np.array(["a"]), lambda: 0, b"raw"],
    ids=lambda value: type(value).__name__,
)
def test_other_values_are_refused(value: Any) -> None:
    with pytest.raises(protocol.ProtocolError):
        protocol.encode("value", value)


def test_sparse_matrices_and_subclasses_become_plain_arrays() -> None:
    class Yes(np.ndarray):
        def __eq__(self, other: object) -> bool:  # type: ignore[override]
            return True

    assert type(through(np.eye(2).view(Yes))) is np.ndarray
    np.testing.assert_array_equal(through(csr_array(np.eye(3))), np.eye(3))
    assert through(np.float32(0.5)) == 0.5 and through(np.int32(7)).dtype == np.int32


def test_lengths_are_capped_before_anything_is_read() -> None:
    def take(size: int) -> bytes:
        assert size == protocol.LENGTHS.size
        return protocol.LENGTHS.pack(2**31, 2**60)

    with pytest.raises(protocol.ProtocolError, match="at most"):
        protocol.read(take)


# Comparisons


def test_comparisons_look_at_shape_kind_and_finiteness_first() -> None:
    for value, words in (
        (None, "got nothing"), ([1.0, 2.0], "got a list"), (np.zeros(3), r"shape \(2,\); got \(3,\)"),
        (np.array(["a", "b"]), "real numbers"), (np.array([1.0, np.nan]), "1 of 2"), (True, "got a bool"),
        (np.array([1j, 0]), "real numbers"),
    ):  # fmt: skip
        with pytest.raises(ItemLost, match=words):
            compare.close("x", value, [0.0, 0.0], 1.0)
    with pytest.raises(ItemLost, match=r"off by 1\.0e-02") as lost:
        compare.close("x", np.array([1.0, 1.01]), [1.0, 1.0], 1e-3)
    assert lost.value.error == pytest.approx(0.01 / 1.0) and lost.value.tolerance == 1e-3
    with pytest.raises(ItemLost):
        compare.at_most("e", float("nan"), 1.0)
    assert compare.number("x", np.array([2.0])) == 2.0


# Rubrics


def test_a_rubric_is_closed(tmp_path: Path) -> None:
    found = items.rubric(ASSIGNMENT / "rubric.toml")
    assert [item.id for item in found] == ["double", "solve", "integrate"] and sum(item.points for item in found) == 7
    checks = items.checks(found, ASSIGNMENT / "tests", b"")
    assert set(checks) == {"double", "solve", "integrate"}
    with pytest.raises(ValueError, match="which no item of the rubric names"):
        items.checks(found[:2], ASSIGNMENT / "tests", b"")
    with pytest.raises(ValueError, match="must define test_more"):
        items.checks((*found, items.Item("more", "More", 1, "public", 1.0, "")), ASSIGNMENT / "tests", b"")


@pytest.mark.parametrize(
    "change, words",
    [
        (("points = 2", "points = -2"), r"points of item 1 \(double\) must be above 0; got -2"),
        (("points = 2", 'points = "2"'), r"points of item 1 \(double\) must be a whole number; got '2'"),
        (('id = "solve"', 'id = "double"'), "every id must be there once"),
        (
            ('visible = "public"', 'visible = "secret"'),
            'visible of item 1 .* must be "public" or "hidden"; got \'secret\'',
        ),
        (('hint = "A x = b."', ""), r"hint of item 2 \(solve\) must be a text; got None"),
        (('hint = "A x = b."', 'hint = "A x = b."\nweight = 3'), "fields nobody knows: weight"),
        (("[[item]]", "[[item"), "must be a TOML file"),
    ],
)
def test_a_bad_rubric_is_one_clear_error(change: tuple[str, str], words: str, tmp_path: Path) -> None:
    path = tmp_path / "rubric.toml"
    path.write_text((ASSIGNMENT / "rubric.toml").read_text().replace(*change, 1))
    with pytest.raises(ValueError, match=words):
        items.rubric(path)


# Items


def local(tmp_path: Path, source: str) -> list[items.Outcome]:
    path = tmp_path / "me.py"
    path.write_text(source)
    rows = items.rubric(ASSIGNMENT / "rubric.toml")
    return items.run(rows, items.checks(rows, ASSIGNMENT / "tests", b"s"), LocalStudent(path, ASSIGNMENT))


def test_the_solution_gets_everything_and_a_mistake_its_item(tmp_path: Path) -> None:
    assert [outcome.score for outcome in local(tmp_path, SOLUTION)] == [2, 3, 2]
    wrong = local(tmp_path, SOLUTION + "\ndef solve(A, b): return b\n")
    assert [outcome.score for outcome in wrong] == [2, 1, 2]  # a vector of the right shape is worth a third
    assert "residual" in wrong[1].why and not wrong[0].lost
    stub = local(tmp_path, "def double(x): raise NotImplementedError('twice')\n")
    assert stub[0].why == "NotImplementedError: twice (line 1 of your file)" and stub[0].score == 0


def test_hidden_inputs_come_from_the_secret(tmp_path: Path) -> None:
    rows = items.rubric(ASSIGNMENT / "rubric.toml")
    seen: dict[bytes, list[Any]] = {}
    for secret in (b"a", b"b", b"a "):
        record: list[Any] = []

        class Listening(LocalStudent):
            def call(self, function: str, *arguments: Any, record: list[Any] = record) -> Any:
                record.append(arguments[0])
                return super().call(function, *arguments)

        path = tmp_path / "me.py"
        path.write_text(SOLUTION)
        items.run(rows[1:2], items.checks(rows, ASSIGNMENT / "tests", secret.strip()), Listening(path, ASSIGNMENT))
        seen[secret] = record
    assert len(seen[b"a"]) >= 5
    np.testing.assert_array_equal(seen[b"a"][1], seen[b"a "][1])
    common = sum(any(np.array_equal(a, b) for b in seen[b"b"]) for a in seen[b"a"])
    assert common <= len(seen[b"a"]) // 2  # hypothesis always tries the simplest input too


def test_a_check_that_is_not_ready_for_a_value_costs_the_item_only(tmp_path: Path) -> None:
    item = items.Item("x", "X", 2, "public", 1.0, "")
    path = tmp_path / "me.py"
    path.write_text("def f(): return 'text'\n")

    def check(student: Any) -> None:
        assert student.call("f") + 1 > 0

    found = items.run_item(item, check, LocalStudent(path, ASSIGNMENT))
    assert found.score == 0 and found.why == "what came back could not be looked at (TypeError)"


def test_items_that_are_not_reached_say_so(tmp_path: Path) -> None:
    path = tmp_path / "me.py"
    path.write_text(SOLUTION)
    rows = items.rubric(ASSIGNMENT / "rubric.toml")
    found = items.run(rows, items.checks(rows, ASSIGNMENT / "tests", b""), LocalStudent(path, ASSIGNMENT), whole=-1)
    assert [outcome.score for outcome in found] == [0, 0, 0] and "not reached" in found[0].why


def test_a_local_student_fails_in_the_same_ways(tmp_path: Path) -> None:
    path = tmp_path / "me.py"
    path.write_text("def f(x):\n    return 1 / x\ndef g():\n    return object()\n")
    student = LocalStudent(path, ASSIGNMENT)
    with student.item(1.0):
        with pytest.raises(StudentError, match=r"ZeroDivisionError: .* \(line 2 of your file\)"):
            student.call("f", 0)
        with pytest.raises(StudentReply, match="must be numbers"):
            student.call("g")
        with pytest.raises(StudentError, match="h is not defined"):
            student.call("h")
    assert str(StudentError("NotImplementedError", "", 3)) == "NotImplementedError (line 3 of your file)"


LOOPS = ("    while True: pass\n", "    try:\n        while True: pass\n    except: pass\n    while True: pass\n")


@pytest.mark.parametrize("loop", LOOPS, ids=["plain", "catches the first alarm"])
def test_a_loop_without_end_ends_here_too(loop: str, tmp_path: Path) -> None:
    """The next item has its own time, and this process its old alarm."""
    path, before = tmp_path / "me.py", signal.getsignal(signal.SIGALRM)
    path.write_text(f"def f():\n{loop}\ndef g():\n    return 1.0\n")
    student = LocalStudent(path, ASSIGNMENT, patience=0.2)
    with student.item(1.0):
        with pytest.raises(StudentTimeout, match=r"f is not done after 0.2 s: is there a loop without end\?"):
            student.call("f")
    with student.item(1.0):
        assert student.call("g") == 1.0 and student.changed == set()
    assert signal.getsignal(signal.SIGALRM) is before


def test_a_wrong_answer_is_told_what_it_is_instead() -> None:
    right = np.array([[1.0, 2.0], [0.5, -3.0]])
    for wrong, words in ((-right, r"\. Yours is -1 times what"), (0.5 * right, r"\. Yours is 0\.5 times what"),
                         (right.T, r"\. Yours is the transpose"), (right + 1e-5, r"allowed is 1e-09$"),
                         (0 * right, r"allowed is 1e-09$"), (right + np.eye(2), r"allowed is 1e-09$"),
                         (right * (1 + 1e-5), r"allowed is 1e-09$"), (1e200 * right, "1e.200 times what"),
                         (np.full((2, 2), 1e308), r"allowed is 1e-09$")):  # fmt: skip
        with pytest.raises(ItemLost, match=words):
            compare.close("A", wrong, right, 1e-9)


def test_what_is_imported_that_is_not_there() -> None:
    source = "import os, pandas\nfrom scipy import linalg\nimport kit\ndef f():\n    from dsim.grading import items\n"
    assert submission.foreign_imports(source) == [(1, "pandas"), (5, "dsim.grading")]


def test_a_helper_in_a_cell_that_is_not_graded_is_named(tmp_path: Path) -> None:
    def cell(text: str, *tags: str) -> dict[str, Any]:
        return {"cell_type": "code", "metadata": {"tags": list(tags)}, "source": text}

    book = {"cells": [cell("def helper(): return 1\nscale = 2"), cell("def f(): return helper()", "submission"),
                      cell("def broken(:")]}  # fmt: skip
    path = tmp_path / "me.ipynb"
    path.write_text(json.dumps(book))
    handed_in = read(path)
    assert handed_in.outside == {"helper", "scale"}
    told = handed_in.placed("NameError: name 'helper' is not defined (line 1 of your file)")
    assert told.endswith('helper is in a cell that is not tagged "submission": move it into one that is')
    assert "line 1 of the cell" in told and "tagged" not in handed_in.placed("NameError: name 'other' is not defined")


def test_a_file_that_stops_while_it_is_loaded_is_told_once(tmp_path: Path) -> None:
    outcomes = tuple(local(tmp_path, SOLUTION + "\nimport nothing_like_this\n"))
    text = results.feedback(results.Graded("me", outcomes))
    assert text.count("nothing_like_this") == 1 and "every item ended like this" in text and "Hint" not in text
    assert [outcome.hinted for outcome in outcomes] == [False] * 3
    partly = tuple(items.Outcome(outcome.item, 1.0, "off by 1") for outcome in outcomes)
    assert results.alike(outcomes) and not results.alike(partly)  # what earned something was checked
    assert all(
        "nothing_like_this" in test["output"] for test in results.as_gradescope(results.Graded("me", outcomes))["tests"]
    )


# Submissions


def notebook(*cells: tuple[str, list[str]]) -> str:
    return json.dumps({"nbformat": 4, "cells": [
        {"cell_type": "code", "metadata": {"tags": tags}, "source": source.splitlines(keepends=True)}
        for source, tags in cells
    ]})  # fmt: skip


def test_a_notebook_is_its_tagged_cells(tmp_path: Path) -> None:
    path = tmp_path / "me.ipynb"
    path.write_text(notebook(("raise Exception", []), ("%matplotlib inline\ndef f():\n    return 1", ["submission"])))
    assert read(path).source == "\ndef f():\n    return 1"
    path.write_text(notebook(("a = 1", []), ("b = 2", [])))
    assert read(path).source == "a = 1\n\nb = 2"
    path.write_text("{}")
    with pytest.raises(SubmissionError, match="must be a notebook"):
        read(path)


def test_lines_of_a_notebook_are_those_of_its_cells(tmp_path: Path) -> None:
    path = tmp_path / "me.ipynb"
    cells = "import numpy as np", "%time\ndef double(x):\n    return y\n", "def solve(a, b):\n    return\t z"
    path.write_text(notebook(*((cell, ["submission"]) for cell in cells)))
    found = read(path)
    placed = [found.placed(f"NameError: y (line {line} of your file)") for line in (1, 5, 9)]
    assert [text.removeprefix("NameError: y ") for text in placed] == [
        '(line 1 of the cell that begins "import numpy as np")', '(line 3 of the cell that begins "def double(x):")',
        '(line 2 of the cell that begins "def solve(a, b):")']  # fmt: skip
    assert found.source.splitlines()[4] == "    return y" and found.source.splitlines()[8].endswith("z")
    assert found.placed("it is off") == "it is off"
    path.write_text(notebook(("a = 1", []), ("def f(:\n    pass", [])))
    with pytest.raises(SubmissionError, match=r"not Python in line 1 of the cell that begins \"def f\(:\": "):
        read(path)
    (tmp_path / "me.py").write_text("a = 1\ndef f(:\n")
    with pytest.raises(SubmissionError, match="not Python in line 2: "):
        read(tmp_path / "me.py")


def test_drawn_inputs_do_not_depend_on_what_is_imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """hypothesis reads numbers from modules that are no installed package, and would leave them in ./.hypothesis."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "numbers_of_mine.py").write_text(f"A = {[40 + n / 64 for n in range(300)]}\n")

    def drawn() -> list[float]:
        found: list[float] = []
        for seed in range(20):
            items.prepared(given(x=st.floats(0.1, 100.0))(lambda student, x: found.append(x)), seed)(Awards())
        return found

    before = drawn()
    importlib.import_module("numbers_of_mine")
    assert drawn() == before and not (tmp_path / ".hypothesis").exists()


def test_awards_are_those_of_the_draw_that_failed() -> None:
    """Half for a small x says nothing about a large one."""

    def check(student: Awards, x: float) -> None:
        if x < 50:
            student.award(0.5)
        else:
            raise ItemLost("large")

    class One(Awards):
        def item(self, timeout: float) -> Any:
            return nullcontext()

    item = items.Item("half", "Half", 2, "hidden", 1.0, "")
    found = items.run_item(item, items.prepared(given(x=st.floats(0, 100))(check), 1), One())  # type: ignore[arg-type]
    assert found.score == 0 and found.why == "large"


def test_what_is_no_directory_of_submissions_says_why(tmp_path: Path) -> None:
    directory = classroom(tmp_path)
    (directory / "._ann.py").write_bytes(b"\0\5\x16\7")  # macOS puts them into zips
    assert [path.name for path in grading.submissions_in(directory)] == ["ann.py", "bob.py", "cy.ipynb", "dee.py"]
    with pytest.raises(ValueError, match=r"ann\.py is a file: put it into one of its own"):
        grading.submissions_in(directory / "ann.py")
    found = CliRunner().invoke(app, ["grade", "01", str(directory), "--to", str(directory / "." / "")])
    assert isinstance(found.exception, ValueError) and "--to must not be SUBMISSIONS" in str(found.exception)
    assert len(list(directory.iterdir())) == 5


@needs_bubblewrap
def test_what_a_submission_prints_comes_back(tmp_path: Path) -> None:
    """Although its process is killed, and even where it never returns."""
    (tmp_path / "in").mkdir()
    loud = 'def double(x):\n    print("I got here")\n    while True: pass\n'
    (tmp_path / "in" / "ann.py").write_text(f"{SOLUTION}\n{loud}")
    grading.grade(ASSIGNMENT, [tmp_path / "in" / "ann.py"], tmp_path / "out")
    assert "```text\nI got here\n" in (tmp_path / "out" / "ann" / "feedback.md").read_text()


# Results


def outcomes(*scores: float) -> tuple[items.Outcome, ...]:
    rows = items.rubric(ASSIGNMENT / "rubric.toml")
    return tuple(items.Outcome(item, score, "" if score == item.points else "off by 1")
                 for item, score in zip(rows, scores, strict=True))  # fmt: skip


def test_results_in_gradescopes_format_and_in_words(tmp_path: Path) -> None:
    graded = Graded("ann", outcomes(2, 1, 2), notes="```\nhello\x1b[31m")
    results.write(graded, tmp_path)
    data = json.loads((tmp_path / "results.json").read_text())
    assert data["score"] == 5 and data["max_score"] == 7
    assert [test["visibility"] for test in data["tests"]] == ["visible", "after_due_date", "after_due_date"]
    assert data["tests"][1]["output"] == "off by 1\n\nHint: A x = b."
    text = (tmp_path / "feedback.md").read_text()
    assert "# ann: 5 of 7" in text and text.count("```") == 2 and "\x1b" not in text
    assert results.read(tmp_path, items.rubric(ASSIGNMENT / "rubric.toml")) == {
        "submission": "ann", "score": 5, "max_score": 7, "double": 2, "solve": 1, "integrate": 2,
    }  # fmt: skip
    assert "WITHOUT a sandbox" in results.as_gradescope(Graded("b", outcomes(2, 3, 2), sandboxed=False))["output"]


def test_the_class_and_a_name_that_is_a_formula(tmp_path: Path) -> None:
    rows = [results.read(where, items.rubric(ASSIGNMENT / "rubric.toml")) for where in (tmp_path / "a", tmp_path / "b")]
    assert rows == [None, None]
    for name, scores in (("=1+1", (0, 3, 2)), ("bob", (0, 0, 2))):
        results.write(Graded(name, outcomes(*scores)), tmp_path / name)
    rubric = items.rubric(ASSIGNMENT / "rubric.toml")
    found = [row for name in ("=1+1", "bob") if (row := results.read(tmp_path / name, rubric)) is not None]
    results.write_class(found, rubric, tmp_path)
    table = list(csv.reader((tmp_path / "grades.csv").read_text().splitlines()))
    assert table[0] == ["submission", "score", "max_score", "double", "solve", "integrate"]
    assert table[1][0] == "'=1+1" and table[2] == ["bob", "2", "7", "0.0", "0.0", "2.0"]
    assert (tmp_path / "summary.md").read_text().index("Twice an array") < (tmp_path / "summary.md").read_text().index(
        "One step"
    )


def test_files_that_cannot_be_read_are_counted(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "ann.py").write_text(SOLUTION)
    (tmp_path / "in" / "bob.ipynb").write_text("no notebook")
    grading.grade(ASSIGNMENT, grading.submissions_in(tmp_path / "in"), tmp_path / "out", sandboxed=False)
    assert "1 of them could not be read" in (tmp_path / "out" / "summary.md").read_text()
    assert '"ann",7' in (tmp_path / "out" / "grades.csv").read_text()  # quoted: ";" parts no name


# A class


def classroom(tmp_path: Path) -> Path:
    directory = tmp_path / "submissions"
    directory.mkdir()
    (directory / "ann.py").write_text(SOLUTION)
    (directory / "bob.py").write_text(SOLUTION + "\ndef double(x): return x\n")
    (directory / "cy.ipynb").write_text(notebook((SOLUTION, ["submission"])))
    (directory / "dee.py").write_text("def double(")
    return directory


@pytest.mark.parametrize("sandboxed", [False, pytest.param(True, marks=needs_bubblewrap)])
def test_a_class_is_graded(sandboxed: bool, tmp_path: Path) -> None:
    seen: list[str] = []
    rows = grading.grade(ASSIGNMENT, grading.submissions_in(classroom(tmp_path)), tmp_path / "out", sandboxed=sandboxed,
                         say=lambda done, total, name: seen.append(f"{done}/{total} {name}"))  # fmt: skip
    assert [row["score"] for row in rows] == [7, 5, 7, 0]
    assert seen == ["1/4 ann", "2/4 bob", "3/4 cy", "4/4 dee"]
    assert (tmp_path / "out" / ".dsim-secret").stat().st_mode & 0o077 == 0
    assert ("do not trust" in (tmp_path / "out" / "ann" / "feedback.md").read_text()) is not sandboxed
    rubric = items.rubric(ASSIGNMENT / "rubric.toml")
    summary = (tmp_path / "out" / "summary.md").read_text()
    assert ("4 of them graded WITHOUT a sandbox" in summary) is not sandboxed
    assert "1 of them could not be read" in summary  # dee's
    assert results.read(tmp_path / "out" / "ann", rubric) is not None
    in_the_sandbox = results.read(tmp_path / "out" / "ann", rubric, sandboxed=True)
    assert (in_the_sandbox is not None) is sandboxed  # without one it is graded again when there is one


def test_a_killed_run_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is graded twice, nothing is lost, a half-written result does not count."""
    submissions, to = grading.submissions_in(classroom(tmp_path)), tmp_path / "out"

    def killed(done: int, total: int, name: str) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        grading.grade(ASSIGNMENT, submissions, to, sandboxed=False, say=killed)
    assert sorted(path.parent.name for path in to.glob("*/results.json")) == ["ann", "bob"]
    (to / "ann" / "results.json").write_text('{"score": 7')
    secret = (to / ".dsim-secret").read_bytes()
    again: list[str] = []
    rows = grading.grade(ASSIGNMENT, submissions, to, sandboxed=False, say=lambda done, total, name: again.append(name))
    assert again == ["ann", "cy", "dee"] and [row["score"] for row in rows] == [7, 5, 7, 0]
    assert (to / ".dsim-secret").read_bytes() == secret
    assert grading.grade(ASSIGNMENT, submissions, to, sandboxed=False) == rows


def test_several_at_a_time_give_the_same(tmp_path: Path) -> None:
    submissions = grading.submissions_in(classroom(tmp_path))
    one = grading.grade(ASSIGNMENT, submissions, tmp_path / "one", sandboxed=False)
    (tmp_path / "two").mkdir()
    shutil.copy(tmp_path / "one" / ".dsim-secret", tmp_path / "two")
    assert grading.grade(ASSIGNMENT, submissions, tmp_path / "two", jobs=2, sandboxed=False) == one


def test_submissions_must_be_there_and_of_one_name(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="must be a directory"):
        grading.submissions_in(tmp_path / "none")
    with pytest.raises(ValueError, match="has none"):
        grading.submissions_in(tmp_path)
    for ending in (".py", ".ipynb"):
        (tmp_path / f"ann{ending}").touch()
    with pytest.raises(ValueError, match="ann is there twice"):
        grading.submissions_in(tmp_path)
    assert os.path.exists(tmp_path)


# The command


def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(ASSIGNMENT, tmp_path / "assignments" / "01_tiny")
    (tmp_path / "assignments" / "01_tiny" / "handout.md").write_text("# Tiny\n")
    directory = classroom(tmp_path)
    arguments = ["grade", "1", str(directory), "--to", str(tmp_path / "out")]
    arguments += ["--assignments", str(tmp_path / "assignments")]
    found = CliRunner().invoke(app, [*arguments, "--unsandboxed"])
    assert found.exit_code == 0 and "4 submissions" in found.stdout and "WITHOUT" in found.stderr
    assert (tmp_path / "out" / "grades.csv").is_file()
    monkeypatch.setenv("PATH", str(tmp_path))
    refused = CliRunner().invoke(app, arguments)
    assert refused.exit_code == 2 and "apt-get install" in refused.stderr
    for wrong, words in ((["grade", "7", *arguments[2:]], "NN must be one of 01; got '7'"),
                         ([*arguments[:6], str(directory)], "must hold assignments")):  # fmt: skip
        monkeypatch.setattr("sys.argv", ["dsim", *wrong])
        with pytest.raises(SystemExit) as stop:
            main()
        assert stop.value.code == 2 and words in capsys.readouterr().err


def test_an_assignment_that_lacks_a_file_is_told(tmp_path: Path) -> None:
    shutil.copytree(ASSIGNMENT, tmp_path / "03_tiny")
    with pytest.raises(ValueError, match=r"03_tiny must hold handout\.md"):
        folder.find("3", folder.root(tmp_path))


def test_grades_of_one_assignment_are_not_overwritten_by_another(tmp_path: Path) -> None:
    other = tmp_path / "02_other"
    shutil.copytree(ASSIGNMENT, other)
    file = tmp_path / "me.py"
    file.write_text(SOLUTION)
    grading.grade(ASSIGNMENT, [file], tmp_path / "out", sandboxed=False)
    before = (tmp_path / "out" / "grades.csv").read_bytes()
    with pytest.raises(ValueError, match=f"holds those of {ASSIGNMENT.name}"):
        grading.grade(other, [file], tmp_path / "out", sandboxed=False)
    assert (tmp_path / "out" / "grades.csv").read_bytes() == before
    grading.grade(ASSIGNMENT, [file], tmp_path / "out", sandboxed=False)
