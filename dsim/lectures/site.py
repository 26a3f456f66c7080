"""The HTML site: lectures with their outputs, handouts, and the reference, readable from a disk without a network."""

from __future__ import annotations

import base64
import copy
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from dsim.lectures.folder import Lecture
from dsim.lectures.notebook import write
from dsim.lectures.rules import LINK, alt_of
from dsim.lectures.sphinx_conf import CSS

REFERENCE = {
    "Systems and runs": ("dsim.system", "dsim.simulation", "dsim.planning"),
    "Effects": ("dsim.effects.effect", "dsim.effects.gravity", "dsim.effects.drag", "dsim.effects.field",
                "dsim.effects.springs", "dsim.effects.spring_damping", "dsim.effects.actuation"),
    "Steppers": ("dsim.steppers.euler", "dsim.steppers.explicit", "dsim.steppers.implicit", "dsim.steppers.rule",
                 "dsim.steppers.stepper", "dsim.steppers.checkpoints"),
    "Gradients": ("dsim.gradients.adjoint", "dsim.gradients.sensitivity", "dsim.gradients.quasistatic",
                  "dsim.gradients.monolithic", "dsim.gradients.objectives", "dsim.gradients.optimisation"),
    "Checks": ("dsim.studies.gradient_check", "dsim.studies.derivatives", "dsim.studies.convergence",
               "dsim.studies.work_precision", "dsim.studies.verdicts", "dsim.studies.effect_cost"),
    "Solvers and kernels": ("dsim.solve.newton", "dsim.solve.linear", "dsim.kernels.kernel", "dsim.kernels.spring"),
    "Scenes, strategies, pictures": ("dsim.scenes.scene", "dsim.strategies", "dsim.pictures.style",
                                     "dsim.pictures.notebook"),
}  # fmt: skip


class SiteError(RuntimeError):
    """Sphinx could not build the site; the message is its own."""


def build(lectures: Sequence[tuple[Lecture, Any]], assignments: Path | None, to: Path) -> Path:
    """The site of some executed notebooks in `to`, whole or not at all; its index page.

    assignments: their directory, whose handouts become pages.  Raises SiteError.
    """
    target = Path(os.path.abspath(to))
    if target.exists() and not (target / "index.html").is_file() and (target.is_file() or any(target.iterdir())):
        raise ValueError(f"--to must be a new or empty directory, or an earlier site; {to} is something else")
    target.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix="dsim-site-") as directory:
        source, built = Path(directory, "source"), target.with_name(f".{target.name}.{os.getpid()}.partial")
        _stage(source, lectures, assignments)
        shutil.rmtree(built, ignore_errors=True)
        try:
            _sphinx(source, built)
            for name in (".doctrees", ".buildinfo"):
                shutil.rmtree(built / name, ignore_errors=True)
            shutil.rmtree(target, ignore_errors=True)
            built.rename(target)
        finally:
            shutil.rmtree(built, ignore_errors=True)
    return target / "index.html"


def _sphinx(source: Path, built: Path) -> None:
    package = str(Path(__file__).parents[2])
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([package, os.environ.get("PYTHONPATH", "")])}
    words = [sys.executable, "-m", "sphinx", "-b", "html", "-q", "-W", "--keep-going", "-d", str(source / ".doctrees")]
    run = subprocess.run([*words, str(source), str(built)], capture_output=True, text=True, env=environment)
    if run.returncode:
        told = run.stderr.replace(str(source), "").strip().splitlines()
        raise SiteError("\n".join(told[-12:]) or f"Sphinx ended with {run.returncode}")


def _stage(source: Path, lectures: Sequence[tuple[Lecture, Any]], assignments: Path | None) -> None:
    """Everything Sphinx reads."""
    for name in ("lectures", "_extra", "pictures", "reference", "assignments"):
        (source / name).mkdir(parents=True)
    (source / "conf.py").write_text("from dsim.lectures.sphinx_conf import *  # noqa: F403\n")
    (source / "_extra" / "course.css").write_text(CSS)
    handouts = _handouts(source, assignments)
    for lecture, notebook in lectures:
        write(_for_site(notebook, source), source / "lectures" / lecture.notebook.name)
    known = {lecture.path.stem for lecture, _ in lectures}
    for path in (source / "lectures").glob("*.ipynb"):
        text = path.read_text(encoding="utf-8")
        link = re.compile(r"\[([^\[\]]+)\]\((\d\d_\w+)\.ipynb\)")
        path.write_text(link.sub(lambda m: m[0] if m[2] in known else m[1], text), encoding="utf-8")
    _reference(source)
    _index(source, lectures, handouts)


