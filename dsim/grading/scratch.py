"""Temporary directories that a later run removes if theirs was killed."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from typing import IO

try:
    import fcntl
except ImportError:  # not on this system: directories of killed runs stay
    fcntl = None  # type: ignore[assignment]

LOCK = ".in-use"
YOUNG = 60.0  # s; a directory that is younger may be about to be locked


@contextmanager
def scratch(kind: str) -> Iterator[Path]:
    """A directory `dsim-KIND-...` among the temporary ones, removed at the end; marked as in use until then."""
    with TemporaryDirectory(prefix=f"dsim-{kind}-") as directory:
        path = Path(directory)
        with (path / LOCK).open("w") as mark:
            _lock(mark)
            yield path


def sweep(older: float = YOUNG) -> list[Path]:
    """Remove what killed runs of this user left; the directories that are gone now.  older: s since they were made.

    The system drops a lock with the process that holds it, wherever that ran: what can be locked is nobody's.
    """
    gone: list[Path] = []
    if fcntl is None:
        return gone
    for path in Path(gettempdir()).glob("dsim-*"):
        with suppress(OSError):
            facts = path.lstat()
            if facts.st_uid != os.getuid() or time.time() - facts.st_mtime < older or path.is_symlink():
                continue
            with (path / LOCK).open("r+") as mark:
                if _lock(mark):
                    shutil.rmtree(path)
                    gone.append(path)
    return gone


def _lock(mark: IO[str]) -> bool:
    """Whether the mark is ours now: not where another process has it, or where there are no such locks."""
    if fcntl is None:
        return False
    try:
        fcntl.flock(mark, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
