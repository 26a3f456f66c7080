"""The sandbox: bubblewrap, an unprivileged user, limits, and nothing of this machine but Python, NumPy and SciPy.

A grade is made outside; only values come out (`inside.protocol`).  Where bubblewrap is absent, or the sandbox does not
hold what it must, grading refuses.
"""

from __future__ import annotations

import os
import select
import shutil
import signal
import site
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from dsim.grading import seccomp
from dsim.grading.inside import protocol
from dsim.grading.scratch import scratch
from dsim.grading.student import Awards, StudentError, StudentReply, StudentTimeout

INSIDE = Path(__file__).parent / "inside"
USER = 61000  # and the slots above it: nobody's
GRACE = 2.0  # s beyond an item's own limit before the whole sandbox is ended
START = 30.0  # s to load NumPy and SciPy
LOADS = 2  # items for which a file that is too slow to load is tried
MOST_NOTES = 2**14  # bytes of what a submission prints that are kept
MEMORY, PROCESSES, FILES, FILE_SIZE, TEMPORARY = 2 * 2**30, 64, 64, 2**24, 2**26
RESIDENT = 3 * 2**30  # bytes of all processes of a sandbox together


class SandboxError(RuntimeError):
    """There is no sandbox here, or it does not hold."""


@dataclass(frozen=True)
class Jail:
    """What lies in the sandbox: a submission (a file) and a directory with kit.py.  slot: which user runs it."""

    submission: Path
    kit: Path
    slot: int = 0
    cpu: int = 600  # s of processor time of any process
    inside: Path = INSIDE

    def staged(self, directory: Path) -> Jail:
        """Copies that anybody may read, however closed a checkout is: the submission, kit.py alone, and our side."""
        files = {"submission.py": self.submission, "kit/kit.py": self.kit / "kit.py"}
        files |= {f"inside/{path.name}": path for path in self.inside.glob("*.py")}
        for folder in ("kit", "inside"):
            (directory / folder).mkdir()
            (directory / folder).chmod(0o755)
        for name, source in files.items():
            if source.is_file():
                (directory / name).write_bytes(source.read_bytes())
                (directory / name).chmod(0o644)
        submission, kit, inside = (directory / name for name in ("submission.py", "kit", "inside"))
        return replace(self, submission=submission, kit=kit, inside=inside)

    def command(self) -> list[str]:
        """The whole command line."""
        root = os.geteuid() == 0
        python = Path(os.path.realpath(sys.executable))
        words = [_tool("bwrap"), "--die-with-parent", "--new-session", "--clearenv", "--cap-drop", "ALL"]
        if root:  # bubblewrap may read what it mounts; what it starts becomes another user before it does anything
            words += ["--unshare-ipc", "--unshare-pid", "--unshare-net", "--unshare-uts", "--unshare-cgroup-try"]
            words += ["--cap-add", "CAP_SETUID", "--cap-add", "CAP_SETGID", "--cap-add", "CAP_SETPCAP"]
        else:
            words += ["--unshare-all"]
        for directory in ("/sandbox", "/sandbox/packages"):
            words += ["--perms", "0755", "--dir", directory]
        words += [*_system_mounts(), *_python_mounts(), "--proc", "/proc", "--dev", "/dev"]
        words += ["--size", str(TEMPORARY), "--perms", "1777", "--tmpfs", "/tmp"]
        words += ["--ro-bind", str(self.inside), "/sandbox/inside", "--ro-bind", str(self.kit), "/sandbox/kit"]
        words += ["--ro-bind", str(self.submission), "/sandbox/submission.py", "--chdir", "/tmp"]
        words += _closed(words)
        for name, value in _variables().items():
            words += ["--setenv", name, value]
        words += ["--"]
        if root:
            user = str(USER + self.slot)
            words += [_tool("setpriv"), "--reuid", user, "--regid", user, "--clear-groups", "--bounding-set", "-all",
                      "--inh-caps", "-all", "--no-new-privs", "--"]  # fmt: skip
        words += [_tool("prlimit"), f"--as={MEMORY}", f"--nproc={PROCESSES}", f"--cpu={self.cpu}",
                  f"--nofile={FILES}", f"--fsize={FILE_SIZE}", "--core=0", "--"]  # fmt: skip
        return [*words, str(python), "-S", "-s", "-B", "/sandbox/inside/worker.py", "/sandbox/submission.py",
                "/sandbox/kit"]  # fmt: skip


