"""The rubric, a closed list, and the running of its items: on this side of the pipe, inputs drawn from a secret."""

from __future__ import annotations

import hashlib
import importlib.util
import re
import sys
import time
import tomllib
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, Protocol
from unittest.mock import patch

from dsim.grading.curves import Picture
from dsim.grading.inside.protocol import ProtocolError
from dsim.grading.sandbox import SandboxError
from dsim.grading.student import ItemLost, StudentError, StudentReply, StudentTimeout
from dsim.grading.submission import printable

Visibility = Literal["public", "hidden"]
NO_MATHEMATICS = ("NameError", "UnboundLocalError", "AttributeError", "ImportError", "ModuleNotFoundError",
                  "NotImplementedError", "SyntaxError", "SystemExit")  # fmt: skip
DRAWS = 8  # examples of an item that hypothesis drives
WHOLE = 60.0  # s for all items of one submission


@dataclass(frozen=True)
class Item:
    """A row of rubric.toml; its check is `test_ID(student)` in the tests of its visibility."""

    id: str
    title: str
    points: int
    visible: Visibility
    timeout: float
    hint: str


@dataclass(frozen=True)
class Outcome:
    """What one item gave: points, why some were lost ("" where none were), and a picture of it where there is one.

    hinted: the item's hint, which is about its mathematics, may help; not where a name is missing.
    """

    item: Item
    score: float
    why: str = ""
    seconds: float = 0.0
    picture: Picture | None = None
    hinted: bool = True

    @property
    def lost(self) -> bool:
        return self.score < self.item.points


class Gradable(Protocol):
    """A `Student` that items can be run on."""

    awarded: float

    def item(self, timeout: float) -> Any: ...
    def call(self, function: str, *arguments: Any) -> Any: ...


FIELDS: dict[str, Any] = {"id": str, "title": str, "points": int, "visible": str, "timeout": (int, float), "hint": str}


KINDS = {"points": "a whole number", "timeout": "a number of seconds"} | dict.fromkeys(
    ("id", "title", "visible", "hint"), "a text"
)


def rubric(path: Path) -> tuple[Item, ...]:
    """The items of rubric.toml.  Raises ValueError that names the file, the item and the field."""
    try:
        rows = tomllib.loads(path.read_text(encoding="utf-8")).get("item", [])
    except (OSError, tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} must be a TOML file: {error}") from error
    if not rows:
        raise ValueError(f"{path} must hold at least one [[item]]")
    items: list[Item] = []
    for number, row in enumerate(rows, start=1):
        for name, kind in FIELDS.items():
            if not isinstance(row.get(name), kind) or isinstance(row.get(name), bool):
                raise ValueError(
                    f"{path}: {name} of item {number} ({row.get('id')}) must be {KINDS[name]}; got {row.get(name)!r}"
                )
        if unknown := sorted(row.keys() - FIELDS.keys()):
            raise ValueError(f"{path}: item {number} has fields nobody knows: {', '.join(unknown)}")
        for name, good, rule in (
            ("id", re.fullmatch(r"[a-z][a-z0-9_]*", row["id"]), "a word of small letters, digits and _"),
            ("visible", row["visible"] in ("public", "hidden"), '"public" or "hidden"'),
            ("points", row["points"] > 0, "above 0"),
            ("timeout", 0 < row["timeout"] <= WHOLE, f"above 0 and at most {WHOLE:g} s"),
        ):
            if not good:
                raise ValueError(f"{path}: {name} of item {number} ({row['id']}) must be {rule}; got {row[name]!r}")
        items.append(Item(**row))
    if len({item.id for item in items}) < len(items):
        raise ValueError(f"{path}: every id must be there once")
    return tuple(items)


def checks(items: Sequence[Item], tests: Path, secret: bytes) -> dict[str, Callable[..., Any]]:
    """id -> its check, from test_public.py and test_hidden.py, drawing from the secret.

    Raises ValueError for one that is missing or extra.
    """
    modules = {name: _module(f"{tests.parent.name}_{name}", tests / f"test_{name}.py") for name in ("public", "hidden")}
    found = {}
    for item in items:
        check = getattr(modules[item.visible], f"test_{item.id}", None)
        if check is None:
            raise ValueError(f"{tests / f'test_{item.visible}.py'} must define test_{item.id}(student)")
        found[item.id] = prepared(check, seed(secret, item))
    for module in modules.values():
        for name in vars(module):
            if name.startswith("test_") and name.removeprefix("test_") not in found:
                raise ValueError(f"{module.__file__} has {name}, which no item of the rubric names")
    return found


