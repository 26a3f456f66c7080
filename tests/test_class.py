"""A whole class through the command: killed and gone on with, every kind with the score that it earns."""

from __future__ import annotations

import csv
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from benchmarks import class_of_1000

from dsim.grading import folder
from dsim.grading.grade import grade, submissions_in

pytestmark = pytest.mark.skipif(shutil.which("bwrap") is None, reason="bubblewrap is not installed")
ASSIGNMENT = folder.find("01", Path(__file__).parents[1] / "assignments")
MOST = 16.0


@pytest.mark.slow
def test_a_killed_command_goes_on_where_it_was(tmp_path: Path) -> None:
    """SIGKILL in the middle of a class: results that were there stay as they were, the rest comes, nothing is left."""
    class_of_1000.write_class(ASSIGNMENT, 12, tmp_path / "in", shares={"right": 1.0})
    to = tmp_path / "out"
    command = [sys.executable, "-m", "dsim", "grade", "01", str(tmp_path / "in"), "--to", str(to), "--jobs", "2"]
    command += ["--assignments", str(ASSIGNMENT.path.parent)]
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    process = subprocess.Popen(command, start_new_session=True, stderr=subprocess.DEVNULL, env=environment)
    deadline = time.monotonic() + 60
    while len(list(to.glob("*/results.json"))) < 4:
        assert time.monotonic() < deadline and process.poll() is None
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    before = {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in to.glob("*/results.json")}
    assert 4 <= len(before) < 12 and not (to / "grades.csv").exists()
    left = list(tmp_path.glob("dsim-*"))
    assert left  # of the killed processes
    for path in left:
        os.utime(path, (0, 0))
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    assert {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in before} == before
    with (to / "grades.csv").open(newline="") as file:
        assert [float(row["score"]) for row in csv.DictReader(file)] == [MOST] * 12
    assert not sandboxes(str(tmp_path)) and not list(tmp_path.glob("dsim-*"))


def sandboxes(directory: str) -> list[str]:
    """Processes of sandboxes whose files lie under a directory."""
    out = subprocess.run(["ps", "-eo", "args"], capture_output=True, text=True, check=True).stdout
    return [line for line in out.splitlines() if "bwrap" in line and directory in line]


@pytest.mark.slow
def test_each_kind_gets_what_it_earns_and_memory_does_not_grow(tmp_path: Path) -> None:
    """Twice the submissions: the same scores a kind, and no more memory in the process that hands them out."""
    peaks = []
    for count in (30, 60):
        kinds = class_of_1000.write_class(ASSIGNMENT, count, tmp_path / f"in{count}")
        grade(ASSIGNMENT.path, submissions_in(tmp_path / f"in{count}"), tmp_path / f"out{count}", jobs=2)
        assert class_of_1000.wrong_scores(kinds, tmp_path / f"out{count}" / "grades.csv", MOST) == []
        assert set(kinds.values()) == {"right", "mutant", "stub", "attack", "slow"}
        peaks.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)  # MB
    assert peaks[1] - peaks[0] < 20
    told = json.loads(next((tmp_path / "out30").glob("*/results.json")).read_text())
    assert told["extra_data"]["sandboxed"] is True
