"""A submission as checks see it: functions that are called with values and give values, or fail in stated ways."""

from __future__ import annotations

import ast
import importlib.util
import signal
import sys
import threading
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from difflib import get_close_matches
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol

from dsim.grading.curves import Picture
from dsim.grading.inside.protocol import KitFunction, ProtocolError, decode, encode, kit_function, read_raw

__all__ = [
    "ItemLost",
    "KitFunction",
    "LocalStudent",
    "Student",
    "StudentError",
    "StudentReply",
    "StudentTimeout",
    "kit_function",
]


class StudentError(Exception):
    """Their code raised: kind, message and line in their file (0 if unknown)."""

    def __init__(self, kind: str, message: str, line: int = 0) -> None:
        told = f"{kind}: {message}" if message.strip() else kind
        super().__init__(told + (f" (line {line} of your file)" if line else ""))
        self.kind, self.message, self.line = kind, message, line


class StudentTimeout(Exception):
    """Their code took longer than the item allows."""


class StudentReply(Exception):
    """Their code gave something that is no value, or ended its process."""


class ItemLost(AssertionError):
    """What an item found wrong, in words; the error and the tolerance it broke; a picture where one helps."""

    def __init__(
        self,
        message: str,
        error: float | None = None,
        tolerance: float | None = None,
        picture: Picture | None = None,
    ) -> None:
        super().__init__(message)
        self.error, self.tolerance, self.picture = error, tolerance, picture


class Student(Protocol):
    """What a check may do."""

    def call(self, function: str, *arguments: Any) -> Any:
        """The value of a function of theirs.  Raises StudentError, StudentTimeout or StudentReply."""
        ...

    def award(self, fraction: float) -> None:
        """Grant so much of the item, 0 to 1, whatever fails later."""
        ...


class _Alarm(BaseException):
    """Their time is over."""


class Awards:
    """The largest fraction granted in the current item."""

    awarded = 0.0

    def award(self, fraction: float) -> None:
        if not 0 <= fraction <= 1:
            raise ValueError(f"fraction must be from 0 to 1; got {fraction}")
        self.awarded = max(self.awarded, float(fraction))


class LocalStudent(Awards):
    """A submission in this process, unprotected: for the student's own check, and for tests of assignments.

    Values pass through the same protocol as from the sandbox, so that what is refused there is refused here.
    patience: so many times an item's limit may pass in their code, where the system can interrupt it.
    changed: names of functions that changed the arrays they were given.
    """

    def __init__(self, path: Path, kit: Path, patience: float = 5.0) -> None:
        self.path, self.kit, self.patience = Path(path), Path(kit), patience
        self.changed: set[str] = set()
        self._limit = self._left = float("inf")
        self._module: ModuleType | None = None
        self._kit: ModuleType | None = None

    @contextmanager
    def item(self, timeout: float) -> Iterator[None]:
        """One graded item: the submission is loaded anew."""
        self.awarded, self._module, self._kit = 0.0, None, None
        self._limit = self._left = self.patience * timeout
        with _importing(self.kit):
            yield

    def call(self, function: str, *arguments: Any) -> Any:
        given = _through(list(arguments))
        try:
            with self._clock():
                module = self._load()
                chosen = getattr(module, function, None)
                if not callable(chosen):
                    raise StudentError("NameError", f"{function} is not defined{self._near(function)}")
                value = chosen(*(self._resolved(argument) for argument in given))
        except (StudentError, KeyboardInterrupt):
            raise
        except _Alarm:
            raise StudentTimeout(
                f"{function} is not done after {self._limit:g} s: is there a loop without end?"
            ) from None
        except BaseException as error:  # SystemExit too
            near = self._near(error.name) if isinstance(error, NameError) and error.name else ""
            raise StudentError(type(error).__name__, str(error)[:600] + near, self._line(error)) from None
        if encode("value", given) != encode("value", list(arguments)):
            self.changed.add(function)
        try:
            return _through(value)
        except ProtocolError as error:
            raise StudentReply(str(error)) from None

    @contextmanager
    def _clock(self) -> Iterator[None]:
        """Their code may take what is left of the item's time; without limit where no alarm can be set."""
        if (
            self._left == float("inf")
            or not hasattr(signal, "setitimer")
            or threading.current_thread() is not threading.main_thread()
        ):
            yield
            return

        def ring(*arguments: object) -> None:
            raise _Alarm

        start, before = time.monotonic(), signal.signal(signal.SIGALRM, ring)
        signal.setitimer(signal.ITIMER_REAL, max(self._left, 1e-3), 1.0)  # again, if the first is caught
        try:
            yield
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, before)
            self._left -= time.monotonic() - start

    def _near(self, name: str) -> str:
        """A name of the file that may have been meant."""
        with suppress(SyntaxError, OSError, ValueError):
            tree = ast.parse(self.path.read_text(encoding="utf-8"))
            names = [part.name for part in ast.walk(tree) if isinstance(part, ast.FunctionDef)]
            if found := get_close_matches(name, [other for other in names if other != name], 1, 0.8):
                return f"; did you mean {found[0]}?"
        return ""

    def _load(self) -> ModuleType:
        if self._module is None:
            self._module = _module("submission", self.path)
        return self._module

    def _resolved(self, argument: Any) -> Any:
        if isinstance(argument, KitFunction):
            if self._kit is None:
                self._kit = _module("kit", self.kit / "kit.py")
            return getattr(self._kit, argument.name)(**argument.numbers)
        if isinstance(argument, list | tuple):
            return type(argument)(self._resolved(entry) for entry in argument)
        return argument

    def _line(self, error: BaseException) -> int:
        lines = [f.lineno for f in traceback.extract_tb(error.__traceback__) if f.filename == str(self.path)]
        return int((lines or [getattr(error, "lineno", 0)])[-1] or 0)


def _through(value: Any) -> Any:
    """The value as it comes out at the other end of the pipe."""
    frame = memoryview(encode("value", value))
    place = [0]

    def take(size: int) -> bytes:
        place[0] += size
        return bytes(frame[place[0] - size : place[0]])

    return decode(*read_raw(take))[1]


def _module(name: str, path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@contextmanager
def _importing(kit: Path) -> Iterator[None]:
    """`import kit` finds this assignment's."""
    before = sys.modules.pop("kit", None)
    sys.path.insert(0, str(kit))
    try:
        yield
    finally:
        sys.path.remove(str(kit))
        sys.modules.pop("kit", None)
        if before is not None:
            sys.modules["kit"] = before