def _module(name: str, path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, path)
    if not path.is_file() or spec is None or spec.loader is None:
        raise ValueError(f"{path} must be there")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def seed(secret: bytes, item: Item) -> int:
    """The same for every submission of a class, known to nobody without the secret."""
    return int.from_bytes(hashlib.sha256(secret + item.id.encode()).digest()[:8], "little")


def run(
    items: Sequence[Item], found: dict[str, Callable[..., Any]], student: Gradable, whole: float = WHOLE
) -> list[Outcome]:
    """Every item in turn.  One that is not reached in time scores 0 and says so."""
    outcomes, start = [], time.monotonic()
    for item in items:
        if time.monotonic() - start > whole:
            outcomes.append(Outcome(item, 0.0, "not reached: all items together took too long"))
        else:
            outcomes.append(run_item(item, found[item.id], student))
    return outcomes


def run_item(item: Item, check: Callable[..., Any], student: Gradable) -> Outcome:
    """One item: full points where the check passes, else the largest part that it awarded."""
    start, why, picture, hinted = time.monotonic(), "", None, True
    try:
        with student.item(item.timeout):
            check(student)
    except (ItemLost, StudentError, StudentTimeout, StudentReply, ProtocolError) as error:
        why, picture = str(error), getattr(error, "picture", None)
        hinted = getattr(error, "kind", "") not in NO_MATHEMATICS
    except AssertionError as error:
        why = str(error) or "what came back is not what was asked for"
    except SandboxError:  # the grader's trouble, not the student's
        raise
    except Exception as error:  # a value that the check was not ready for
        why = f"what came back could not be looked at ({type(error).__name__})"
    seconds = time.monotonic() - start
    if not why:
        return Outcome(item, float(item.points), "", seconds)
    return Outcome(item, round(student.awarded * item.points, 2), one_line(why), seconds, picture, hinted)


def one_line(text: str) -> str:
    """The first line, printable, of decent length: a text may come from a submission."""
    first = next((line for line in text.splitlines() if line.strip()), "no reason was given")
    return printable(first.strip())[:400]


def prepared(check: Callable[..., Any], number: int) -> Callable[[Any], Any]:
    """A check that hypothesis drives: few examples, drawn from `number`, no shrinking, nothing kept on disk."""
    if not hasattr(check, "hypothesis"):
        return check
    import hypothesis

    inner = check.hypothesis.inner_test

    @wraps(inner)
    def afresh(student: Any, *drawn: Any, **named: Any) -> Any:
        """Awards of one draw are not those of another: what is kept is what the failing draw was worth."""
        student.awarded = 0.0
        return inner(student, *drawn, **named)

    check.hypothesis.inner_test = afresh
    quiet = hypothesis.settings(
        max_examples=DRAWS, database=None, deadline=None, print_blob=False, report_multiple_bugs=False,
        phases=(hypothesis.Phase.explicit, hypothesis.Phase.generate),
        suppress_health_check=list(hypothesis.HealthCheck),
    )  # fmt: skip
    seeded = hypothesis.seed(number)(quiet(check))

    def drawn(student: Any) -> Any:
        with _nothing_from_modules():
            return seeded(student)

    return drawn


@contextmanager
def _nothing_from_modules() -> Iterator[None]:
    """Of modules that are no installed package, hypothesis reads the numbers, draws some of them, and keeps them in
    ./.hypothesis.  Inputs would depend on what happens to be imported, a picture's module for one: not for grades.
    """
    providers: Any = sys.modules.get("hypothesis.internal.conjecture.providers")
    with ExitStack() as stack:
        if hasattr(providers, "_get_local_constants") and hasattr(providers, "CONSTANTS_CACHE"):
            nothing, cache = providers.Constants(), type(providers.CONSTANTS_CACHE)(1024)
            stack.enter_context(patch.object(providers, "_get_local_constants", lambda: nothing))
            stack.enter_context(patch.object(providers, "CONSTANTS_CACHE", cache))
        yield
