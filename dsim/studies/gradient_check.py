"""Is this gradient right?  A verdict on any function of arrays, with the figures behind it.

One step size is not a verdict: truncation rules at large steps, round-off at small ones, and a branch that flips in
between fools whoever looks at a single one.  So differences are taken on both sides of x over a sweep of
steps, extrapolated (Ridders 1982), and every extrapolation carries its own error estimate.  The gradient is judged
against the best estimate *and its error*, entry by entry.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from dsim.arrays.checks import Array, as_count, as_positive
from dsim.studies.foreign_arrays import like, to_numpy

Verdict = Literal["smooth", "kink", "jump", "noise", "wrong"]

_LEVELS = 5  # extrapolations beyond this gain nothing but amplified round-off
_TRUST = 10.0  # an error estimate may be off by this factor
_DETECTABLE = 1e-4  # a derivative known worse than this, because of noise, supports no verdict

ADVICE = {
    "smooth": "The gradient is the derivative of this function.  Of a simulation, ask next whether it converges to the "
    "physics' as h -> 0: `dsim audit`.",
    "wrong": "Look at the worst entry first: a missing term, a sign, a factor 2, a stale state, a projected hessian.",
    "kink": "Both one-sided derivatives exist and differ: move x off the kink, smooth it, or accept a subgradient.",
    "jump": "The function itself jumps at x: no gradient describes it.  Resolve the event, or smooth it.",
    "noise": "No step gives a steady difference: tighten solver tolerances, fix seeds, or compute in higher precision.",
}


@dataclass(frozen=True, eq=False)
class Estimate:
    """Derivatives along D directions: value (D,), error estimate (D,), and the window of steps each rests on."""

    value: Array
    error: Array
    coarsest: Array
    finest: Array


@dataclass(frozen=True, eq=False)
class GradientReport:
    """What `check_gradient` found.

    digits: decimal digits to which gradient and differences agree, in the worst entry.  window: smallest and
    largest step of the differences that decided there.  numerical: the derivative by differences, for each
    direction looked at.  given: the gradient's, or None.
    """

    verdict: Verdict
    digits: float
    window: tuple[float, float]
    worst: str  # the entry or direction that decided
    note: str
    numerical: Array
    error: Array
    given: Array | None
    labels: tuple[str, ...]
    verdicts: tuple[Verdict, ...]
    coverage: str
    evaluations: int
    steps: Array = field(repr=False)  # (D,K) of the sweep
    central: Array = field(repr=False)  # (D,K) central differences
    worst_index: int = 0

    @property
    def ok(self) -> bool:
        """True when the verdict is smooth."""
        return self.verdict == "smooth"

    @property
    def advice(self) -> str:
        """What to do next."""
        if self.given is None and self.ok:
            return "Smooth here; no gradient was given, so none was judged."
        return ADVICE[self.verdict]

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and text, for JSON."""
        i = self.worst_index
        return {
            "verdict": self.verdict,
            "ok": self.ok,
            "digits": round(self.digits, 2),
            "worst": {
                "entry": self.worst,
                "given": None if self.given is None else _finite(self.given[i]),
                "numerical": _finite(self.numerical[i]),
                "error": _finite(self.error[i]),
            },
            "window": [float(w) for w in self.window],
            "counts": {kind: self.verdicts.count(kind) for kind in ADVICE},
            "coverage": self.coverage,
            "evaluations": self.evaluations,
            "note": self.note,
            "advice": self.advice,
        }

    def __str__(self) -> str:
        i, given = self.worst_index, "none"
        if self.given is not None:
            given = f"{self.given[i] + 0.0:.12g}"  # + 0.0 makes -0 a 0
        lines = [
            f"verdict   {self.verdict}" + (f", {self.digits:.1f} digits" if self.ok else ""),
            f"worst     {self.worst}: given {given}",
            f"          differences {self.numerical[i] + 0.0:.12g} +- {self.error[i]:.1e}",
            f"window    steps {self.window[0]:.1e} to {self.window[1]:.1e}",
            f"looked at {self.coverage}, {self.evaluations} evaluations",
        ]
        lines += [_wrapped("note", self.note)] if self.note else []
        return "\n".join([*lines, _wrapped("next", self.advice)])


