"""Exported reference problems: derived again from the files alone, by a program that shares nothing with dsim."""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Callable, Iterator
from decimal import Decimal, getcontext
from functools import cache
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from typer.testing import CliRunner

from dsim import catalog
from dsim.cli import app, main
from dsim.studies.answers import export as exporting
from dsim.studies.answers.document import Item

ITEMS = {item.name: item for item in catalog.ANSWERS}
FEW = ("ball-symplectic-euler", "logistic-map", "ball-over-a-wall")
QUICK = ("forward-euler", "symplectic-euler", "velocity-verlet", "rk4")
Numbers = Any
Document = dict[str, Any]


# An independent program.  It reads JSON; x may be complex, so that a step of 1e-30 i gives derivatives to round-off.


def rate(system: Document, n: int, q: Numbers, v: Numbers) -> Numbers:
    """a = f/m (N,d) during step n, term by term as `equations` says."""
    force = np.zeros_like(q)
    for effect in system["effects"].values():
        if effect["type"] == "gravity":
            force = force + np.outer(system["mass"], effect["acceleration"])
        elif effect["type"] == "drag":
            c = np.broadcast_to(effect["coefficient"], len(q))[:, None]
            force = force - c * (v - np.asarray(effect.get("wind", np.zeros(q.shape[1]))))
        elif effect["type"] == "actuation":
            force = force + np.asarray(effect["forces"])[n]
        elif effect["type"] == "sine":
            force = force - effect["strength"] * np.sin(q)
        elif effect["type"] == "inverse_square":
            force = force - effect["strength"] * q / np.sqrt((q**2).sum(axis=1, keepdims=True)) ** 3
        else:
            for spring, (i, j) in enumerate(effect["pairs"]):
                e, u = q[j] - q[i], v[j] - v[i]
                length = np.sqrt((e**2).sum())
                if effect["type"] == "springs":
                    k, rest = np.asarray(effect["stiffness"])[spring], np.asarray(effect["rest_length"])[spring]
                    pull = k * (length - rest) * (e / length if rest or length else e)
                else:
                    pull = np.asarray(effect["coefficient"])[spring] * (u @ e) * e / length**2
                force[i] = force[i] + pull
                force[j] = force[j] - pull
    a = force / np.asarray(system["mass"])[:, None]
    a[system["fixed"]] = 0
    return a