def _tool(name: str) -> str:
    path = shutil.which(name)
    if path is None:
        package = {"bwrap": "bubblewrap"}.get(name, "util-linux")
        raise SandboxError(
            f"grading needs {name}: apt-get install {package} (or --unsandboxed, which trusts the submissions)"
        )
    return path


def _system_mounts() -> list[str]:
    words = ["--ro-bind", "/usr", "/usr"]
    for name in ("lib", "lib64", "lib32", "bin", "sbin"):
        path = Path("/", name)
        if path.is_symlink():
            words += ["--symlink", os.readlink(path), str(path)]
        elif path.is_dir():
            words += ["--ro-bind", str(path), str(path)]
    return [*words, "--ro-bind-try", "/etc/ld.so.cache", "/etc/ld.so.cache", *_hidden(["/usr/local", "/usr/src"])]


def _python_mounts() -> list[str]:
    """The interpreter, without what is installed in it; NumPy and SciPy beside it."""
    import numpy
    import scipy

    base, words = Path(sys.base_prefix).resolve(), list[str]()
    if not base.is_relative_to("/usr") or base.is_relative_to("/usr/local"):
        for parent in reversed(base.parents[:-1]):  # /root of this machine may be closed to others; this one is not
            words += ["--perms", "0755", "--dir", str(parent)]
        words += ["--ro-bind", str(base), str(base)]
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    packages = {*site.getsitepackages([str(base)]), f"{base}/lib/{version}/dist-packages", "/usr/lib/python3"}
    words += _hidden(sorted(path for path in packages if Path(path).resolve().is_relative_to(base) or "/usr" in path))
    for module in (numpy, scipy):
        home = Path(str(module.__file__)).parent
        for part in (home, home.with_name(f"{home.name}.libs")):
            if part.is_dir():
                words += ["--ro-bind", str(part), f"/sandbox/packages/{part.name}"]
    return words


def _closed(words: Sequence[str]) -> list[str]:
    """Every mount of bubblewrap's own but /tmp becomes read-only: an ordinary user would own it."""
    made = [place for flag, place in pairwise(words) if flag == "--tmpfs" and place != "/tmp"]
    return [word for place in (*made, "/dev", "/") for word in ("--remount-ro", place)]


def _hidden(paths: Sequence[str]) -> list[str]:
    """Empty directories in their place."""
    found = []
    for path in paths:
        if Path(path).is_dir():
            found += ["--perms", "0555", "--tmpfs", path]
    return found


def _variables() -> dict[str, str]:
    threads = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    return {"PATH": "/usr/bin:/bin", "HOME": "/tmp", "LANG": "C.UTF-8", "PYTHONHASHSEED": "0",
            "PYTHONPATH": "/sandbox/inside:/sandbox/packages", **threads}  # fmt: skip