def _wrapped(label: str, text: str) -> str:
    """One labelled paragraph of a report, in 80 columns."""
    return textwrap.fill(text, 80, initial_indent=f"{label:10s}", subsequent_indent=" " * 10)


def check_gradient(
    f: Callable[[Any], Any],
    x: Any,
    gradient: Any = None,
    *,
    rtol: float | None = None,
    entries: int = 1024,
    seed: int = 0,
) -> GradientReport:
    """Judge `gradient` as the derivative of f at x.

    f: callable on arrays like x, returning a number or (number, gradient); it gets a copy.  x: any shape, NumPy's
    or another library's.  gradient: same shape as x, else the one that f returns, else only f is judged.

    Steps are swept from 1e-3 down to 1e-10 of max(1, |x_i|), both sides; where all |x| < 1 the sweep goes on
    down to 1e-10 max |x|, so that tiny scales are seen.  In single precision it runs from 7e-2 to 2e-5.
    An entry that is tiny beside others, and whose differences do not settle, is swept again, down to 1e-10 |x_i|.
    An entry is wrong when it differs from the differences by more than rtol (1e-6; 5e-4 in single precision) of
    its own size plus ten times their error estimate.  Up to `entries` entries are looked at one by one; beyond that
    half of them are the largest, half random, and eight random sign vectors look at all the others together.

    Verdicts: smooth; kink (one-sided derivatives differ), jump (f is discontinuous), noise (nothing steady to
    compare with), wrong.  The worst one found is the report's, wrong before jump, kink and noise.
    Raises ValueError for an f that cannot be called, an x or f(x) that is not finite, entries that are no whole
    number >= 1, and for shapes that do not match.

    >>> report = check_gradient(lambda x: float(x @ x), np.array([1.0, 2.0]), np.array([2.0, 4.0]))
    >>> report.verdict, report.digits > 8
    ('smooth', True)
    """
    problem = _Function(f, x)
    if gradient is None:
        gradient = problem.gradient
    given = None if gradient is None else _as_gradient(gradient, problem.x.shape)
    eps = problem.eps
    tolerance = float(as_positive("rtol", rtol, ())) if rtol is not None else max(1e-6, 20 * eps ** (2 / 3))
    directions, labels, coverage = _directions(problem.x.ravel(), given, as_count("entries", entries, 1), seed)
    sweep = _settled(problem, directions, tolerance)
    claimed = None if given is None else np.array([d.dot(given) for d in directions])
    return _judge(sweep, claimed, labels, coverage, tolerance)


class _Function:
    """f with its values as floats, x as NumPy, and a count of the calls."""

    def __init__(self, f: Callable[[Any], Any], x: Any) -> None:
        if not callable(f):
            raise ValueError(f"f must be callable, x -> number or (number, gradient); got {f!r:.60}")
        self.x = to_numpy("x", x)
        dtype = self.x.dtype if np.issubdtype(self.x.dtype, np.floating) else np.dtype(float)
        self.x = self.x.astype(dtype)
        if not self.x.size:
            raise ValueError("x must have at least one entry; got an empty array")
        if not np.isfinite(self.x).all():
            raise ValueError(f"x must be finite; got {self.x[~np.isfinite(self.x)][0]}")
        self._f, self._like, self.evaluations = f, like(x), 0
        value, self.gradient, value_dtype = self._call(self.x)
        if not np.isfinite(value):
            raise ValueError(f"f(x) must be finite; got {value}")
        self.value = value
        single = np.float32 in (dtype.type, value_dtype.type) or np.float16 in (dtype.type, value_dtype.type)
        self.eps = float(np.finfo(np.float32 if single else np.float64).eps)

    def _call(self, x: Array) -> tuple[float, Any, Any]:
        self.evaluations += 1
        with np.errstate(all="ignore"):
            answer = self._f(self._like(x))
        gradient = None
        if isinstance(answer, list) and len(answer) != 1:
            raise ValueError("f must return a number or the tuple (number, gradient); got a list")
        if isinstance(answer, tuple):
            if len(answer) != 2:
                raise ValueError(f"f must return a number or (number, gradient); got a tuple of {len(answer)}")
            answer, gradient = answer
        value = to_numpy("f(x)", answer)
        if value.size != 1:
            raise ValueError(f"f must return one number; got shape {value.shape} (use check_jacobian)")
        return float(value.reshape(())), gradient, value.dtype

    def __call__(self, x: Array) -> float:
        return self._call(x)[0]

    def many(self, points: list[Array]) -> list[float]:
        """Values at many points: by the `many` of f itself, where it has one."""
        if hasattr(self._f, "many"):
            self.evaluations += len(points)
            return [float(value) for value in self._f.many(points)]
        return [self(x) for x in points]


