"""Weaker than the sandbox, for containers that may not make one: submissions run as another user, with limits.

What holds as in the sandbox: only values cross the pipe and grades are made on this side of it; processes, memory, time
and file sizes have limits; no rights; nothing that is closed to other users can be read; nothing is left running.
What does not: the network is open, files that anybody may read can be read, and /tmp is shared.  It takes root.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from dsim.grading import there
from dsim.grading.sandbox import (
    FILE_SIZE,
    FILES,
    INSIDE,
    MEMORY,
    PROCESSES,
    Jail,
    SandboxedStudent,
    SandboxError,
    _tool,
)
from dsim.grading.student import StudentError, StudentReply, StudentTimeout

FIRST_USER = 70000  # and the slots above it: nobody's, and not those of the sandbox
PROBE = Path(there.__file__).parent / "probe.py"
PATIENCE = 5.0  # s in which everything of a user must have ended


class OtherUser(Jail):
    """The same files as in the sandbox, in a directory that anybody may read; the user owns its home there alone."""

    @property
    def user(self) -> int:
        return FIRST_USER + self.slot

    def staged(self, directory: Path) -> Jail:
        import numpy
        import scipy

        directory.chmod(0o755)
        staged = super().staged(directory)
        for name in ("packages", "home"):
            (directory / name).mkdir()
            (directory / name).chmod(0o755)  # whatever the umask
        for module in (numpy, scipy):
            home = Path(str(module.__file__)).parent
            for part in (home, home.with_name(f"{home.name}.libs")):
                if part.is_dir():
                    (directory / "packages" / part.name).symlink_to(part)
        os.chown(directory / "home", self.user, self.user)
        return staged

    def command(self) -> list[str]:
        place, user = self.submission.parent, str(self.user)
        threads = [f"{name}_NUM_THREADS=1" for name in ("OPENBLAS", "OMP", "MKL")]
        words = [_tool("setpriv"), "--reuid", user, "--regid", user, "--clear-groups", "--bounding-set", "-all",
                 "--inh-caps", "-all", "--no-new-privs", "--"]  # fmt: skip
        words += [_tool("prlimit"), f"--as={MEMORY}", f"--nproc={PROCESSES}", f"--cpu={self.cpu}", f"--nofile={FILES}",
                  f"--fsize={FILE_SIZE}", "--core=0", "--"]  # fmt: skip
        words += [_tool("env"), "-i", f"--chdir={place / 'home'}", "PATH=/usr/bin:/bin", f"HOME={place / 'home'}",
                  f"TMPDIR={place / 'home'}", "LANG=C.UTF-8", "PYTHONHASHSEED=0",
                  f"PYTHONPATH={place / 'inside'}:{place / 'packages'}", *threads]  # fmt: skip
        return [*words, os.path.realpath(sys.executable), "-S", "-s", "-B", str(place / "inside" / "worker.py"),
                str(self.submission), str(self.kit)]  # fmt: skip


class OtherUserStudent(SandboxedStudent):
    """A submission that runs as another user.  `close` ends everything that this user has started."""

    jail: OtherUser

    def __init__(self, jail: Jail) -> None:
        if os.geteuid() != 0:
            raise SandboxError("only root can run submissions as another user")
        super().__init__(OtherUser(jail.submission, jail.kit, jail.slot, jail.cpu))

    def close(self) -> None:
        end_all_of(self.jail.user)
        super().close()


def processes_of(user: int) -> list[int]:
    """What a user has running; a process can hide its owner from `ls`, but not from its status."""
    found = []
    for entry in os.listdir("/proc"):
        if entry.isdigit():
            with suppress(OSError, ValueError, IndexError, KeyError):
                lines = dict(line.split(":", 1) for line in Path("/proc", entry, "status").read_text().splitlines())
                if str(user) in lines["Uid"].split() and lines["State"].split()[0] not in "ZX":
                    found.append(int(entry))
    return found


def end_all_of(user: int) -> None:
    """End every process of a user of ours.  All are stopped first, until none is new: what is stopped cannot fork."""
    if user < FIRST_USER:
        raise ValueError(f"user must be one of ours, {FIRST_USER} or above; got {user}")
    stopped: set[int] = set()
    deadline = time.monotonic() + PATIENCE
    while found := processes_of(user):
        new = set(found) - stopped
        for process in new or found:
            with suppress(ProcessLookupError):
                os.kill(process, signal.SIGSTOP if new else signal.SIGKILL)
        stopped |= new
        time.sleep(0.002)
        if time.monotonic() > deadline:
            raise SandboxError(f"processes of user {user} could not be ended")


def check_other_user(closed: Sequence[Path]) -> None:
    """Prove that a submission run as another user is held as said above, or raise SandboxError.

    closed: what it must not be able to read.
    """
    failed = []
    student = OtherUserStudent(Jail(PROBE, INSIDE, slot=os.getpid() % 4096))
    tried = (
        ("a fork burst is stopped", ("processes", 2 * PROCESSES), lambda count: count < PROCESSES),
        ("8 GB are refused", ("memory", 8.0), lambda given: given is False),
        ("the course and the results cannot be read", ("readable", [str(path) for path in closed]), lambda r: r == []),
        ("the user has no rights", ("user",), lambda found: _powerless(found, student.jail.user)),
        ("what it leaves running is there until it is ended", ("stays",), lambda process: process > 0),
    )
    with student:
        for statement, call, holds in tried:
            try:
                with student.item(20.0):
                    passed = holds(student.call(*call))
            except (StudentError, StudentReply, StudentTimeout) as error:
                passed, statement = False, f"{statement} ({error})"
            if not passed:
                failed.append(statement)
    if left := processes_of(student.jail.user):
        failed.append(f"nothing is left running ({len(left)} processes are)")
    if failed:
        raise SandboxError(f"another user is not held as it must be, so nothing is graded; not so: {'; '.join(failed)}")


def _powerless(found: tuple[object, ...], expected: int) -> bool:
    real, effective, *capabilities, no_new_privileges = found
    return real == effective == expected and no_new_privileges == "1" and all(
        int(str(value), 16) == 0 for value in capabilities
    )  # fmt: skip


__all__ = ["OtherUser", "OtherUserStudent", "check_other_user", "end_all_of", "processes_of"]