class Program:
    """y -> next y, by the formulas of `method.formula`, written out once more."""

    def __init__(self, document: Document) -> None:
        self.system, self.h = document["system"], document["time"]["h"]
        self.shape = (self.system["points"], self.system["dimension"])
        self.half = int(np.prod(self.shape))
        self.name = document["method"]["name"]

    def a(self, n: int, q: Numbers, v: Numbers) -> Numbers:
        return rate(self.system, n, q.reshape(self.shape), v.reshape(self.shape)).ravel()

    def phi(self, n: int, y: Numbers) -> Numbers:
        q, v = y[: self.half], y[self.half :]
        still = np.repeat(np.isin(np.arange(self.shape[0]), self.system["fixed"]), self.shape[1])
        return np.concatenate([np.where(still, 0, v), self.a(n, q, v)])

    def residual(self, n: int, new: Numbers, y: Numbers, past: Numbers) -> Numbers:
        """0 at the new state of an implicit method."""
        h, half = self.h, self.half
        if self.name == "backward-euler":
            return new - y - h * self.phi(n, new)
        if self.name == "implicit-midpoint":
            return new - y - h * self.phi(n, (y + new) / 2)
        if self.name == "trapezoidal":
            return new - y - h / 2 * (self.phi(n, y) + self.phi(n, new))
        if self.name == "bdf2":
            return new - 4 / 3 * y + 1 / 3 * past - 2 / 3 * h * self.phi(n, new)
        q, v = new[:half], new[half:]
        still = np.repeat(np.isin(np.arange(self.shape[0]), self.system["fixed"]), self.shape[1])
        by_q = np.where(still, q - y[:half], q - 2 * y[:half] + past[:half] - h**2 * self.a(n, q, v))
        return np.concatenate([by_q, v - (q - y[:half]) / h])

    def explicit(self, n: int, y: Numbers) -> Numbers:
        h, half = self.h, self.half
        q, v = y[:half], y[half:]
        if self.name == "forward-euler":
            return y + h * self.phi(n, y)
        if self.name == "symplectic-euler":
            v = v + h * self.a(n, q, v)
            return np.concatenate([q + h * self.phi(n, np.concatenate([q, v]))[:half], v])
        if self.name == "velocity-verlet":
            a0 = self.a(n, q, v)
            q1 = q + h * self.phi(n, y)[:half] + h**2 / 2 * a0
            return np.concatenate([q1, v + h / 2 * (a0 + self.a(n, q1, v + h * a0))])
        k1 = self.phi(n, y)
        k2 = self.phi(n, y + h / 2 * k1)
        k3 = self.phi(n, y + h / 2 * k2)
        k4 = self.phi(n, y + h * k3)
        return y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)

    def past(self, y0: Numbers) -> Numbers:
        if self.name == "bdf2":
            return y0 - self.h * self.phi(0, y0)
        return np.concatenate([y0[: self.half] - self.h * self.phi(0, y0)[: self.half], y0[self.half :]])

    def run(self, y0: Numbers, steps: int, guide: Numbers = None) -> Numbers:
        """States; guide: states near by, at which Newton's matrices are formed."""
        y0 = np.array(y0)
        still = np.repeat(np.isin(np.arange(self.shape[0]), self.system["fixed"]), self.shape[1])
        y0[self.half :][still] = 0
        states, past = [y0], self.past(y0)
        for n in range(steps):
            if self.name in QUICK:
                new = self.explicit(n, states[-1])
            else:
                new = self.solve(n, states[-1], past, states[-1] if guide is None else guide[n + 1])
            past, states = states[-1], [*states, new]
        return np.array(states)

    def solve(self, n: int, y: Numbers, past: Numbers, near: Numbers) -> Numbers:
        new = np.array(near, dtype=complex)
        for _ in range(4 if near is not y else 12):
            at, size = new.real, len(new)
            still = self.residual(n, at + 0j, y.real + 0j, past.real + 0j).imag  # of parameters that move
            moved = at + 1e-30j * np.eye(size)
            J = np.array([self.residual(n, row, y.real + 0j, past.real + 0j).imag - still for row in moved]).T / 1e-30
            new = new - np.linalg.solve(J, self.residual(n, new, y, past))
        return new if np.iscomplexobj(y) else new.real


def objective(document: Document, states: Numbers) -> Numbers:
    goal = document["objective"]
    z = states[goal["at"]]
    return (np.array(goal["linear"]) * z + np.array(goal["quadratic"]) * z**2 / 2).sum()


def places(document: Document) -> Iterator[tuple[str, Any, Any]]:
    """Every block of the gradient: its name, the dict and the key that hold its numbers."""
    for name in document["answer"]["gradient"]:
        if name in ("y0", "mass"):
            yield name, document if name == "y0" else document["system"], name
        else:
            effect, key = name.split(".")
            yield name, document["system"]["effects"][effect], key


def slopes(document: Document) -> dict[str, tuple[float, float]]:
    """Of J along a random direction in every block: by a complex step, and by the gradient in the file."""
    steps, states = document["time"]["steps"], np.array(document["answer"]["states"])
    found = {}
    for number, (name, holder, key) in enumerate(places(document)):
        value = np.array(holder[key], dtype=float)
        told = np.array(document["answer"]["gradient"][name])
        direction = np.random.default_rng(number).normal(size=value.shape)
        holder[key] = value + 1e-30j * direction
        y0 = np.array(document["y0"], dtype=complex)
        run = Program(document).run(y0, steps, states)
        holder[key] = value.tolist()
        size = float(np.linalg.norm(told.ravel() * direction.ravel())) or 1.0
        found[name] = (objective(document, run).imag / 1e-30 / size, float((told.ravel() @ direction.ravel()) / size))
    return found


@cache
def exported(name: str) -> str:
    """The JSON of one problem, made once."""
    return exporting.as_json(ITEMS[name].build()).decode()


def document(name: str) -> Document:
    found: Document = json.loads(exported(name))
    return found