@dataclass(frozen=True)
class _Direction:
    """One entry (index, sign None) or a vector of signs over all entries."""

    index: int
    signs: Array | None = None

    def dot(self, gradient: Array) -> float:
        flat = gradient.ravel()
        return float(flat[self.index] if self.signs is None else self.signs @ flat)

    def move(self, x: Array, step: float) -> tuple[Array, float]:
        """x + step d, and the step really taken after rounding."""
        moved = x.copy()
        flat = moved.reshape(-1)
        if self.signs is None:
            flat[self.index] += step
            return moved, float(flat[self.index]) - float(x.reshape(-1)[self.index])
        flat += (step * self.signs).astype(x.dtype)
        return moved, step


def _directions(
    x: Array, given: Array | None, entries: int, seed: int
) -> tuple[list[_Direction], tuple[str, ...], str]:
    n = x.size
    if n <= entries:
        return [_Direction(i) for i in range(n)], tuple(f"entry {i}" for i in range(n)), f"all {n} entries"
    rng = np.random.default_rng(seed)
    size = np.abs(given.ravel()) if given is not None else np.abs(x)
    largest = np.argsort(-size, kind="stable")[: entries // 2]
    others = rng.permutation(np.setdiff1d(np.arange(n), largest))[: entries - len(largest)]
    chosen = np.sort(np.concatenate([largest, others])).tolist()
    found = [_Direction(i) for i in chosen] + [_Direction(-1, rng.choice([-1.0, 1.0], n)) for _ in range(8)]
    labels = tuple(f"entry {i}" for i in chosen) + tuple(f"sign vector {i}" for i in range(8))
    return found, labels, f"{len(chosen)} of {n} entries and 8 sign vectors"


class _Sweep:
    """Values of f on both sides of x, D directions times K steps, steps falling; `fine` takes two a decade.

    own: the steps go by |x_i| of each entry, however small it is.
    """

    def __init__(self, f: _Function, directions: list[_Direction], fine: bool, own: bool = False) -> None:
        self.f, x = f, f.x
        self.own = np.full(len(directions), own)
        largest = float(np.abs(x).max())
        least = min(1.0, largest) if largest > 0 else 1.0
        top, bottom = f.eps ** (1 / 6), f.eps ** (2 / 3)
        count = int(np.ceil((2 if fine else 1) * np.log10(top / (bottom * least)))) + 1
        grid = np.geomspace(top, bottom * least, count)
        size = np.array([abs(float(x.ravel()[d.index])) if d.signs is None else 1.0 for d in directions])
        scale = size / least if own else np.maximum(1.0, size)
        shape = (len(directions), count)
        self.ahead, self.behind = np.empty(shape), np.empty(shape)
        self.h_ahead, self.h_behind = np.empty(shape), np.empty(shape)
        for row, direction in enumerate(directions):
            there = [direction.move(x, step) for step in (scale[row] * grid).tolist()]
            back = [direction.move(x, -step) for step in (scale[row] * grid).tolist()]
            values = f.many([moved for moved, _ in there + back])
            self.ahead[row], self.behind[row] = values[:count], values[count:]
            self.h_ahead[row], self.h_behind[row] = [h for _, h in there], [-h for _, h in back]
        with np.errstate(all="ignore"):
            self.right = (self.ahead - f.value) / self.h_ahead
            self.left = (f.value - self.behind) / self.h_behind
            self.steps = (self.h_ahead + self.h_behind) / 2
            self.central = (self.ahead - self.behind) / (2 * self.steps)
            largest_value = np.where(self.finite, np.maximum(np.abs(self.ahead), np.abs(self.behind)), 0.0)
            self.rounding = 2 * f.eps * np.maximum(largest_value, abs(f.value))  # (D,K)
            bend = np.abs(self.ahead - 2 * f.value + self.behind)
        # At the finest steps a smooth f is a line: what is left of its second difference is noise.
        self.bend = np.where(np.isfinite(bend), bend, 0.0)[:, -3:].max(axis=1)
        self.bend = np.maximum(self.bend, self._quantum())
        self.noise = np.maximum(self.rounding, self.bend[:, None])

    def take(self, rows: Any, finer: _Sweep, chosen: Any) -> None:
        """Replace directions `rows` by the `chosen` ones of a sweep of as many steps."""
        for name, values in vars(finer).items():
            if name != "f":
                getattr(self, name)[rows] = values[chosen]

    def _quantum(self) -> float:
        """The height of a stair, where values are rounded to a lower precision than f's own; else 0.

        Told by directions in which the finest steps change nothing at all, coarse ones change both sides in
        several sizes, and even the smallest change is far above round-off.
        """
        found = 0.0
        for row in range(len(self.ahead)):
            gaps = [np.abs(values[row] - self.f.value) for values in (self.ahead, self.behind)]
            sizes = [np.unique(gap[gap > 0]) for gap in gaps]
            if (gaps[0][-3:] + gaps[1][-3:]).any() or min(len(size) for size in sizes) < 3:
                continue
            riser = float(min(size[0] for size in sizes))
            if 8 * self.rounding[row, -1] < riser < np.inf:
                found = riser if found == 0.0 else min(found, riser)
        return found

    @property
    def steepest(self) -> Array:
        """The largest one-sided difference at the three largest steps, per direction (D,)."""
        sides = np.abs(np.stack([self.left, self.right]))[..., :3]
        return np.asarray(np.where(np.isfinite(sides), sides, 0.0).max(axis=(0, 2)))

    @property
    def finite(self) -> Any:
        return np.isfinite(self.ahead) & np.isfinite(self.behind)

    def estimates(self) -> tuple[Estimate, Estimate, Estimate]:
        """The derivative from both sides, from the left and from the right."""
        middle = self.estimate(self.central, self.steps, power=2)
        return middle, self.estimate(self.left, self.h_behind, 1), self.estimate(self.right, self.h_ahead, 1)

    def estimate(self, differences: Array, steps: Array, power: int) -> Estimate:
        """Extrapolate differences whose error expands in h^power; keep, per direction, the best entry of the table."""
        rows = len(differences)
        best, error = np.full(rows, np.nan), np.full(rows, np.inf)
        coarsest, finest = np.zeros(rows), np.zeros(rows)
        table = differences
        with np.errstate(all="ignore"):
            for level in range(min(_LEVELS, differences.shape[1] - 1)):
                if level:
                    ratio = (steps[:, :-level] / steps[:, level:]) ** power
                    step = (table[:, 1:] - table[:, :-1]) / (ratio - 1)
                    change = np.abs(step) + np.abs(table[:, 1:] - table[:, :-1])
                    table = table[:, 1:] + step
                else:
                    change = np.abs(np.diff(table, axis=1, prepend=np.nan))
                slack = self.noise / steps
                round_off = 4 * slack[:, level:] + slack[:, : slack.shape[1] - level]
                doubt = np.where(np.isnan(change), np.inf, change) + round_off
                doubt = np.where(np.isfinite(table), np.maximum(doubt, _contradiction(table, round_off)), np.inf)
                place = doubt.argmin(axis=1)
                least = doubt[np.arange(rows), place]
                for row in np.flatnonzero(least < error):
                    at = place[row]
                    best[row], error[row] = table[row, at], least[row]
                    coarsest[row], finest[row] = steps[row, at], steps[row, at + level]
        return Estimate(best, error, coarsest, finest)


def _settled(f: _Function, directions: list[_Direction], rtol: float) -> _Sweep:
    """A sweep in which entries tiny beside others are judged by steps of their own size, if those settle better."""
    fine = len(directions) <= 64
    sweep = _Sweep(f, directions, fine)
    doubt, slope = _doubt(sweep)
    size = np.array([abs(float(f.x.ravel()[d.index])) if d.signs is None else 0.0 for d in directions])
    tiny = (size > 0) & (size < min(1.0, float(np.abs(f.x).max())))
    changes = ((sweep.ahead != f.value) | (sweep.behind != f.value)).any(axis=1)
    rows = np.flatnonzero(tiny & changes & ~(doubt <= rtol * slope))
    if len(rows):
        finer = _Sweep(f, [directions[row] for row in rows.tolist()], fine, own=True)
        seen = ((finer.ahead != f.value) & (finer.behind != f.value)).mean(axis=1) > 0.5  # or f rounds them away
        better = seen & (_doubt(finer)[0] < doubt[rows])
        sweep.take(rows[better], finer, better)
    return sweep


def _doubt(sweep: _Sweep) -> tuple[Array, Array]:
    """How badly each derivative is known - error estimates, and what the two sides differ by - and its size (D,)."""
    middle, left, right = sweep.estimates()
    doubt = middle.error + left.error + right.error + np.abs(left.value - right.value)
    return np.where(np.isfinite(doubt), doubt, np.inf), np.nan_to_num(
        np.maximum(np.abs(left.value), np.abs(right.value))
    )


def _contradiction(table: Array, round_off: Array) -> Array:
    """How far an entry lies from any entry of finer steps, beyond that one's round-off, (D,K).

    A derivative is a limit: two large steps that happen to agree count for nothing if smaller ones say otherwise.
    """
    worst = np.zeros_like(table)
    for column in range(table.shape[1] - 1):
        gap = np.abs(table[:, column + 1 :] - table[:, column, None]) - _TRUST * round_off[:, column + 1 :]
        worst[:, column] = np.where(np.isfinite(gap), gap, 0.0).max(axis=1)
    return np.maximum(worst, 0.0)


def _judge(sweep: _Sweep, claimed: Array | None, labels: tuple[str, ...], coverage: str, rtol: float) -> GradientReport:
    middle, left, right = sweep.estimates()
    known = np.where(np.isfinite(middle.error), np.abs(np.nan_to_num(middle.value)), 0.0)
    largest = float(max(known.max(), 0.0 if claimed is None else np.abs(np.nan_to_num(claimed)).max()))
    sides = (left, right)
    verdicts = [_verdict(sweep, row, (middle, *sides), claimed, (rtol, largest)) for row in range(len(labels))]
    order: tuple[Verdict, ...] = ("wrong", "jump", "kink", "noise", "smooth")
    verdict = min(verdicts, key=order.index)
    off = _disagreement(sweep, middle, claimed)
    row = max((i for i, v in enumerate(verdicts) if v == verdict), key=lambda i: off[i])
    digits = max(0.0, -float(np.log10(np.clip(off[row], 1e-16, 1.0)))) if verdict == "smooth" else 0.0
    return GradientReport(
        verdict=verdict,
        digits=digits,
        window=(float(middle.finest[row]), float(middle.coarsest[row])),
        worst=labels[row],
        note=_note(sweep, row, middle, verdict) or _too_small(sweep, middle, claimed, verdict),
        numerical=middle.value,
        error=middle.error,
        given=claimed,
        labels=labels,
        verdicts=tuple(verdicts),
        coverage=coverage,
        evaluations=sweep.f.evaluations,
        steps=sweep.steps,
        central=sweep.central,
        worst_index=row,
    )


def _verdict(
    sweep: _Sweep,
    row: int,
    estimates: tuple[Estimate, Estimate, Estimate],
    claimed: Array | None,
    scales: tuple[float, float],
) -> Verdict:
    middle, *sides = estimates
    rtol, largest = scales
    given = None if claimed is None else float(claimed[row])
    if given is not None and not np.isfinite(given):
        return "wrong"
    if _jumps(sweep, row):
        return "jump"
    (left, left_error), (right, right_error) = ((float(s.value[row]), float(s.error[row])) for s in sides)
    slope, doubt = float(middle.value[row]), _TRUST * float(middle.error[row])
    size = max(abs(left), abs(right))
    if abs(left - right) > _TRUST * (left_error + right_error) + 100 * rtol * size:
        low, high = min(left, right) - 100 * rtol * size, max(left, right) + 100 * rtol * size
        return "wrong" if given is not None and not low <= given <= high else "kink"
    if _diverges(sweep, row):
        return "kink"
    noisy = not sweep.bend[row] <= 8 * sweep.rounding[row, -1]
    if not np.isfinite(slope) or (
        noisy and not middle.error[row] <= _DETECTABLE * max(abs(slope), sweep.steepest[row])
    ):
        return "noise"
    if _is_staircase(sweep, row):
        return "noise"
    if given is not None and abs(given - slope) > rtol * max(abs(given), abs(slope)) + doubt:
        return "kink" if _between(given, sides, row) else "wrong"
    if _unknown(sweep, row, middle, given) and max(abs(slope), abs(given or 0.0)) > 1e-6 * largest:
        return "noise"
    return "smooth"


def _between(given: float, sides: list[Estimate], row: int) -> bool:
    """Whether the slopes of the two sides surely differ, however little, and the given one is theirs or between."""
    ends = sorted((float(side.value[row]), _TRUST * float(side.error[row])) for side in sides)
    (low, below), (high, above) = ends
    return high - low > below + above and low - below <= given <= high + above


def _unknown(sweep: _Sweep, row: int, middle: Estimate, given: float | None) -> bool:
    """Whether round-off hides the derivative: its error estimate leaves not even two digits to judge by."""
    flat = (sweep.ahead[row] == sweep.f.value).all() and (sweep.behind[row] == sweep.f.value).all()
    size = max(abs(float(middle.value[row])), abs(given or 0.0), float(sweep.steepest[row]))
    return not flat and bool(_TRUST * middle.error[row] > 1e-2 * size)


def _jumps(sweep: _Sweep, row: int) -> bool:
    """The value next to x, on one side, stays away from f(x) by the same amount however small the step.

    gap(h) = jump + slope h, so two steps give the jump; the slope, however steep, does not hide it.
    """
    last = max(4, min(6, sweep.steps.shape[1] // 2 + 1))  # so many do not agree by chance where f is noise
    for values, steps in ((sweep.ahead, sweep.h_ahead), (sweep.behind, sweep.h_behind)):
        gap, h = values[row, -last:] - sweep.f.value, steps[row, -last:]
        if not np.isfinite(gap[-4:]).all():
            return True
        with np.errstate(all="ignore"):
            jump = (gap[1:] * h[:-1] - gap[:-1] * h[1:]) / (h[:-1] - h[1:])
        typical = np.abs(np.median(jump))
        if typical > 50 * sweep.rounding[row, -1] and np.ptp(jump) < 0.05 * typical:
            return True
    return False


def _is_staircase(sweep: _Sweep, row: int) -> bool:
    """A slope at large steps on both sides, nothing at all at small ones: values rounded to a lower precision."""
    coarse = np.stack([sweep.left[row, :3], sweep.right[row, :3]])
    if not np.isfinite(coarse).all() or (sweep.ahead[row, -3:] != sweep.behind[row, -3:]).any():
        return False
    changes = np.abs(np.concatenate([sweep.ahead[row], sweep.behind[row]]) - sweep.f.value)
    riser = float(changes[changes > 0].min(initial=np.inf))  # the height of a stair
    typical = float(np.abs(coarse).mean())
    return 8 * sweep.rounding[row, -1] < riser < np.inf and float(np.ptp(coarse)) < 0.05 * typical


def _diverges(sweep: _Sweep, row: int) -> bool:
    """One-sided differences that keep growing, steadily, as the step falls: a vertical tangent.

    Not where the values differ by their round-off alone, the same at every step: that grows in the same way.
    """
    for differences, steps in ((sweep.left[row], sweep.h_behind[row]), (sweep.right[row], sweep.h_ahead[row])):
        tail = np.abs(differences[-6:])
        if np.isfinite(tail).all() and (tail * steps[-6:] > 8 * sweep.rounding[row, -1]).all():
            growth = tail[1:] / tail[:-1]
            if (growth > 1.2).all() and np.ptp(growth) < 0.2 * growth.mean():
                return True
    return False


def _disagreement(sweep: _Sweep, middle: Estimate, claimed: Array | None) -> Array:
    """Per direction, |given - measured| (at least the error estimate) relative to the entry; where the entry is too
    small to be known, to the largest entry; where all vanish, to the steepest difference and to f itself."""
    value, error = np.nan_to_num(middle.value), np.where(np.isfinite(middle.error), middle.error, np.inf)
    gap = error if claimed is None else np.fmax(np.abs(np.nan_to_num(claimed, nan=np.inf) - value), error)
    own = np.abs(value) if claimed is None else np.fmax(np.abs(value), np.abs(np.nan_to_num(claimed)))
    known = own > 1e3 * error
    fallback = own[known].max(initial=0.0) or max(float(sweep.steepest.max()), abs(sweep.f.value), np.finfo(float).tiny)
    scale = np.where(known, own, fallback)
    with np.errstate(all="ignore"):
        return np.asarray(gap / scale)


def _note(sweep: _Sweep, row: int, middle: Estimate, verdict: Verdict) -> str:
    if verdict != "smooth":
        return ""
    if sweep.own[row]:
        return "judged by steps of this entry's own size: with larger ones differences do not settle"
    coarse = sweep.steps[row] > 10 * middle.coarsest[row]
    away = np.abs(sweep.central[row] - middle.value[row]) > 0.05 * max(abs(middle.value[row]), 1e-300)
    if (coarse & away).any():
        reach = sweep.steps[row][coarse & away].min()
        return f"differences with steps of {reach:.0e} and more disagree: a kink, a jump or strong bending is that near"
    return ""


def _too_small(sweep: _Sweep, middle: Estimate, claimed: Array | None, verdict: Verdict) -> str:
    given = [None] * len(middle.value) if claimed is None else claimed.tolist()
    count = sum(_unknown(sweep, row, middle, value) for row, value in enumerate(given))
    if verdict != "smooth" or not count:
        return ""
    return f"{count} entries are too small beside the others to be judged"


def _as_gradient(gradient: Any, shape: tuple[int, ...]) -> Array:
    array = to_numpy("gradient", gradient)
    if array.shape != shape:
        raise ValueError(f"gradient must have the shape of x, {shape}; got {array.shape}")
    return np.asarray(array, dtype=float)


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


# Jacobians, adjoints, Taylor remainders


@dataclass(frozen=True, eq=False)
class JacobianReport:
    """One gradient report for every weighting of the outputs that was looked at; `worst` is the worst of them."""

    worst: GradientReport
    weighting: str

    @property
    def ok(self) -> bool:
        return self.worst.ok

    @property
    def verdict(self) -> Verdict:
        return self.worst.verdict

    @property
    def digits(self) -> float:
        return self.worst.digits

    def __str__(self) -> str:
        return f"output    {self.weighting}\n{self.worst}"


def check_jacobian(f: Callable[[Any], Any], x: Any, jacobian: Any, *, seed: int = 0) -> JacobianReport:
    """Judge `jacobian` (m,n), dense, sparse or with `rmatvec`, as df/dx of f: (n,) -> (m,), by `check_gradient`.

    Every output is looked at for m <= 32, else eight random sign weightings of all outputs; f is called once a point.
    """
    if not callable(f):
        raise ValueError(f"f must be callable, x -> (m,); got {f!r:.60}")
    memory: dict[bytes, Array] = {}

    def outputs(z: Any) -> Array:
        key = to_numpy("x", z).tobytes()
        if key not in memory:
            memory[key] = np.asarray(to_numpy("f(x)", f(z)), dtype=float).ravel()
        return memory[key]

    start = to_numpy("x", x)
    m = outputs(like(x)(np.asarray(start, dtype=float))).size
    _check_shape(jacobian, (m, start.size))
    rng = np.random.default_rng(seed)
    weights = np.eye(m) if m <= 32 else rng.choice([-1.0, 1.0], (8, m))
    order = ("wrong", "jump", "kink", "noise", "smooth")
    found = []
    for number, w in enumerate(weights):
        row = np.asarray(_transposed(jacobian, w)).reshape(start.shape)
        report = check_gradient(_weighted(outputs, w), x, row)
        found.append((order.index(report.verdict), report.digits, number, report))
    _, _, number, worst = min(found, key=lambda entry: entry[:3])
    return JacobianReport(worst, f"{number}" if m <= 32 else f"sign weighting {number}")


def _weighted(outputs: Callable[[Any], Array], w: Array) -> Callable[[Any], float]:
    return lambda z: float(w @ outputs(z))


def _transposed(jacobian: Any, w: Array) -> Array:
    if hasattr(jacobian, "rmatvec"):
        return np.asarray(jacobian.rmatvec(w))
    matrix = jacobian if hasattr(jacobian, "tocsr") else to_numpy("jacobian", jacobian)
    return np.asarray(matrix.T @ w, dtype=float)


def _check_shape(jacobian: Any, expected: tuple[int, int]) -> None:
    shape = tuple(getattr(jacobian, "shape", np.shape(jacobian)))
    if shape != expected:
        raise ValueError(f"jacobian must have shape {expected}, outputs times inputs; got {shape}")


@dataclass(frozen=True)
class AdjointReport:
    """<J u, w> and <u, J^T w> for the worst of several random pairs."""

    error: float  # relative to |J u| |w| + |u| |J^T w|
    tolerance: float
    forward: float
    backward: float

    @property
    def ok(self) -> bool:
        return bool(self.error <= self.tolerance)

    def __str__(self) -> str:
        word = "agree" if self.ok else "DISAGREE"
        return (
            f"<J u, w> = {self.forward:.12g} and <u, J^T w> = {self.backward:.12g} {word}: "
            f"relative error {self.error:.1e}, bound {self.tolerance:.0e}"
        )


def check_adjoint(
    tangent: Callable[[Any], Any],
    pullback: Callable[[Any], Any],
    inputs: int | tuple[int, ...],
    outputs: int | tuple[int, ...],
    *,
    tolerance: float = 1e-10,
    seed: int = 0,
) -> AdjointReport:
    """The dot-product test: tangent u -> J u and pullback w -> J^T w belong together iff <J u, w> = <u, J^T w>.

    inputs, outputs: their shapes.  Five random pairs; the worst one is reported.
    """
    rng = np.random.default_rng(seed)
    reports = []
    for _ in range(5):
        u, w = rng.normal(size=inputs), rng.normal(size=outputs)
        forward, backward = to_numpy("tangent(u)", tangent(u)), to_numpy("pullback(w)", pullback(w))
        for name, value, expected in (("tangent(u)", forward, w), ("pullback(w)", backward, u)):
            if value.shape != expected.shape:
                raise ValueError(f"{name} must have shape {expected.shape}; got {value.shape}")
        left, right = float(np.vdot(forward, w)), float(np.vdot(u, backward))
        size = np.linalg.norm(forward) * np.linalg.norm(w) + np.linalg.norm(u) * np.linalg.norm(backward)
        error = abs(left - right) / size if size > 0 else abs(left - right)
        reports.append(AdjointReport(float(error) if np.isfinite(error) else np.inf, tolerance, left, right))
    return max(reports, key=lambda report: report.error)


@dataclass(frozen=True, eq=False)
class TaylorReport:
    """The remainder |f(x + s d) - f(x) - s g.d| over s, and its slope on the finest window above round-off."""

    slope: float
    scales: Array
    remainders: Array
    used: Any  # (K,) the scales that the slope rests on

    @property
    def ok(self) -> bool:
        """Slope 2 - or a remainder that is all round-off, as for a linear function."""
        return bool(self.slope >= 1.9)

    def __str__(self) -> str:
        return f"Taylor remainder slope {self.slope:.2f} on {int(self.used.sum())} scales; 2 is right, 1 is wrong"


def taylor_test(
    f: Callable[[Any], Any], x: Any, gradient: Any, direction: Any = None, *, seed: int = 0
) -> TaylorReport:
    """Slope of the first-order remainder: 2 for the right gradient, 1 for a wrong one, inf if it is all round-off.

    Scales run from 2^-1 to 2^-26 of a direction as long as max(1, |x|) (random, unless given).
    """
    problem = _Function(f, x)
    given = _as_gradient(gradient, problem.x.shape)
    d = np.random.default_rng(seed).normal(size=problem.x.shape) if direction is None else np.asarray(direction, float)
    d = d / np.linalg.norm(d) * max(1.0, float(np.abs(problem.x).max()))
    scales: Array = 2.0 ** -np.arange(1.0, 27.0)
    values = np.array([problem((problem.x + s * d).astype(problem.x.dtype)) for s in scales])
    slope = float(np.vdot(given, d))
    remainders: Array = np.abs(values - problem.value - scales * slope)
    floor = 16 * problem.eps * (np.abs(values) + abs(problem.value) + np.abs(scales * slope))
    above = np.flatnonzero(np.isfinite(remainders) & (remainders > 8 * floor))
    used = np.zeros(len(scales), dtype=bool)
    used[above[-5:]] = True
    if used.sum() < 2:
        return TaylorReport(np.inf, scales, remainders, used)
    fitted = float(np.polyfit(np.log(scales[used]), np.log(remainders[used]), 1)[0])
    return TaylorReport(fitted, scales, remainders, used)
