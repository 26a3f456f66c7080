"""Reference problems as files: JSON to read, NPZ to load, a schema, an index with checksums, a README.

Nothing in them depends on when or where they were written: the same dsim writes the same bytes.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import shutil
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from dsim.studies.answers.document import Document, Item, numbers
from dsim.studies.check import Check

Say = Callable[[str], None]
INDEX, README, SCHEMA = "index.json", "README.md", "schema.json"
EPOCH = (1980, 1, 1, 0, 0, 0)  # the earliest date a zip file can hold


def select(items: Sequence[Item], names: Iterable[str]) -> tuple[Item, ...]:
    """The items of these names, all if none is given.  Raises ValueError for a name nobody knows."""
    known = {item.name: item for item in items}
    wanted = list(names)
    for name in wanted:
        if name not in known:
            raise ValueError(f"NAME must be one of {', '.join(known)}; got {name!r}")
    return tuple(known[name] for name in wanted) if wanted else tuple(items)


def export(items: Sequence[Item], directory: Path, say: Say = lambda text: None) -> Path:
    """Write every item, whole or not at all: into a neighbour of `directory`, which then takes its place.

    Raises ValueError where `directory` exists and is not empty, unless it is an earlier export.
    """
    directory = Path(os.path.abspath(directory))
    if directory.exists() and not directory.is_dir():
        raise ValueError(f"DIR must be a directory; {directory} is a file")
    if directory.is_dir() and any(directory.iterdir()) and not _is_export(directory):
        raise ValueError(f"DIR must be new, empty or an earlier export; {directory} holds other files")
    partial = directory.with_name(f".{directory.name}.{os.getpid()}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        _write(items, partial, say)
        if directory.is_dir():
            old = directory.with_name(f".{directory.name}.{os.getpid()}.old")
            directory.rename(old)
            partial.rename(directory)
            shutil.rmtree(old)
        else:
            partial.rename(directory)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return directory


def _write(items: Sequence[Item], directory: Path, say: Say) -> None:
    rows = []
    for item in items:
        say(item.name)
        document = item.build()
        data = {f"{item.name}.json": as_json(document), f"{item.name}.npz": as_npz(document)}
        for name, content in data.items():
            (directory / name).write_bytes(content)
        rows.append({
            "name": item.name, "kind": document["kind"], "description": document["description"],
            "certificate": item.source, "files": {name: _digest(content) for name, content in data.items()},
        })  # fmt: skip
    index = {"format": "dsim-reference-index", "schema_version": 1, "problems": rows}
    (directory / INDEX).write_bytes(_dumped(index))
    for name in (README, SCHEMA):
        (directory / name).write_bytes(files(__package__).joinpath(name).read_bytes())


def as_json(document: Document) -> bytes:
    """Shortest digits that read back to the same double; arrays as nested lists, row by row."""
    return _dumped(_plain(document))


def as_npz(document: Document) -> bytes:
    """Every number and array under its path in the JSON, joined by dots: little-endian float64 or int64."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for path, array in numbers(document):
            data = io.BytesIO()
            np.lib.format.write_array(data, array, version=(1, 0))
            archive.writestr(zipfile.ZipInfo(f"{path}.npy", EPOCH), data.getvalue())
    return buffer.getvalue()


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def _dumped(data: Any) -> bytes:
    return (json.dumps(data, indent=1, allow_nan=False, ensure_ascii=True) + "\n").encode()


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _is_export(directory: Path) -> bool:
    try:
        return bool(_read(directory / INDEX).get("format") == "dsim-reference-index")
    except (ValueError, AttributeError):
        return False


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_bytes())
    except FileNotFoundError:
        raise ValueError(f"DIR must hold {path.name}; there is none in {path.parent}") from None
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} must be readable JSON: {error}") from error


# The check of a directory


def size(directory: Path) -> int:
    """How many problems an export holds.  Raises ValueError for a directory that is none."""
    return len(_index(directory)["problems"])


def _index(directory: Path) -> dict[str, Any]:
    index = _read(directory / INDEX)
    if not isinstance(index, dict) or index.get("format") != "dsim-reference-index":
        raise ValueError(f"DIR must be an export of reference problems; {directory / INDEX} is none")
    return index


def check(items: Sequence[Item], directory: Path, say: Say = lambda text: None) -> list[Check]:
    """Is every file the one that was written, do JSON and NPZ agree, and does this dsim find the same numbers?

    Raises ValueError for a directory that is no export.
    """
    index = _index(directory)
    known = {item.name: item for item in items}
    checks: list[Check] = []
    for row in index["problems"]:
        name = row["name"]
        say(name)
        checks += [_same_bytes(name, directory / file, digest) for file, digest in row["files"].items()]
        if name not in known:
            checks.append(Check(name, "a problem that this dsim knows", False, 0.0, "= 1"))
            continue
        checks += _same_numbers(name, directory, known[name].build())
    return checks


def _same_bytes(name: str, path: Path, digest: str) -> Check:
    same = path.is_file() and _digest(path.read_bytes()) == digest
    return Check(name, f"{path.suffix[1:]} as it was written", same, float(same), "= 1")


def _same_numbers(name: str, directory: Path, document: Document) -> list[Check]:
    told = {path: value for path, value in numbers(_arrays(_read(directory / f"{name}.json")))}
    try:
        with np.load(directory / f"{name}.npz", allow_pickle=False) as archive:
            loaded = {path: archive[path] for path in archive.files}
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise ValueError(f"{directory / name}.npz must be readable: {error}") from error
    expected = dict(numbers(document))
    unlike = sum(1 for path in told.keys() | loaded.keys()
                 if path not in told or path not in loaded or not np.array_equal(told[path], loaded[path]))  # fmt: skip
    worst, off = "every number", 0.0
    for path, value in expected.items():
        if path.startswith("certificate."):
            continue  # how well routes agree may vary in its last digits from machine to machine
        gap = _gap(told.get(path), value)
        worst, off = (path, gap) if gap > off else (worst, off)
    limit = float(max(np.max(document["tolerance"]["states"]), document["tolerance"]["gradient"]))
    return [
        Check(name, "entries in which JSON and NPZ differ", unlike == 0, float(unlike), "= 0"),
        Check(name, f"{worst} as dsim finds it", bool(off <= limit), off, f"<= {limit:g}"),
    ]


def _arrays(value: Any) -> Any:
    """Lists of numbers as arrays again; lists of texts and of evidence stay."""
    if isinstance(value, dict):
        return {key: _arrays(entry) for key, entry in value.items()}
    if isinstance(value, list) and not any(isinstance(entry, str | dict) for entry in value):
        return np.asarray(value)
    return value


def _gap(told: Any, expected: Any) -> float:
    if told is None or np.shape(told) != np.shape(expected):
        return float("inf")
    size = max(float(np.abs(expected).max(initial=0.0)), 1e-300)
    return float(np.abs(np.asarray(told, dtype=float) - expected).max(initial=0.0)) / size