# The net takes half a minute a stepper: two of the implicit ones are enough, as the rope has them all.
LONG = ("net-trapezoidal", "net-implicit-midpoint", "net-two-step-backward-euler")
PROGRAMS = [item.name for item in catalog.ANSWERS if item.duration.endswith("steps") and item.parameters]
DEFAULT = [name for name in PROGRAMS if name.startswith("ball") or name.endswith(QUICK) or name == "rope-bdf2"]


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[] if name in DEFAULT else pytest.mark.slow) for name in PROGRAMS if name not in LONG],
)
def test_a_program_is_derived_again_from_its_file(name: str) -> None:
    found = document(name)
    answer, tolerance = found["answer"], found["tolerance"]
    states = Program(found).run(np.array(found["y0"]), found["time"]["steps"])
    off = np.abs(states - np.array(answer["states"])) / found["scale"]
    assert (off.max(axis=1) <= np.array(tolerance["states"])).all(), off.max()
    assert objective(found, states) == pytest.approx(answer["value"], rel=1e-12)
    for block, (again, told) in slopes(found).items():
        assert again == pytest.approx(told, abs=10 * tolerance["gradient"]), block


def test_every_stepper_and_kind_of_parameter_is_among_the_programs() -> None:
    assert len(PROGRAMS) == 3 * len(catalog.STEPPERS)
    blocks = {name for program in ("ball-rk4", "rope-rk4", "net-rk4") for name, _, _ in places(document(program))}
    assert blocks >= {"y0", "mass", "gravity.acceleration", "drag.coefficient", "drag.wind", "springs.stiffness",
                      "springs.rest_length", "spring_damping.coefficient", "actuation.forces"}  # fmt: skip


def flow(found: Document) -> Callable[[float, Numbers], Numbers]:
    system = found["system"]
    shape = (system["points"], system["dimension"])
    still = np.repeat(np.isin(np.arange(shape[0]), system["fixed"]), shape[1])

    def f(t: float, y: Numbers) -> Numbers:
        q, v = np.split(y, 2)
        a = rate(system, 0, q.reshape(shape), v.reshape(shape)).ravel()
        return np.concatenate([np.where(still, 0, v), a])

    return f


SLOW_MOTIONS = [pytest.param(name, marks=pytest.mark.slow) for name in ("pendulum", "chain", "two-rates")]


@pytest.mark.parametrize("name", ["projectile", "kepler", *SLOW_MOTIONS])
def test_a_motion_is_derived_again_from_its_file(name: str) -> None:
    """By LSODA, or a matrix exponential where the motion is linear: no certificate rests on either.

    The gradient by differences of the answers.
    """
    found = document(name)
    answer, scale = found["answer"], np.array(found["scale"])

    def states(y0: Numbers) -> Numbers:
        if name in ("chain", "two-rates"):  # dy/dt = A y: the springs have no rest length
            A = np.array([flow(found)(0.0, row) for row in np.eye(len(y0))]).T
            return np.array([expm(t * A) @ y0 for t in answer["t"]])
        run = solve_ivp(flow(found), (0, answer["t"][-1]), y0, "LSODA", answer["t"], rtol=1e-12, atol=1e-12)
        return run.y.T

    y0 = np.array(found["y0"])
    off = np.abs(states(y0) - np.array(answer["states"])) / scale
    assert off.max() <= max(found["tolerance"]["states"])
    direction = np.random.default_rng(0).normal(size=len(y0)) * scale
    ends = [objective(found, states(y0 + s * direction)) for s in (1e-4, -1e-4, 2e-4, -2e-4)]
    slope = (8 * (ends[0] - ends[1]) - (ends[2] - ends[3])) / 12e-4
    told = np.array(answer["gradient"]["y0"])
    assert slope == pytest.approx(told @ direction, abs=1e-6 * float(np.linalg.norm(told * direction)))


def sine(x: Decimal) -> Decimal:
    """By its series."""
    total, term, n = Decimal(0), x, 1
    while abs(term) > Decimal(10) ** -70:
        total, term, n = total + term, -term * x * x / ((n + 1) * (n + 2)), n + 2
    return total


