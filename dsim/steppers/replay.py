"""Runs that keep a few states only: the first pass, and the way back that takes steps again.

A step is a pure function of (system, t, y0, h), so a step taken again gives the same bits, and so does the gradient.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from dsim.arrays.checks import Array
from dsim.solve.newton import Status
from dsim.steppers.checkpoints import Action, Checkpoints
from dsim.steppers.explicit_run import ExplicitRun, Pullback
from dsim.steppers.stepper import Counters, Ode, Step, Stepper


class Back(Protocol):
    """A gradient on its way back."""

    def add(self, load: Array) -> None: ...
    def step(self, n: int, state: Array, after: Array) -> None: ...
    def result(self) -> tuple[Array, Array]: ...


class Replay(Protocol):
    """A run that can be continued from any state, in a form of its own."""

    def start(self, y0: Array) -> tuple[Array, Status, Counters]: ...
    def step(self, n: int, state: Array) -> tuple[Array, Status, Counters]: ...
    def public(self, state: Array) -> Array: ...
    def back(self) -> Back: ...


@dataclass(frozen=True, eq=False)
class RowReplay:
    """An explicit run on coordinate rows; states are (2,d,N)."""

    run: ExplicitRun

    def start(self, y0: Array) -> tuple[Array, Status, Counters]:
        return self.run.inward(y0), Status.CONVERGED, Counters()

    def step(self, n: int, state: Array) -> tuple[Array, Status, Counters]:
        new = self.run.step(n, state)
        status = Status.CONVERGED if np.isfinite(new).all() else Status.NOT_FINITE
        return new, status, Counters(forces=self.run.stages)

    def public(self, state: Array) -> Array:
        return self.run.outward(state)

    def back(self) -> Back:
        return _RowBack(self.run)


class _RowBack:
    def __init__(self, run: ExplicitRun) -> None:
        self._run, self._pullback = run, Pullback(run)

    def add(self, load: Array) -> None:
        self._pullback.add(self._run.rows_of(load))

    def step(self, n: int, state: Array, after: Array) -> None:
        self._pullback.step(n, state)

    def result(self) -> tuple[Array, Array]:
        return self._pullback.result()


@dataclass(frozen=True, eq=False)
class StepReplay:
    """Any stepper; states are (history ny,)."""

    stepper: Stepper
    system: Ode
    h: float

    def start(self, y0: Array) -> tuple[Array, Status, Counters]:
        step = self.stepper.start(self.system, 0.0, y0, self.h)
        return step.y1, step.status, step.counters

    def step(self, n: int, state: Array) -> tuple[Array, Status, Counters]:
        with np.errstate(over="ignore", invalid="ignore"):
            step = self.stepper.step(self.system, n * self.h, state, self.h)
        return step.y1, step.status, step.counters

    def public(self, state: Array) -> Array:
        return state[: self.system.size]

    def back(self) -> Back:
        return _StepBack(self)


class _StepBack:
    def __init__(self, replay: StepReplay) -> None:
        self._replay = replay
        system = replay.system
        self._mu = np.zeros(replay.stepper.history * system.size)
        self._theta_bar = np.zeros(system.parameter_count)
        self._first: Array | None = None

    def add(self, load: Array) -> None:
        self._mu[: len(load)] += load

    def step(self, n: int, state: Array, after: Array) -> None:
        r = self._replay
        self._first = state
        linearization = r.stepper.linearize(r.system, Step(n * r.h, r.h, state, after))
        self._mu = linearization.pullback(self._mu, self._theta_bar)

    def result(self) -> tuple[Array, Array]:
        r = self._replay
        if r.stepper.history > 1 and self._first is not None:
            start = r.stepper.start(r.system, 0.0, self._first[: r.system.size], r.h)
            return r.stepper.linearize(r.system, start).pullback(self._mu, self._theta_bar), self._theta_bar
        return self._mu[: r.system.size], self._theta_bar


@dataclass(eq=False)
class Snapshots:
    """What a run with `Checkpoints` keeps: some states, the last one and the one before it."""

    checkpoints: Checkpoints
    replay: Replay
    y0: Array
    held: dict[int, Array] = field(default_factory=dict)
    current: Array = field(default_factory=lambda: np.empty(0))
    last: Array = field(default_factory=lambda: np.empty(0))
    done: int = 0  # steps completed
    status: Status = Status.CONVERGED
    counters: Counters = Counters()
    planned: int = 0  # steps asked for

    @property
    def nbytes(self) -> int:
        """Of the states kept."""
        return int(sum(state.nbytes for state in self.held.values()) + self.current.nbytes + self.last.nbytes)

    @property
    def public_last(self) -> Array:
        """The last state (ny,)."""
        return self.replay.public(self.last) if self.done else self.y0

    def forward(self, steps: int) -> Snapshots:
        """The run itself, up to the last step or to one that fails."""
        self.planned = steps
        state, self.status, self.counters = self.replay.start(self.y0)
        self.current = self.last = state
        for action in self.checkpoints.schedule(steps):
            if self.status is not Status.CONVERGED:
                break
            if action.kind == "snapshot":
                self.held[action.n] = self.current
            else:  # advance or finish: the run holds nothing else
                self._take(action)
            if action.kind == "finish":
                break
        return self

    def _take(self, action: Action) -> None:
        for n in range(action.n, max(action.until, action.n + 1)):
            state, self.status, cost = self.replay.step(n, self.last)
            self.counters += cost
            if self.status is not Status.CONVERGED:
                return
            self.last, self.done = state, n + 1
            if action.kind == "advance":
                self.current = state

    def backward(self, load: Callable[[int, Array], Array | None]) -> tuple[Array, Array, int]:
        """(dJ/dy0 without the load of y_0, dJ/dtheta, steps taken again); load: (n, y_n) -> dJ/dy_n or None."""
        if self.done < self.planned:  # of a run that failed: its states lie where those of a longer run would
            whole = Snapshots(self.checkpoints, self.replay, self.y0).forward(self.done)
            by_start, by_theta, again = whole.backward(load)
            return by_start, by_theta, again + self.done
        way_back = self.checkpoints.schedule(self.done)
        next((action for action in way_back if action.kind == "finish"), None)  # the run has been made
        back, again = self.replay.back(), 0
        held, state, after = dict(self.held), self.current, self.last
        for action in way_back:
            if action.kind == "snapshot" and action.n:
                held[action.n] = state
            elif action.kind == "restore":
                state = held[action.n]
            elif action.kind == "forget":
                del held[action.n]
            elif action.kind == "advance":
                for n in range(action.n, action.until):
                    state = self.replay.step(n, state)[0]
                again += action.until - action.n
            elif action.kind == "pull":
                if (bar := load(action.n + 1, self.replay.public(after))) is not None:
                    back.add(bar)
                back.step(action.n, state, after)
                after = state
        return *back.result(), again
