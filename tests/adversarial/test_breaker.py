"""Attacks that once succeeded: trivial programs with points, names and words that forge, one that buys itself time."""

from __future__ import annotations

import json
import os
import shutil
import time
from pathlib import Path

import pytest

from dsim.grading import folder, results
from dsim.grading import grade as grading
from dsim.grading.sandbox import GRACE, Jail, SandboxedStudent
from dsim.grading.selfcheck import outcomes
from dsim.grading.student import StudentTimeout

ROOT = Path(__file__).parents[2] / "assignments"
ASSIGNMENT = Path(__file__).parent.parent / "grading_fixture"
SECRET = b"a secret of the tests"

# name: (assignment, submission, items that it must earn nothing of)
TRIVIAL = {
    "nothing moves": (
        "01",
        "def symplectic_euler(a, x, v, t, h): return x, v\nforward_euler = symplectic_euler\n"
        "def simulate(m, a, x, v, h, n): return np.repeat(x[None], n + 1, 0), np.repeat(v[None], n + 1, 0)\n",
        "simulate energy",
    ),
    "only the start": (
        "01",
        "def simulate(m, a, x, v, h, n):\n    X, V = np.zeros((2, n + 1, *x.shape))\n    X[0], V[0] = x, v\n"
        "    return X, V\n",
        "simulate",
    ),
    "no forces": (
        "02",
        "def spring_forces(x, *rest): return 0 * x\ndef damping_forces(x, *rest): return 0 * x\n",
        "coincident spring_forces damping_forces",
    ),
    "the zero of the valley by heart": (
        "03",
        "def careful_newton(equation, z): return 0 * z, True\n",
        "hard_starts",
    ),
    "a velocity that is kept": ("03", "def backward_euler(m, M, q, v, h): return q + h * v, v\n", "backward_euler"),
    "a number so large that every error is small beside it": (
        "06",
        "def adjoint_gradient(body, objective, x, p): return np.full(len(p), 1e200)\n",
        "adjoint adjoint_follower",
    ),
    "None everywhere": (
        "06",
        "def sensitivity(body, x, p): pass\ndef adjoint_gradient(body, objective, x, p): pass\n",
        "fold",
    ),
    "anything large beside a fold": (
        "06",
        "def large(shape, body, x, p):\n"
        "    return None if np.linalg.cond(body.dfdx(x, p)) > 1e12 else np.full(shape, 1e99)\n"
        "def sensitivity(body, x, p): return large((2, 2), body, x, p)\n"
        "def adjoint_gradient(body, objective, x, p): return large(2, body, x, p)\n",
        "fold",
    ),
    "a trajectory that stands still, with gradients to match": (
        "07",
        "def symplectic_step(b, y, u, p, h): return y\n"
        "def symplectic_linearization(b, y, y1, p, h):\n    k = len(y)\n"
        "    return np.zeros((k, k)), np.zeros((k, k // 2)), np.zeros((k, len(p)))\n"
        "backward_step, backward_linearization = symplectic_step, symplectic_linearization\n"
        "def adjoint(A, B, C, dldy, dldu): return np.ones(A.shape[1]), np.ones(dldu.shape), np.ones(C.shape[2])\n"
        "def J(c, y, u): return sum(c.state(k, y) for k in range(len(u) + 1)) + sum(map(c.control, range(len(u)), u))\n"
        "def gradient(m, b, y, u, p): return J(b[1], y, u), np.ones(y.shape), np.ones(u.shape), np.ones(p.shape)\n"
        "def checkpointed_gradient(m, b, y, u, p, every):\n    c = b[1]\n"
        "    return J(c, y, u), c.dldy(0, y), np.array([*map(c.dldu, range(len(u)), u)]), np.zeros(p.shape)\n",
        "gradient checkpoints",
    ),
}


@pytest.mark.parametrize("name", TRIVIAL)
def test_a_trivial_program_earns_nothing(name: str) -> None:
    number, source, ids = TRIVIAL[name]
    found = {one.item.id: one for one in outcomes(folder.find(number, ROOT), "import numpy as np\n" + source)}
    assert {id: found[id].score for id in ids.split()} == dict.fromkeys(ids.split(), 0)