def test_the_formulas_are_derived_again_from_their_files() -> None:
    """The map in 80 digits; the drag by summing; the wall by sampling."""
    getcontext().prec = 80
    chaos = document("logistic-map")
    x, slope = sine(Decimal(chaos["given"]["a"])) ** 2, Decimal(1)
    for n in range(chaos["given"]["steps"] + 1):
        assert float(x) == pytest.approx(chaos["answer"]["states"][n], rel=1e-12)
        assert float(slope) == pytest.approx(chaos["answer"]["gradient"]["x0"][n], rel=1e-12)
        slope, x = slope * 4 * (1 - 2 * x), 4 * x * (1 - x)
    drag = document("drag-bounds-growth")["given"]
    for c, euler, exponential in zip(
        drag["c"], *document("drag-bounds-growth")["answer"]["gradient"].values(), strict=True
    ):
        for b, told in ((1 - c * drag["h"], euler), (math.exp(-c * drag["h"]), exponential)):
            assert told == pytest.approx(drag["h"] * math.fsum(b**k for k in range(1, drag["updates"] + 1)), rel=1e-12)
    wall = document("ball-over-a-wall")
    given, told = wall["given"], wall["answer"]["gradient"]
    s = given["sigma"] * np.random.default_rng(1).normal(size=400_000)

    def value(theta: Numbers) -> Numbers:
        reach = 2 * given["v0"] ** 2 * np.sin(theta) * np.cos(theta) / given["g"]
        t = given["place"] / (given["v0"] * np.cos(theta))
        high = given["v0"] * np.sin(theta) * t - given["g"] * t**2 / 2
        return -(np.where((reach >= given["place"]) & (high < given["height"]), given["place"], reach) ** 2)

    drawn = (value(given["centre"] + s) - value(given["centre"] - s)) * s / (2 * given["sigma"] ** 2)
    assert drawn.mean() == pytest.approx(told["smoothed"], abs=4 * drawn.std() / math.sqrt(len(s)))
    assert told["smoothed"] == pytest.approx(-0.026225, abs=1e-6) and told["mean"] == pytest.approx(-0.000526, abs=1e-6)


@pytest.mark.parametrize("change", ["answer.states", "answer.gradient.springs.stiffness", "system.mass", "y0"])
def test_one_wrong_number_is_found_by_the_derivation(change: str) -> None:
    """Mutation: the independent program must be able to disagree."""
    found = document("rope-symplectic-euler")
    if change == "answer.gradient.springs.stiffness":
        found["answer"]["gradient"]["springs.stiffness"][1] *= 1 + 1e-6
        assert any(abs(again - told) > 10 * found["tolerance"]["gradient"] for again, told in slopes(found).values())
        return
    holder = found
    *path, last = change.split(".")
    for key in path:
        holder = holder[key]
    values = np.array(holder[last])
    values.ravel()[-7 if last != "mass" else 2] += 1e-9
    holder[last] = values.tolist()
    states = Program(found).run(np.array(found["y0"]), found["time"]["steps"])
    assert np.abs(states - np.array(found["answer"]["states"])).max() > 1e-11


# The files


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exporting.export(exporting.select(catalog.ANSWERS, FEW), tmp_path_factory.mktemp("refs") / "answers")


