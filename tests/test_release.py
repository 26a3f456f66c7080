"""Releases: several at a time, and stubs as notebooks that are worth as much as the files."""

from __future__ import annotations

import ast
import importlib.util
import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from dsim.cli import app
from dsim.grading import folder
from dsim.grading.notebook import notebook
from dsim.grading.regions import stub
from dsim.grading.release import release
from dsim.grading.selfcheck import outcomes
from dsim.grading.submission import read

ROOT = Path(__file__).parent.parent / "assignments"
ALL = folder.assignments(ROOT)


@pytest.mark.parametrize("assignment", ALL, ids=lambda assignment: assignment.path.name)
def test_a_notebook_is_worth_as_much(assignment: folder.Assignment, tmp_path: Path) -> None:
    """The solution as a notebook gets everything, the stub nothing; cells of one's own are left out."""
    solution = (assignment.path / "solution.py").read_text()
    for source, score in ((solution, 1.0), (stub(solution), 0.0)):
        made = json.loads(notebook(source, "me"))
        made["cells"].insert(3, {"cell_type": "code", "metadata": {}, "source": ["raise Exception"]})
        (tmp_path / "me.ipynb").write_text(json.dumps(made))
        found = outcomes(assignment, read(tmp_path / "me.ipynb").source)
        assert sum(outcome.score for outcome in found) == score * sum(outcome.item.points for outcome in found)
    tagged = [cell for cell in made["cells"] if cell["metadata"].get("tags") == ["submission"]]
    functions = [node for node in ast.parse(solution).body if isinstance(node, ast.FunctionDef)]
    assert len(tagged) > len(functions) and all("".join(cell["source"]).count("\ndef ") == 0 for cell in tagged)


def test_a_stub_is_released_as_a_notebook(tmp_path: Path) -> None:
    target = release(folder.find("01", ROOT), tmp_path / "new" / "place", as_notebook=True)
    assert {path.name for path in target.iterdir()} == {"01_time_stepping.ipynb", "handout.md", "kit.py", "success.png",
                                                        "tests"}  # fmt: skip
    handout = (target / "handout.md").read_text()
    assert "check-submission 01_time_stepping.ipynb" in handout and "01_time_stepping.py" not in handout
    path = target / "01_time_stepping.ipynb"
    result = CliRunner().invoke(app, ["check-submission", str(path), "--assignments", str(ROOT)])
    assert result.exit_code == 1 and "0 of 6 public points" in result.stdout
    made = json.loads(path.read_text())
    assert (made["nbformat"], made["nbformat_minor"]) == (4, 5)
    if importlib.util.find_spec("nbformat"):  # comes with Jupyter
        import nbformat

        nbformat.validate(nbformat.read(path, as_version=4))


def test_several_at_a_time_and_a_place_that_is_a_file(tmp_path: Path) -> None:
    words = ["assignments", "release", *(found.number for found in ALL), "--assignments", str(ROOT), "--to"]
    result = CliRunner().invoke(app, [*words, str(tmp_path / "all")])
    assert result.exit_code == 0 and result.stdout.count("written: ") == len(ALL)
    assert sorted(path.name for path in (tmp_path / "all").iterdir()) == [found.path.name for found in ALL]
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match="--to must be a directory"):
        release(ALL[0], tmp_path / "file")


def test_parts_of_a_notebook() -> None:
    """Comments and decorators stay with what follows; imports and constants share a cell; nothing is lost."""
    source = '"""Words."""\n\nimport a\n# one\nB = 1\n\n\n# two\n@a.b\ndef f():\n    pass\n\n\nC = 2\n# end\n'
    cells = ["".join(cell["source"]) for cell in json.loads(notebook(source, "me"))["cells"]]
    assert cells[0].startswith("Words.\n\nWrite in the cells that are tagged")
    assert cells[:4] == [cells[0], "import a\n# one\nB = 1", "# two\n@a.b\ndef f():\n    pass", "C = 2\n# end"]
    assert cells[-1] == "!dsim check-submission me.ipynb"