def test_a_step_that_goes_on_to_the_root_is_none() -> None:
    source = (
        "import numpy as np\ndef newton_step(equation, z):\n"
        "    for _ in range(50): z = z - np.linalg.solve(equation[1](z), equation[0](z))\n    return z\n"
    )
    found = {one.item.id: one for one in outcomes(folder.find("03", ROOT), source)}
    assert found["quadratic"].lost and "one step" in found["quadratic"].why


def graded(tmp_path: Path, files: dict[bytes, str]) -> Path:
    (tmp_path / "in").mkdir()
    for name, text in files.items():
        Path(os.fsdecode(os.fsencode(tmp_path / "in") + b"/" + name)).write_text(text)
    grading.grade(ASSIGNMENT, grading.submissions_in(tmp_path / "in"), tmp_path / "out", sandboxed=False)
    return tmp_path / "out"


def test_no_name_of_a_file_that_cannot_be_read_does_anything(tmp_path: Path) -> None:
    """The message about it holds its name: one that cannot be encoded, or starts lines of its own."""
    to = graded(tmp_path, {b"a\xffb.py": "def (", b"x\n# alice: 7 of 7\n\x1b[2J.py": "def (", b"z.py": "x = 1"})
    assert len((to / "grades.csv").read_text().splitlines()) == 4
    for path in to.glob("*/feedback.md"):
        text = path.read_text()
        assert "\n# alice" not in text and "\x1b" not in text
        assert "\\u001b" not in path.with_name("results.json").read_text()


def test_nobody_takes_the_folder_of_another(tmp_path: Path) -> None:
    theirs = results.folder_of(Path("v;ictim.py"))
    assert results.folder_of(Path(f"{theirs}.py")) != theirs
    to = graded(tmp_path, {b"v;ictim.py": (ASSIGNMENT / "solution.py").read_text(), f"{theirs}.py".encode(): "x = 1"})
    rows = [line.split(",")[:2] for line in (to / "grades.csv").read_text().splitlines()[1:]]
    assert rows == [[f'"{theirs}"', "0.0"], ['"v;ictim"', "7.0"]]


@pytest.mark.parametrize("kind", ["# me: 7 of 7", "~~~", "> 7 of 7", "- 7 of 7", "1. 7 of 7", "http://192.0.2.1/"])
def test_the_name_of_an_exception_is_no_markdown(kind: str, tmp_path: Path) -> None:
    to = graded(tmp_path, {b"me.py": f"def double(x): raise type({kind!r}, (Exception,), {{}})('x')\n"})
    text = (to / "me" / "feedback.md").read_text()
    assert f"\n{kind}" not in text and "http://" not in text
    assert kind in json.loads((to / "me" / "results.json").read_text())["tests"][0]["output"]


SPEAKER = """\
import ctypes, os, signal, struct, time
def slow():
    me, syscall = os.getppid(), ctypes.CDLL(None).syscall
    handle = os.pidfd_open(me)
    os.kill(me, signal.SIGSTOP)
    requests, replies = (syscall(438, handle, number, 0) for number in (3, 4))  # pidfd_getfd
    head = b'{"kind": "value", "value": 999, "arrays": []}'
    while True:
        time.sleep(0.8)
        os.write(replies, struct.pack("<IQ", len(head), 0) + head)
        left = sum(struct.unpack("<IQ", os.read(requests, 12)))
        while left:
            left -= len(os.read(requests, left))
"""


@pytest.mark.skipif(shutil.which("bwrap") is None, reason="bubblewrap is not installed")
def test_who_speaks_for_the_supervisor_gains_no_time(tmp_path: Path) -> None:
    """Each reply is in time; together they may not take longer than the item."""
    (tmp_path / "me.py").write_text(SPEAKER)
    with SandboxedStudent(Jail(tmp_path / "me.py", ASSIGNMENT, os.getpid() % 4096)) as student:
        with student.item(10.0):  # the sandbox starts
            pass
        start = time.monotonic()
        with pytest.raises(StudentTimeout), student.item(1.0):
            for _ in range(10):
                student.call("slow")
        assert time.monotonic() - start < 1.0 + GRACE + 1.5