def test_files_follow_the_schema_and_need_no_python(directory: Path) -> None:
    schema = json.loads((directory / "schema.json").read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    validator = jsonschema.Draft202012Validator(schema)
    for name in (*FEW, *PROGRAMS[:3]):
        validator.validate(document(name))
    broken = document(FEW[0])
    del broken["certificate"]
    assert list(validator.iter_errors(broken))
    assert "NumPy" in (directory / "README.md").read_text()
    assert sorted(path.name for path in directory.iterdir()) == sorted(
        ["README.md", "index.json", "schema.json", *(f"{name}.{kind}" for name in FEW for kind in ("json", "npz"))]
    )


def test_the_same_bytes_every_time(directory: Path, tmp_path: Path) -> None:
    again = exporting.export(exporting.select(catalog.ANSWERS, FEW), tmp_path / "again")
    for path in directory.iterdir():
        assert path.read_bytes() == (again / path.name).read_bytes()


def test_json_and_npz_hold_the_same_numbers(directory: Path) -> None:
    found = document(FEW[0])
    with np.load(directory / f"{FEW[0]}.npz") as arrays:
        np.testing.assert_array_equal(arrays["answer.states"], found["answer"]["states"])
        assert arrays["answer.states"].dtype.str == "<f8" and arrays["system.fixed"].dtype.str == "<i8"
    with zipfile.ZipFile(directory / f"{FEW[0]}.npz") as archive:
        assert all(info.date_time == exporting.EPOCH for info in archive.infolist())


def test_the_check_is_green_and_finds_what_was_changed(directory: Path, tmp_path: Path) -> None:
    items = exporting.select(catalog.ANSWERS, FEW)
    assert all(check.passed for check in exporting.check(items, directory))
    copy = exporting.export(items, tmp_path / "copy")
    path = copy / f"{FEW[0]}.json"
    changed = json.loads(path.read_text())
    changed["answer"]["gradient"]["mass"][0] *= 1 + 1e-9
    path.write_text(json.dumps(changed))
    red = {check.statement for check in exporting.check(items, copy) if not check.passed}
    assert red == {"json as it was written", "entries in which JSON and NPZ differ",
                   "answer.gradient.mass as dsim finds it"}  # fmt: skip
    (copy / f"{FEW[1]}.npz").unlink()
    with pytest.raises(ValueError, match="must be readable"):
        exporting.check(items, copy)


def test_an_answer_without_a_certificate_is_not_written(tmp_path: Path) -> None:
    def build() -> Document:
        raise ArithmeticError("it: states are certified to 1e-03 only, must be 1e-12")

    items = [ITEMS[FEW[0]], Item("it", 1, 0, "1 step", (1e-12, 1e-12), "nobody", build)]
    with pytest.raises(ArithmeticError):
        exporting.export(items, tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_a_directory_of_other_files_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("all of it")
    with pytest.raises(ValueError, match="holds other files"):
        exporting.export([ITEMS[FEW[0]]], tmp_path)
    assert (tmp_path / "thesis.tex").read_text() == "all of it"
    with pytest.raises(ValueError, match="is a file"):
        exporting.export([ITEMS[FEW[0]]], tmp_path / "thesis.tex")


# The command


def test_the_command(directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    def run(*arguments: str) -> Any:
        return CliRunner().invoke(app, ["references", *arguments])

    listed = run("list")
    assert listed.exit_code == 0 and all(name in listed.stdout for name in ITEMS)
    assert all(len(line) <= 80 for line in listed.stdout.splitlines())
    assert run("export", str(tmp_path / "a"), FEW[0], "-q").exit_code == 0
    assert run("check", str(tmp_path / "a"), "-q").exit_code == 0
    assert run("export", str(tmp_path / "a"), FEW[0], "-q").exit_code == 0  # over an earlier export
    index = json.loads((tmp_path / "a" / "index.json").read_text())
    index["problems"][0]["files"][f"{FEW[0]}.npz"] = "0" * 64
    (tmp_path / "a" / "index.json").write_text(json.dumps(index))
    found = run("check", str(tmp_path / "a"), "-q")
    assert found.exit_code == 1 and "npz as it was written" in found.stdout
    for arguments, message in ((["export", str(tmp_path / "b"), "nobody"], "NAME must be one of"),
                               (["check", str(tmp_path)], "DIR must hold index.json")):  # fmt: skip
        monkeypatch.setattr("sys.argv", ["dsim", "references", *arguments])
        with pytest.raises(SystemExit) as stop:
            main()
        assert stop.value.code == 2 and message in capsys.readouterr().err


def test_an_answer_that_is_not_met_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def build() -> Document:
        raise ArithmeticError("it: gradient is certified to 1e-03 only, must be 1e-12")

    monkeypatch.setattr(catalog, "ANSWERS", (Item("it", 1, 0, "1 step", (1e-12, 1e-12), "nobody", build),))
    assert CliRunner().invoke(app, ["references", "export", str(tmp_path / "o"), "-q"]).exit_code == 1