class SandboxedStudent(Awards):
    """A submission in its sandbox.  One sandbox a submission, one child an item; `close` ends everything."""

    def __init__(self, jail: Jail) -> None:
        self.jail = jail
        self._process: subprocess.Popen[bytes] | None = None
        self._watch: _Watch | None = None
        self._staged = ExitStack()
        self._notes = b""
        self._left = 0.0  # s that the sandbox may still take for the current item
        self._slow_loads = 0
        self._over: StudentTimeout | StudentReply | None = None  # how the current item's child ended

    @property
    def notes(self) -> str:
        """The end of what the submission printed."""
        return self._notes.decode(errors="replace")

    @contextmanager
    def item(self, timeout: float) -> Iterator[None]:
        """One graded item in a fresh child.  Raises as `call` does when the submission cannot be loaded.

        A file that was too slow to load for `LOADS` items is not tried again.
        """
        self.awarded, self._left, self._over = 0.0, timeout + GRACE, None
        if self._slow_loads >= LOADS:
            raise StudentTimeout("your file takes too long to load: it was tried for the items before this one")
        try:
            self._open(timeout)
            yield
        finally:
            if self._process is not None:
                with suppress(StudentTimeout, StudentReply):
                    self._ask("close", None)

    def _open(self, timeout: float) -> None:
        try:
            _raise_for(*self._ask("open", {"timeout": float(timeout)}))
        except StudentTimeout:
            self._slow_loads += 1
            raise StudentTimeout(f"your file takes too long to load; allowed are {timeout:g} s") from None

    def call(self, function: str, *arguments: Any) -> Any:
        if self._over is not None:  # hypothesis tries a failing input again
            raise self._over
        kind, value = self._ask("call", [function, list(arguments)])
        _raise_for(kind, value)
        return value

    def close(self) -> None:
        """End the sandbox: with its first process all others die."""
        process, self._process = self._process, None
        if process is not None:
            with suppress(ProcessLookupError):
                process.send_signal(signal.SIGKILL)
            process.wait()
            for stream in (process.stdin, process.stdout):
                with suppress(OSError):
                    stream.close()  # type: ignore[union-attr]
        if self._watch is not None:
            self._watch.stop()
            self._watch = None
        self._staged.close()

    def __enter__(self) -> SandboxedStudent:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _start(self) -> subprocess.Popen[bytes]:
        jail = self.jail.staged(self._staged.enter_context(scratch("grade")))
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        with _filtered(jail.command()) as (words, kept):
            process = subprocess.Popen(words, bufsize=0, start_new_session=True, pass_fds=kept, **pipes)  # type: ignore[call-overload]
        self._process = process
        self._watch = _Watch(process, self)
        try:
            kind, _ = self._read(time.monotonic() + START)
        except (StudentTimeout, StudentReply):
            self.close()
            raise SandboxError(f"the sandbox did not start: {self.notes.strip()[-300:] or 'no message'}") from None
        if kind != "ready":
            raise SandboxError(f"the sandbox did not start: it said {kind!r:.40}")
        return process

    def _ask(self, kind: str, value: Any) -> tuple[str, Any]:
        process = self._process or self._start()
        frame = protocol.encode(kind, value)
        start = time.monotonic()
        try:
            _write(process.stdin.fileno(), frame, start + self._left)  # type: ignore[union-attr]
            reply = self._read(start + self._left)
            self._left -= time.monotonic() - start  # all calls together: who speaks for the supervisor gains no time
            return reply
        except (StudentTimeout, StudentReply) as error:
            self._over = error
        except OSError:
            self._over = StudentReply("your code ended its process")
        self.close()  # the next item gets a new sandbox
        raise self._over from None

    def _read(self, deadline: float) -> tuple[str, Any]:
        assert self._process is not None and self._process.stdout is not None
        descriptor = self._process.stdout.fileno()
        try:
            return protocol.read(lambda size: _take(descriptor, size, deadline))
        except protocol.ProtocolError as error:
            raise StudentReply(f"a reply that is no value: {error}") from None


@contextmanager
def _filtered(words: list[str]) -> Iterator[tuple[list[str], tuple[int, ...]]]:
    """The command line with the filter of system calls, and the descriptor that it comes from."""
    program = seccomp.program()
    if Path(words[0]).name != "bwrap" or not program:
        yield words, ()
        return
    ours, theirs = os.pipe()
    try:
        os.write(theirs, program)
        os.close(theirs)
        yield [words[0], "--seccomp", str(ours), *words[1:]], (ours,)
    finally:
        os.close(ours)


class _Watch:
    """Keeps the end of what is printed, and ends a sandbox whose processes hold too much memory together."""

    def __init__(self, process: subprocess.Popen[bytes], student: SandboxedStudent) -> None:
        self._process, self._student, self._over = process, student, threading.Event()
        self._threads = [threading.Thread(target=run, daemon=True) for run in (self._printed, self._memory)]
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        self._over.set()
        for thread in self._threads:
            thread.join()
        self._process.stderr.close()  # type: ignore[union-attr]

    def _printed(self) -> None:
        stream = self._process.stderr
        assert stream is not None
        while part := os.read(stream.fileno(), 2**16):
            self._student._notes = (self._student._notes + part)[-MOST_NOTES:]

    def _memory(self) -> None:
        while not self._over.wait(0.2):
            if _resident(self._process.pid) > RESIDENT:
                with suppress(ProcessLookupError):
                    self._process.send_signal(signal.SIGKILL)


