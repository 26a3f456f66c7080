"""Other people's programs as functions: a Python file, or any executable that reads and writes a small file."""

from __future__ import annotations

import importlib.util
import json
import shlex
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Any

import numpy as np

from dsim.arrays.checks import Array, as_array

FORMATS = ("npz", "json")


def read_point(text: str) -> Array:
    """x from a `.npy` file, the key x (or the only key) of an `.npz`, a JSON file with a list, or "0.1,0.2"."""
    path = Path(text)
    if path.suffix.lower() not in (".npy", ".npz", ".json"):
        try:
            return np.array([float(part) for part in text.split(",")])
        except ValueError:
            raise ValueError(
                f"--at must be a .npy, .npz or .json file, or numbers like 0.1,0.2; got {text!r}"
            ) from None
    if not path.is_file():
        raise FileNotFoundError(f"--at must be a file; there is none at {path}")
    try:
        if path.suffix.lower() == ".json":
            data = json.loads(path.read_text())
            return np.array(data["x"] if isinstance(data, dict) else data, dtype=float)
        loaded = np.load(path, allow_pickle=False)
        if path.suffix.lower() == ".npz":
            loaded = loaded["x"] if "x" in loaded.files or len(loaded.files) != 1 else loaded[loaded.files[0]]
        if not np.issubdtype(loaded.dtype, np.number):
            raise TypeError(f"an array of {loaded.dtype}")
        return np.asarray(loaded)
    except (ValueError, KeyError, TypeError, OSError, EOFError) as error:
        raise ValueError(f"--at must hold an array x; {path} does not ({error})") from error


def load_function(text: str) -> Callable[..., Any]:
    """FUNCTION of "FILE.py:FUNCTION", with errors inside it told as one line with its place."""
    file, colon, name = text.rpartition(":")
    if not colon or not file.endswith(".py"):
        raise ValueError(f"the function must be given as FILE.py:FUNCTION; got {text!r}")
    path = Path(file).resolve()
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {file}")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.path.insert(0, str(path.parent))
    try:
        with redirect_stdout(sys.stderr):
            spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise ValueError(f"{file} could not be run: {_told(error, path)}") from error
    function = getattr(module, name, None)
    if function is None or not callable(function):
        known = [n for n, v in vars(module).items() if callable(v) and not n.startswith("_")]
        raise ValueError(f"{file} has no function {name!r}; it has {', '.join(known) or 'none'}")

    told_function = told(function, name, path)

    @wraps(function)
    def called(*x: Any) -> Any:
        answer = told_function(*x)
        if isinstance(answer, list):
            raise ValueError(f"{name} must return the tuple (value, gradient); got a list")
        return answer

    return called


def told(function: Callable[..., Any], name: str, path: Path) -> Callable[..., Any]:
    """function, with an error inside it told as one line with its place in the file, and its prints sent to stderr."""

    @wraps(function)
    def called(*x: Any) -> Any:
        try:
            with redirect_stdout(sys.stderr):  # what it prints must not mix with the verdict
                return function(*x)
        except (Exception, SystemExit) as error:
            raise ValueError(f"{name} raised {_told(error, path)}") from error

    return called


def _told(error: BaseException, path: Path) -> str:
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
    if isinstance(error, SyntaxError):
        lines = [error.lineno]
    place = f" (line {lines[-1]} of {path.name})" if lines else ""
    return f"{type(error).__name__}: {error}{place}"


