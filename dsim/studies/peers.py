"""Other people's simulators on one cloth, as written: each its own program, sharing nothing but these arrays."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dsim.arrays.checks import Array
from dsim.effects import Drag, Gravity, Springs
from dsim.gradients.objectives import Variables
from dsim.steppers import RK4, SymplecticEuler
from dsim.studies.verdicts.physics import Truth, fine_truth
from dsim.studies.verdicts.simulator import Method, Simulator
from dsim.system import System

Problem = dict[str, Any]
Make = Callable[[Problem], tuple[Callable[[Array, Array], Any], Callable[[Array, Array], Any]]]


@dataclass(frozen=True)
class Peer:
    """A program in tests/peers/ and the package it needs."""

    name: str
    file: str
    package: str

    @property
    def installed(self) -> bool:
        return importlib.util.find_spec(self.package) is not None


PEERS = (
    Peer("JAX", "jax_cloth.py", "jax"),
    Peer("Taichi", "taichi_cloth.py", "taichi"),
    Peer("Warp", "warp_cloth.py", "warp"),
    Peer("HIPS autograd", "autograd_cloth.py", "autograd"),
)


def cloth_problem(n: int = 4, steps: int = 20, stiffness: float = 500.0, h: float = 1e-3) -> Problem:
    """The cloth as arrays, so that every simulator can take them.

    n x n points of 0.01 kg, springs along the threads and both diagonals, gravity, drag, one edge pinned; slightly
    disturbed, so that nothing is symmetric.  pairs (E,2), rest (E,) m, stiffness (E,) N/m, mass kg, gravity (3,),
    drag kg/s, free (N,) 0 at pinned points, q0 and v0 (N,3), h s, steps, weights (2,N,3): the objective is
    weights[0] . q + weights[1] . v at the end.  The method is symplectic Euler: v += h f(q, v)/m, then q += h v.
    """
    rng = np.random.default_rng(n)
    index = np.arange(n * n).reshape(n, n)
    lines = [(index[:, :-1], index[:, 1:]), (index[:-1], index[1:]), (index[:-1, :-1], index[1:, 1:])]
    lines.append((index[1:, :-1], index[:-1, 1:]))
    pairs = np.concatenate([np.stack([a.ravel(), b.ravel()], axis=1) for a, b in lines])
    grid = np.stack(np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n), indexing="ij"), axis=-1)
    q0 = np.concatenate([grid.reshape(-1, 2), np.zeros((n * n, 1))], axis=1)
    rest = np.linalg.norm(q0[pairs[:, 1]] - q0[pairs[:, 0]], axis=1)
    q0 = q0 + 1e-3 * rng.normal(size=q0.shape) / n
    free = np.ones(n * n)
    free[index[0]] = 0.0
    return {
        "n": n,
        "pairs": pairs,
        "rest": rest,
        "stiffness": stiffness * rng.uniform(0.8, 1.2, len(pairs)),
        "mass": 0.01,
        "gravity": np.array([0.0, 0.0, -9.81]),
        "drag": 1e-3,
        "free": free,
        "q0": q0,
        "v0": 0.1 * rng.normal(size=q0.shape),
        "h": h,
        "steps": steps,
        "weights": rng.normal(size=(2, *q0.shape)),
    }


def system_of(problem: Problem) -> System:
    """The same cloth for dsim."""
    effects = (
        Gravity(problem["gravity"]),
        Drag(problem["drag"]),
        Springs(problem["pairs"], problem["rest"], problem["stiffness"]),
    )
    mass = np.full(len(problem["q0"]), problem["mass"])
    return System(mass, effects, fixed=np.flatnonzero(problem["free"] == 0))


def state_of(problem: Problem) -> Array:
    """y0 = [q, v]."""
    return np.concatenate([problem["q0"].ravel(), problem["v0"].ravel()])


def of_program(name: str, make: Make, problem: Problem) -> Simulator:
    """A program as a `Simulator` with the blocks "stiffness" and "v0".

    make: problem -> (forward, gradient), each of (stiffness (E,), v0 (N,3)): the last (q, v), and d(objective)/d(both).
    It is called again for every other h, number of steps and objective, which many programs compile in.
    """
    made: dict[tuple[int, float, bytes], tuple[Any, Any]] = {}
    springs, shape = len(problem["stiffness"]), problem["v0"].shape

    def program(steps: int, h: float, w: Array) -> tuple[Any, Any]:
        key = steps, h, w.tobytes()
        if key not in made:
            answer = make(problem | {"steps": steps, "h": h, "weights": w.reshape(2, *shape)})
            if not (isinstance(answer, tuple) and len(answer) == 2 and all(callable(part) for part in answer)):
                raise ValueError(f"make must return (forward, gradient), two callables; {name} gave {answer!r:.60}")
            made[key] = answer
        return made[key]

    def parts(x: Array) -> tuple[Array, Array]:
        return x[:springs], x[springs:].reshape(shape)

    def simulate(x: Array, steps: int, h: float) -> Any:
        known = [value for key, value in made.items() if key[:2] == (steps, h)]
        forward = known[0][0] if known else program(steps, h, problem["weights"].ravel())[0]
        y = np.concatenate([np.asarray(part).ravel() for part in forward(*parts(x))])
        if y.size != 2 * problem["v0"].size:
            raise ValueError(f"forward must return the last (q, v), each of shape {shape}; got {y.size} numbers")
        return y

    def gradient(x: Array, steps: int, h: float, w: Array) -> Array:
        answer = program(steps, h, w)[1](*parts(x))
        return np.concatenate([np.asarray(part, dtype=float).ravel() for part in answer])

    x = np.concatenate([problem["stiffness"], problem["v0"].ravel()])
    places = {"stiffness": slice(0, springs), "v0": slice(springs, None)}
    return Simulator(name, x, simulate, gradient, problem["h"], problem["steps"], places)


def twin(problem: Problem) -> Simulator:
    """dsim on the same cloth with the same method."""
    method = Method(SymplecticEuler(), _variables(problem))
    count = len(problem["stiffness"])
    blocks = {"stiffness": slice(0, count), "v0": slice(count, None)}
    x = method.variables.start
    return Simulator("dsim", x, method.simulate, method.gradient, problem["h"], problem["steps"], blocks)


def cloth_truth(problem: Problem, steps: int = 1000) -> Truth:
    """The physics of the cloth: RK4 with h so small that halving it again changes 1e-9 of the gradient."""
    return fine_truth(Method(RK4(), _variables(problem)), steps)


def _variables(problem: Problem) -> Variables:
    return Variables(system_of(problem), state_of(problem), ["springs.stiffness", "velocities"])


@dataclass(frozen=True)
class Agreement:
    """How far a program's states and gradient are from dsim's, relative; allowed: 1e4 roundings of its precision."""

    state: float
    gradient: float
    allowed: float

    @property
    def ok(self) -> bool:
        return self.state <= self.allowed and self.gradient <= self.allowed


def agreement(simulator: Simulator, other: Simulator) -> Agreement:
    """Of two programs that should be the same function: the last state, and the gradient in every block."""
    w = simulator.weights()
    y, expected = simulator.state(simulator.x), other.state(other.x)
    state = float(np.abs(y - expected).max() / np.abs(expected).max())
    gradient, right = simulator.pulled(w), other.pulled(w)
    gaps = [np.abs(gradient[p] - right[p]).max() / (np.abs(right[p]).max() or 1.0) for p in simulator.blocks.values()]
    return Agreement(state, float(max(gaps)), 1e4 * float(np.finfo(y.dtype).eps))


def load(path: Path) -> Make:
    """The `make` of a file.  Raises ValueError where it cannot be run or has none."""
    from dsim.studies.foreign import load_function

    make: Make = load_function(f"{path}:make")
    return make
