"""What travels to another machine: the files of an assignment that grading needs, and which dsim it was sent by."""

from __future__ import annotations

import hashlib
import io
import zipfile
from functools import lru_cache
from pathlib import Path

import dsim

PACKAGE = Path(dsim.__file__).parent
LEFT_OUT = ("__pycache__", "mutants", "alternatives", "solution.py")  # grading needs none of them


def needed(assignment: Path) -> list[Path]:
    """The files that grading needs, relative to the assignment: rubric, kit, checks, and what lies beside them."""
    found = (path.relative_to(assignment) for path in sorted(assignment.rglob("*")) if path.is_file())
    return [path for path in found if not set(path.parts) & set(LEFT_OUT) and path.suffix not in (".png", ".md")]


def packed(assignment: Path) -> bytes:
    """Those files, in a folder of the assignment's name, as a zip archive; the same bytes for the same files."""
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in needed(assignment):
            archive.writestr(zipfile.ZipInfo(f"{assignment.name}/{path.as_posix()}"), (assignment / path).read_bytes())
    return data.getvalue()


def unpacked(data: bytes, directory: Path) -> Path:
    """Write the files of `packed` into a directory; the assignment's folder there."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        archive.extractall(directory)
        return directory / archive.namelist()[0].partition("/")[0]


def sources() -> list[Path]:
    """The files of dsim itself, relative to the package; not the assignments and lectures that a wheel carries."""
    found = (path.relative_to(PACKAGE) for path in sorted(PACKAGE.rglob("*")) if path.is_file())
    return [path for path in found if path.parts[0] != "course" and "__pycache__" not in path.parts]


@lru_cache(maxsize=1)
def fingerprint() -> str:
    """The version of dsim and a digest of its Python files: the same where grades are made by the same code."""
    digest = hashlib.sha256()
    for path in sources():
        if path.suffix == ".py":
            digest.update(path.as_posix().encode() + b"\0" + (PACKAGE / path).read_bytes() + b"\0")
    return f"{dsim.__version__} ({digest.hexdigest()[:12]})"