@dataclass(frozen=True)
class Program:
    """An executable as a function x -> (value, gradient).

    It is started as `PROGRAM INPUT OUTPUT`, reads x from INPUT, and writes value and gradient to OUTPUT, both in a
    temporary directory: NPZ arrays or JSON keys of these names.  With `batch`, x is (B,n) and value (B,),
    gradient (B,n).  Raises ValueError for a failure, a time-out or an answer that cannot be read.
    """

    command: str
    format: str = "npz"
    batch: bool = False
    timeout: float = 60.0

    def __post_init__(self) -> None:
        if self.format not in FORMATS:
            raise ValueError(f"--format must be one of {', '.join(FORMATS)}; got {self.format!r}")
        try:
            words = shlex.split(self.command)
        except ValueError as error:  # a quote that is not closed
            raise ValueError(f"--exec must be a command line; got {self.command!r} ({error})") from error
        if not words:
            raise ValueError("--exec must name a program; got an empty text")
        if not 0 < self.timeout <= 1e6:
            raise ValueError(f"--timeout must be > 0 and at most 1e6 seconds; got {self.timeout}")

    def __call__(self, x: Array) -> tuple[float, Array]:
        answer = self._run(x[None] if self.batch else x)
        value, gradient = (self._field(answer, name) for name in ("value", "gradient"))
        expected = (1, *x.shape) if self.batch else x.shape
        if gradient.size != x.size:
            wanted = f"shape {expected} for a batch" if self.batch else f"the shape of x, {expected}"
            raise ValueError(f"gradient must have {wanted}; {self.command} wrote {gradient.shape}")
        return float(as_array("value", value.reshape(-1), (1,))[0]), gradient.reshape(x.shape)

    def many(self, points: Sequence[Array]) -> list[float]:
        """Values only, in one call where the program takes batches."""
        if not self.batch:
            return [self(x)[0] for x in points]
        value = self._field(self._run(np.stack(points)), "value")
        if value.shape != (len(points),):
            raise ValueError(f"value must have shape ({len(points)},) for a batch; {self.command} wrote {value.shape}")
        return [float(v) for v in value]

    def _run(self, x: Array) -> dict[str, Any]:
        with tempfile.TemporaryDirectory(prefix="dsim-check-") as directory:
            source, target = (Path(directory) / f"{name}.{self.format}" for name in ("input", "output"))
            if self.format == "npz":
                np.savez(source, x=x)
            else:
                source.write_text(json.dumps({"x": x.tolist()}))
            self._start([*self._argv(), str(source), str(target)])
            return self._read(target)

    def _argv(self) -> list[str]:
        first, *rest = shlex.split(self.command)
        return [str(Path(first).resolve()) if Path(first).is_file() else first, *rest]

    def _start(self, argv: list[str]) -> None:
        try:
            done = subprocess.run(
                argv, capture_output=True, timeout=self.timeout, stdin=subprocess.DEVNULL, check=False
            )
        except (FileNotFoundError, PermissionError) as error:
            raise ValueError(f"--exec must be a program that can be started; {self.command!r}: {error}") from error
        except OSError as error:
            raise ValueError(f"--exec could not be started: {error} (a script needs its #! line)") from error
        except subprocess.TimeoutExpired:
            raise ValueError(f"{self.command} took more than {self.timeout:g} s (--timeout)") from None
        if done.returncode:
            tail = done.stderr.decode(errors="replace").strip().splitlines()[-3:]
            raise ValueError(f"{self.command} ended with code {done.returncode}: {' / '.join(tail) or 'no message'}")

    def _read(self, target: Path) -> dict[str, Any]:
        if not target.is_file():
            raise ValueError(f"{self.command} wrote no {target.name}; its second argument is the file to write")
        try:
            if self.format == "json":
                answer = json.loads(target.read_text())
                return dict(answer)
            with np.load(target, allow_pickle=False) as data:
                return {name: data[name] for name in data.files}
        except (ValueError, OSError, EOFError, TypeError) as error:
            raise ValueError(f"{self.command} wrote no readable {self.format} file: {error}") from error

    def _field(self, answer: dict[str, Any], name: str) -> Array:
        if name not in answer:
            raise ValueError(f"{self.command} must write value and gradient; it wrote {', '.join(answer) or 'nothing'}")
        try:
            return np.asarray(answer[name], dtype=float)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{name} must be numbers; {self.command} wrote {answer[name]!r:.60}") from error
