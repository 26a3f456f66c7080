"""Finished measurements on disk: a study that was interrupted goes on where it stopped."""

from __future__ import annotations

import hashlib
import json
import os
import platform
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np


@lru_cache(maxsize=1)
def versions() -> dict[str, str]:
    """What a measurement depends on: Python, NumPy, SciPy and dsim's own numerical sources, as a digest."""
    import scipy

    root = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        place = path.relative_to(root)
        if place.parts[0] not in ("pictures", "report", "cli.py"):
            digest.update(str(place).encode() + path.read_bytes())
    return {
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "dsim": digest.hexdigest()[:16],
    }


class Store:
    """A directory of JSON files, one a cell, each complete or absent.  Without a directory, memory."""

    def __init__(self, directory: str | Path | None = None, fresh: bool = False) -> None:
        self.directory = None if directory is None else Path(directory)
        self._memory: dict[str, dict[str, Any]] = {}
        if self.directory is not None:
            self.directory.mkdir(parents=True, exist_ok=True)
            if fresh:
                for path in self.directory.glob("*.json"):
                    path.unlink()

    def get(self, *key: str) -> dict[str, Any] | None:
        """The cell stored under this key, or None; a damaged file counts as absent."""
        if self.directory is None:
            return self._memory.get(self._name(key))
        try:
            kept = json.loads((self.directory / self._name(key)).read_text(encoding="utf-8"))
            found: dict[str, Any] = kept["cell"]
            return found if kept["digest"] == _digest(found) else None
        except (FileNotFoundError, json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError):
            return None

    def put(self, value: dict[str, Any], *key: str) -> None:
        """Keep a cell: written beside its place, then renamed."""
        name = self._name(key)
        if self.directory is None:
            self._memory[name] = value
            return
        partial = self.directory / f".{name}.{os.getpid()}.partial"
        try:
            partial.write_text(json.dumps({"cell": value, "digest": _digest(value)}), encoding="utf-8")
            os.replace(partial, self.directory / name)
        finally:
            partial.unlink(missing_ok=True)

    def _name(self, key: tuple[str, ...]) -> str:
        text = json.dumps([*key, versions()], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:24] + ".json"


def _digest(value: dict[str, Any]) -> str:
    """Of a cell as it reads back: a file that was damaged into other JSON shows."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]
