"""Files that are either complete or absent: an interrupted run never leaves half a picture or half a page."""

from __future__ import annotations

import os
from pathlib import Path


def write_atomically(path: str | Path, data: bytes) -> Path:
    """Write `data` to `path` through a temporary neighbour and a rename: the old file survives interruption.

    Missing parent directories are made.  The neighbour's name holds the process id: two runs do not mix.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        partial.write_bytes(data)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
    return path