def _for_site(notebook: Any, source: Path) -> Any:
    """Alternative texts where myst-nb looks for them; links that lead nowhere in the site become text."""
    made = copy.deepcopy(notebook)
    for cell in made.cells:
        if cell.cell_type == "markdown":
            cell["source"] = _linked(cell.source, source)
        alts = [alt_of(output) for output in cell.get("outputs", ()) if "image/png" in output.get("data", {})]
        if alts:
            cell.metadata["mystnb"] = {"image": {"alt": alts[0]}}
    return made


def _linked(text: str, source: Path) -> str:
    def there(match: re.Match[str]) -> str:
        target = match[1]
        web = re.match(r"[a-z]+:", target) or re.fullmatch(r"\d\d_\w+\.ipynb", target)
        return match[0] if web or (source / "lectures" / target).exists() else "]"

    linked = LINK.sub(there, text)
    return re.sub(r"\[([^\[\]]+)\](?![\(\[:])", r"\1", linked) if linked != text else text


def _handouts(source: Path, assignments: Path | None) -> list[tuple[str, str]]:
    """(document, title) of every handout."""
    found = []
    for path in sorted(assignments.glob("[0-9][0-9]_*/handout.md")) if assignments else ():
        folder = source / "assignments" / path.parent.name
        folder.mkdir()
        text = path.read_text(encoding="utf-8")
        (folder / "handout.md").write_text(text, encoding="utf-8")
        for picture in path.parent.glob("*.png"):
            shutil.copyfile(picture, folder / picture.name)
        found.append((f"assignments/{path.parent.name}/handout", text.splitlines()[0].removeprefix("# ")))
    guide = assignments / "INSTRUCTORS.md" if assignments else None
    if guide is not None and guide.is_file():
        text = re.sub(r"\[([^\]]+)\]\((?![a-z]+:)[^)]+\)", r"\1", guide.read_text(encoding="utf-8"))
        (source / "assignments" / "INSTRUCTORS.md").write_text(text, encoding="utf-8")
        found.append(("assignments/INSTRUCTORS", "Instructor's guide"))
    return found


def _reference(source: Path) -> None:
    """A page a floor."""
    pages = []
    for number, (title, modules) in enumerate(REFERENCE.items()):
        lines = [title, "=" * len(title), ""]
        for module in modules:
            lines += [module, "-" * len(module), "", f".. automodule:: {module}", ""]
        name = f"{number}_{re.sub(r'[^a-z]+', '_', title.lower())}"
        (source / "reference" / f"{name}.rst").write_text("\n".join(lines))
        pages.append(name)
    head = ["Reference", "=========", "", "From the docstrings; their examples are run by the tests.", ""]
    (source / "reference" / "index.rst").write_text("\n".join([*head, ".. toctree::", "", *(f"   {p}" for p in pages)]))


def _index(source: Path, lectures: Sequence[tuple[Lecture, Any]], handouts: Sequence[tuple[str, str]]) -> None:
    lines = ["# Differentiable simulation: the course", "",
             "Notebooks that run, assignments that grade themselves, and a library that is checked.", ""]  # fmt: skip
    for lecture, notebook in lectures:
        name = lecture.path.stem
        lines += [f"## [{lecture.number} {lecture.title}](lectures/{name}.ipynb)", ""]
        if (picture := first_picture(notebook)) is not None:
            (source / "pictures" / f"{name}.png").write_bytes(picture[0])
            lines += [f"![{picture[1]}](pictures/{name}.png)", ""]
        lines += [hook(notebook), ""]
    lines += ["```{toctree}", ":caption: Lectures", ":hidden:", ""]
    lines += [f"lectures/{lecture.path.stem}" for lecture, _ in lectures]
    lines += [
        "```",
        "",
        "```{toctree}",
        ":caption: Assignments",
        ":hidden:",
        "",
        *(name for name, _ in handouts),
        "```",
    ]
    lines += ["", "```{toctree}", ":caption: Library", ":hidden:", "", "reference/index", "```", ""]
    (source / "index.md").write_text("\n".join(lines), encoding="utf-8")


def first_picture(notebook: Any) -> tuple[bytes, str] | None:
    """(PNG, alternative text) of a notebook's first picture."""
    for cell in notebook.cells:
        for output in cell.get("outputs", ()):
            if "image/png" in output.get("data", {}):
                return base64.b64decode(output["data"]["image/png"]), alt_of(output)
    return None


def hook(notebook: Any) -> str:
    """The first paragraph after the title."""
    for block in re.split(r"\n\s*\n", notebook.cells[0].source if notebook.cells else ""):
        if not block.startswith(("#", "-", "**")):
            return " ".join(LINK.sub("]", block).replace("[", "").replace("]", "").split())
    return ""
