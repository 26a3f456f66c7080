"""Temporary directories: whose run was killed they are removed by the next; others never."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from dsim.grading import scratch

HOLDER = "from dsim.grading.scratch import scratch\nwith scratch('test') as d: print(d, flush=True); input()"


@pytest.fixture
def room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def test_a_killed_run_leaves_what_the_next_removes(room: Path) -> None:
    """One that lives keeps its directory, however old; one that was killed does not."""
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLDER],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env={**os.environ, "TMPDIR": str(room)},
    )  # fmt: skip
    assert holder.stdout is not None and holder.stdin is not None
    kept = Path(holder.stdout.readline().strip())
    assert kept.parent == room and scratch.sweep(older=-1) == [] and kept.exists()
    holder.send_signal(signal.SIGKILL)
    holder.wait()
    holder.stdin.close()
    holder.stdout.close()
    assert scratch.sweep() == [] and kept.exists()  # too young: it might not be locked yet
    assert scratch.sweep(older=-1) == [kept] and not kept.exists()


def test_what_is_not_ours_stays(room: Path) -> None:
    (room / "dsim-notes").mkdir()  # without a mark
    (room / "dsim-file").write_text("")
    (room / "elsewhere").mkdir()
    (room / "elsewhere" / scratch.LOCK).touch()
    (room / "dsim-link").symlink_to(room / "elsewhere")
    assert scratch.sweep(older=-1) == [] and len(list(room.iterdir())) == 4


def test_a_directory_goes_with_its_block(room: Path) -> None:
    with pytest.raises(KeyError), scratch.scratch("test") as path:
        assert path.is_dir()
        raise KeyError
    assert not list(room.iterdir())
