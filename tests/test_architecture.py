"""The floors of the house: what may import what, and what a plain `import dsim` loads."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
HEAVY = ("scipy", "matplotlib", "PIL", "rich", "typer", "jinja2", "hypothesis", "jax", "torch", "IPython")
LINT = "import sys; from importlinter.cli import lint_imports_command; sys.exit(lint_imports_command())"


def lint(root: Path) -> subprocess.CompletedProcess[str]:
    """Run import-linter on the `dsim` below `root`."""
    return subprocess.run(
        [sys.executable, "-c", LINT, "--config", str(ROOT / ".importlinter"), "--no-cache"],
        cwd=root,
        env={**os.environ, "PYTHONPATH": str(root), "PYTHONIOENCODING": "utf-8", "COLUMNS": "200"},
        capture_output=True,
        text=True,
        encoding="utf-8",
    )


def fresh(code: str) -> str:
    """What `code` prints in a new process."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_floors_hold() -> None:
    done = lint(ROOT)
    assert done.returncode == 0, done.stdout + done.stderr


MUTATIONS = {
    "upward import": ("arrays/checks.py", "import dsim.solve\n"),
    "upward import inside a function": ("arrays/checks.py", "def f():\n    import dsim.effects\n"),
    "contact and effects know each other": ("effects/__init__.py", "import dsim.contact\n"),
    "a module without a floor": ("utils.py", "x = 1\n"),
    "matplotlib below pictures": ("arrays/checks.py", "import matplotlib\n"),
    "matplotlib in the report": ("report/html.py", "from matplotlib.figure import Figure\n"),
    "rich below the top": ("arrays/checks.py", "from rich.table import Table\n"),
    "PyTorch outside its layer": ("gradients/adjoint.py", "def f():\n    import torch\n"),
    "hypothesis in the library": ("arrays/checks.py", "import hypothesis\n"),
    "dask outside the cluster": ("grading/grade.py", "import distributed\n"),
}


@pytest.mark.parametrize("mutation", MUTATIONS)
def test_a_broken_floor_is_seen(mutation: str, tmp_path: Path) -> None:
    file, code = MUTATIONS[mutation]
    shutil.copytree(ROOT / "dsim", tmp_path / "dsim", ignore=shutil.ignore_patterns("__pycache__"))
    contact = tmp_path / "dsim" / "contact"
    contact.mkdir(exist_ok=True)
    (contact / "__init__.py").touch()
    with (tmp_path / "dsim" / file).open("a", encoding="utf-8") as source:
        source.write("\n" + code)
    done = lint(tmp_path)
    assert done.returncode == 1 and "BROKEN" in done.stdout, done.stdout + done.stderr


def test_import_dsim_loads_numpy_alone() -> None:
    assert fresh(f"import sys, dsim; print([name for name in {HEAVY!r} if name in sys.modules])") == "[]"


def test_help_loads_no_drawing() -> None:
    show = f"import sys, dsim.cli; print([n for n in {HEAVY[:3] + HEAVY[5:]!r} if n in sys.modules])"
    assert fresh(show) == "[]"


def test_ci_script_is_runnable() -> None:
    script = ROOT / ".ci" / "run"
    assert os.access(script, os.X_OK)
    bash = shutil.which("bash")
    if bash is None:
        pytest.skip("no bash on the path")
    assert subprocess.run([bash, "-n", str(script)], capture_output=True, text=True).stderr == ""


def test_the_command_runs_as_a_module() -> None:
    """For a Python whose scripts are not on the path; bad usage keeps its exit code."""
    done = subprocess.run([sys.executable, "-m", "dsim", "check"], capture_output=True, text=True)
    assert done.returncode == 2 and "give either FILE.py:FUNCTION or --exec PROGRAM" in done.stderr
