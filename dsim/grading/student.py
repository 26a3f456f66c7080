"""A submission as checks see it: functions that are called with values and give values, or fail in stated ways."""

from __future__ import annotations

import importlib.util
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
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
    """

    def __init__(self, path: Path, kit: Path) -> None:
        self.path, self.kit = Path(path), Path(kit)
        self._module: ModuleType | None = None
        self._kit: ModuleType | None = None

    @contextmanager
    def item(self, timeout: float) -> Iterator[None]:
        """One graded item: the submission is loaded anew."""
        self.awarded, self._module, self._kit = 0.0, None, None
        with _importing(self.kit):
            yield

    def call(self, function: str, *arguments: Any) -> Any:
        try:
            module = self._load()
            chosen = getattr(module, function, None)
            if not callable(chosen):
                raise StudentError("NameError", f"{function} is not defined")
            given = _through(list(arguments))
            value = chosen(*(self._resolved(argument) for argument in given))
        except (StudentError, KeyboardInterrupt):
            raise
        except BaseException as error:  # SystemExit too
            raise StudentError(type(error).__name__, str(error)[:600], self._line(error)) from None
        try:
            return _through(value)
        except ProtocolError as error:
            raise StudentReply(str(error)) from None

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
