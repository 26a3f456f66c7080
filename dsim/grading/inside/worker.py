"""Runs in the sandbox: a supervisor that has numpy and what it needs of scipy loaded, and a child for each graded item.

Started as `python worker.py SUBMISSION KIT_DIRECTORY`.  The grader speaks to it by frames on stdin and stdout:

    open {"timeout": s}   a fresh child loads the submission    -> opened | error | ended
    call [name, args]     the child calls the function          -> value | error | ended
    close                 the child is ended                    -> closed

What student code prints goes to stderr.  The supervisor hands on complete frames only, so a child that is killed in
the middle of a sentence confuses nobody.  It is as little trusted as the child: its replies are values.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import select
import signal
import sys
import time
import traceback
from types import ModuleType
from typing import Any

import numpy  # noqa: F401  loaded once, before any child
import protocol

MOST_TEXT = 600
PARTS = ("linalg", "optimize", "sparse", "sparse.linalg", "integrate", "special", "spatial", "interpolate")  # of scipy


def main() -> None:
    """The supervisor's loop: one frame from the grader at a time."""
    submission, kit = sys.argv[1:3]
    sys.path.insert(0, kit)
    preload(submission, os.path.join(kit, "kit.py"))
    requests, replies = os.dup(0), os.dup(1)
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, 0)
    os.dup2(2, 1)
    write(replies, protocol.encode("ready"))
    child: Child | None = None
    while True:
        try:
            header, body = protocol.read_raw(lambda n: take(requests, n))
        except EOFError:
            break
        kind = protocol.kind_of(header)
        if kind == "open":
            if child is not None:
                child.end()
            timeout = protocol.decode(header, body)[1]["timeout"]
            child = Child(submission, (requests, replies), float(timeout))
            write(replies, child.reply())
        elif kind == "close" or child is None:
            if child is not None:
                child.end()
            child = None
            write(replies, protocol.encode("closed" if kind == "close" else "ended", "no item is open"))
        else:
            write(replies, child.ask(header, body))


def preload(submission: str, kit: str) -> None:
    """Import the parts of SciPy that either file names, and the kit, once for all items; an error shows later."""
    with contextlib.suppress(Exception):
        with open(submission, encoding="utf-8") as one, open(kit, encoding="utf-8") as other:
            text = one.read() + other.read()
        if "scipy" in text:
            for part in PARTS:
                if all(word in text for word in part.split(".")):
                    importlib.import_module(f"scipy.{part}")
        importlib.import_module("kit")


class Child:
    """A process that has loaded the submission, in a session of its own."""

    def __init__(self, submission: str, others: tuple[int, int], timeout: float) -> None:
        ours, theirs = os.pipe(), os.pipe()
        self.left = timeout  # s of its own time; what the grader takes between calls does not count
        self.ended = ""
        self.pid = os.fork()
        if self.pid == 0:
            for descriptor in (*others, ours[1], theirs[0]):
                os.close(descriptor)
            try:
                serve(submission, ours[0], theirs[1])
            finally:
                os._exit(1)
        os.close(ours[0])
        os.close(theirs[1])
        self.requests, self.replies = ours[1], theirs[0]

    def ask(self, header: bytes, body: bytes) -> bytes:
        """The reply to one frame, or why there is none."""
        if self.ended:
            return protocol.encode("ended", self.ended)
        try:
            frame = protocol.LENGTHS.pack(len(header), len(body)) + header + body
            write(self.requests, frame, time.monotonic() + self.left)
        except TimeoutError:
            return self._over("timeout")
        except OSError:
            return self._over("crash")
        return self.reply()

    def reply(self) -> bytes:
        """The next complete frame of the child."""
        start = time.monotonic()
        deadline = start + self.left
        try:
            header, body = protocol.read_raw(lambda n: take(self.replies, n, deadline))
            self.left -= time.monotonic() - start
            return protocol.LENGTHS.pack(len(header), len(body)) + header + body
        except TimeoutError:
            return self._over("timeout")
        except (EOFError, OSError):
            return self._over("crash")
        except protocol.ProtocolError:
            return self._over("malformed reply")

    def _over(self, why: str) -> bytes:
        self.end()
        self.ended = why
        return protocol.encode("ended", why)

    def end(self) -> None:
        """Kill the child and what it started in its session."""
        if self.pid:
            for kill in (os.killpg, os.kill):
                with contextlib.suppress(ProcessLookupError, PermissionError):
                    kill(self.pid, signal.SIGKILL)
            with contextlib.suppress(ChildProcessError):
                os.waitpid(self.pid, 0)
            os.close(self.requests)
            os.close(self.replies)
            self.pid = 0
        with contextlib.suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass


def serve(submission: str, requests: int, replies: int) -> None:
    """The child: load the submission, answer calls."""
    os.setsid()
    # Lines go out at once: this process is killed, never ended, and what it holds back would be lost.
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    module = ModuleType("submission")
    module.__file__ = submission
    sys.modules["submission"] = module
    try:
        with open(submission, "rb") as file:
            exec(compile(file.read(), submission, "exec"), module.__dict__)
        write(replies, protocol.encode("opened"))
    except BaseException as error:
        write(replies, failure(error, submission))
    while True:
        kind, value = protocol.read(lambda n: take(requests, n))
        if kind == "call":
            write(replies, answer(module, submission, value))


def answer(module: ModuleType, submission: str, value: Any) -> bytes:
    """The frame that a call gives."""
    name, arguments = value
    function = getattr(module, name, None)
    if not callable(function):
        return protocol.encode("error", {"type": "NameError", "message": f"{name} is not defined", "line": 0})
    try:
        return protocol.encode("value", function(*(resolved(argument) for argument in arguments)))
    except BaseException as error:
        return failure(error, submission)


def resolved(argument: Any) -> Any:
    """Functions of the kit in place of their names."""
    if isinstance(argument, protocol.KitFunction):
        import kit

        return getattr(kit, argument.name)(**argument.numbers)
    if isinstance(argument, list | tuple):
        return type(argument)(resolved(entry) for entry in argument)
    return argument


def failure(error: BaseException, submission: str) -> bytes:
    """Type, message and line of an exception, cut to a decent length; nothing in it is trusted."""
    try:
        message = str(error)[:MOST_TEXT]
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == submission]
        line = int((lines or [getattr(error, "lineno", 0)])[-1] or 0)
        return protocol.encode("error", {"type": type(error).__name__[:80], "message": message, "line": line})
    except BaseException:
        return protocol.encode("error", {"type": "Exception", "message": "an error that cannot be told", "line": 0})


def take(descriptor: int, size: int, deadline: float | None = None) -> bytes:
    """Exactly so many bytes; EOFError at the end, TimeoutError at the deadline (time.monotonic)."""
    parts, missing = [], size
    while missing:
        if deadline is not None:
            left = deadline - time.monotonic()
            if left <= 0 or not select.select([descriptor], [], [], left)[0]:
                raise TimeoutError
        part = os.read(descriptor, min(missing, 2**16))
        if not part:
            raise EOFError
        parts.append(part)
        missing -= len(part)
    return b"".join(parts)


def write(descriptor: int, frame: bytes, deadline: float | None = None) -> None:
    """All of it; TimeoutError at the deadline."""
    view = memoryview(frame)
    while view:
        if deadline is not None:
            left = deadline - time.monotonic()
            if left <= 0 or not select.select([], [descriptor], [], left)[1]:
                raise TimeoutError
        view = view[os.write(descriptor, view[: 2**12]) :]


if __name__ == "__main__":
    main()