def _resident(ancestor: int) -> int:
    """Bytes of memory that a process and its descendants hold."""
    parents, sizes = {}, {}
    page = os.sysconf("SC_PAGESIZE")
    for entry in os.listdir("/proc"):
        if entry.isdigit():
            with suppress(OSError, ValueError, IndexError):
                fields = Path("/proc", entry, "stat").read_text().rpartition(")")[2].split()
                parents[int(entry)], sizes[int(entry)] = int(fields[1]), int(fields[21]) * page
    total = 0
    for pid, size in sizes.items():
        up = pid
        while up not in (0, 1, ancestor):
            up = parents.get(up, 0)
        total += size if up == ancestor else 0
    return total


def _take(descriptor: int, size: int, deadline: float) -> bytes:
    parts, missing = [], size
    while missing:
        left = deadline - time.monotonic()
        if left <= 0 or not select.select([descriptor], [], [], left)[0]:
            raise StudentTimeout("your code took too long")
        part = os.read(descriptor, min(missing, 2**20))
        if not part:
            raise StudentReply("your code ended its process")
        parts.append(part)
        missing -= len(part)
    return b"".join(parts)


def _write(descriptor: int, frame: bytes, deadline: float) -> None:
    view = memoryview(frame)
    while view:
        left = deadline - time.monotonic()
        if left <= 0 or not select.select([], [descriptor], [], left)[1]:
            raise StudentTimeout("your code took too long")
        view = view[os.write(descriptor, view[: 2**12]) :]


def _raise_for(kind: str, value: Any) -> None:
    """The exception that a reply stands for, if it is one."""
    if kind in ("opened", "value", "closed"):
        return
    if kind == "ended":
        if value == "timeout":
            raise StudentTimeout("your code took too long")
        raise StudentReply(f"your code ended its process ({value!s:.40})")
    if kind == "error" and isinstance(value, dict) and {"type", "message", "line"} <= value.keys():
        line = value["line"] if isinstance(value["line"], int) else 0
        raise StudentError(str(value["type"])[:80], str(value["message"])[:600], line)
    raise StudentReply("a reply that is no value")


def check_sandbox() -> None:
    """Prove that the sandbox holds, or raise SandboxError: processes, memory, network, files, user.

    A probe that dies proves nothing; it is sent once more, for processes are counted for a user, and the burst of
    another sandbox may have taken them all.
    """
    failed, died = _unproven()
    if died:
        failed, _ = _unproven()
    if failed:
        raise SandboxError(f"the sandbox does not hold, so nothing is graded; not so: {'; '.join(failed)}")


def _unproven() -> tuple[list[str], bool]:
    """What one probe could not show, and whether all of that is because it died."""
    tried: tuple[tuple[str, tuple[Any, ...], Callable[[Any], bool]], ...] = (
        ("a fork burst is stopped", ("processes", 2 * PROCESSES), lambda count: count < PROCESSES),
        ("8 GB are refused", ("memory", 8.0), lambda given: given is False),
        ("memory of no process is refused", ("homeless_memory",), lambda given: given == []),
        ("there is no network", ("network",), lambda reached: reached is False),
        ("no file can be made outside /tmp", ("writable",), lambda places: places == []),
        ("dsim is not there", ("visible", "dsim"), lambda places: places == []),
        ("the user has no rights", ("user",), _powerless),
    )
    failed, refuted = [], False
    with SandboxedStudent(Jail(INSIDE / "probe.py", INSIDE)) as probe:
        for statement, call, holds in tried:
            try:
                with probe.item(20.0):
                    if not holds(probe.call(*call)):
                        failed.append(statement)
                        refuted = True
            except (StudentError, StudentReply, StudentTimeout) as error:
                failed.append(f"{statement} ({error})")
    return failed, bool(failed) and not refuted


def _powerless(user: Any) -> bool:
    real, effective, *capabilities, no_new_privileges = user
    own = os.geteuid() != 0
    return real == effective and (own or real >= USER) and no_new_privileges == "1" and all(
        int(value, 16) == 0 for value in capabilities[:2]
    )  # fmt: skip
