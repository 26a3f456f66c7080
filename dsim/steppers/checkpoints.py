"""Which states to keep when not all of them fit, and which steps to take again on the way back.

Binomial checkpointing (Griewank and Walther, "Algorithm 799: Revolve", 2000): with s states stored at a time, the
initial one among them, and no step taken more than r times, a run may have at most C(s+r, s) steps.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import comb
from typing import Literal, NamedTuple

from dsim.arrays.checks import as_count


class Action(NamedTuple):
    """advance: take the steps n, ..., until - 1.  snapshot, restore, forget: the state n.  finish: take the last step,
    n, and keep the state before it current.  pull: carry a gradient back over the step n, from the current state."""

    kind: Literal["advance", "snapshot", "restore", "forget", "finish", "pull"]
    n: int
    until: int = 0


@dataclass(frozen=True)
class Checkpoints:
    """Keep at most `snapshots` states, the initial one included, and take steps again on the way back.

    One is enough, but then every step is taken again for each step after it.  For `simulate(..., keep=...)`.

    >>> Checkpoints(10).advances(1001), Checkpoints(10).most(1001)
    (3641, 4)
    """

    snapshots: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "snapshots", as_count("snapshots", self.snapshots, least=1))

    def advances(self, steps: int) -> int:
        """Steps taken by the run and the way back together: r N - C(s+r, r-1) by Griewank and Walther, which leaves
        out the last step of the run; the run has to take that one too, to know where it ends."""
        if not steps:
            return 0
        r = self.most(steps)
        return r * steps - comb(self.snapshots + r, r - 1) + 1 if r else 1

    def most(self, steps: int) -> int:
        """How many times the step that is taken most is taken: the least r with N <= C(s+r, s); at least once."""
        r = 0
        while comb(self.snapshots + r, r) < steps:
            r += 1
        return max(r, 1) if steps else 0

    def stored(self, steps: int) -> int:
        """The most states stored at a time."""
        return min(self.snapshots, max(steps, 1))

    def schedule(self, steps: int) -> Iterator[Action]:
        """Every action in order: the run, up to "finish", then the way back."""
        tasks: list[Action | _Range] = [_Range(0, as_count("steps", steps), self.snapshots, last=True)]
        yield Action("snapshot", 0)
        while tasks:
            task = tasks.pop()
            if isinstance(task, Action):
                yield task
            elif task.first < task.end:
                tasks.extend(reversed(_parts(task)))


class _Range(NamedTuple):
    """To do: pull back the steps first, ..., end - 1; the state `first` is stored and current.

    snapshots: how many states may be stored, that one included.  last: these are the last steps of the run.
    """

    first: int
    end: int
    snapshots: int
    last: bool = False


def _parts(task: _Range) -> list[Action | _Range]:
    """One range as actions and smaller ranges: the later part with one snapshot less, then the earlier part."""
    first, end, snapshots, last = task
    pull: list[Action | _Range] = [Action("pull", end - 1)]
    if last:
        pull.insert(0, Action("finish", end - 1))
    if end - first == 1:
        return pull
    if snapshots == 1:
        pull.insert(0, Action("advance", first, end - 1))
        return [*pull, Action("restore", first), _Range(first, end - 1, 1)]
    middle = first + _split(end - first, snapshots)
    later = _Range(middle, end, snapshots - 1, last)
    earlier = _Range(first, middle, snapshots)
    there, back = Action("advance", first, middle), Action("restore", first)
    return [there, Action("snapshot", middle), later, Action("forget", middle), back, earlier]


def _split(steps: int, snapshots: int) -> int:
    """Steps before the next snapshot, such that neither part needs more repetitions than it may."""
    r = Checkpoints(snapshots).most(steps)
    earlier = comb(snapshots + r - 2, snapshots) if r >= 2 else 0
    return max(1, earlier, steps - comb(snapshots - 1 + r, r))
