"""`dsim audit` as its users type it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from dsim import catalog
from dsim.cli import app, main
from dsim.report import auditing
from dsim.studies.peers import PEERS

MINE = '''
import numpy as np
from dsim.studies import Simulator

def simulator():
    """x decays; the gradient is FACTOR times what it should be."""
    return Simulator("mine", np.array([0.5, 2.0]), lambda x, steps, h: x * (1 - h) ** steps,
                     lambda x, steps, h, w: FACTOR * w * (1 - h) ** steps, 0.1, 5, {"a": [0], "b": [1]})

def nothing():
    return 3

def failing():
    return Simulator("failing", np.ones(2), lambda x, steps, h: x, lambda x, steps, h, w: w // {}, 0.1, 5)

def talking():
    found = simulator()
    say = lambda *x: print("a step") or found.simulate(*x)
    return Simulator("talking", found.x, say, found.gradient, 0.1, 5)
'''
CLOTH = '''
import numpy as np

def make(problem):
    """A cloth whose springs are left out: another program than the one asked for, right about itself."""
    h, free = problem["h"], problem["free"][:, None]
    b = 1 - h * problem["drag"] / problem["mass"]
    steps, (wq, wv) = problem["steps"], problem["weights"]

    def forward(stiffness, v0):
        q, v = problem["q0"], free * v0
        for _ in range(steps):
            v = b * v + h * free * problem["gravity"]
            q = q + h * v
        return q, v

    def gradient(stiffness, v0):
        slope = h * sum(b**k for k in range(1, steps + 1))
        return 0 * stiffness, free * (slope * wq + b**steps * wv)

    return forward, gradient
'''


def run(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["audit", *arguments])
    return result.exit_code, result.stdout


def mine(tmp_path: Path, factor: float, source: str = MINE) -> str:
    (tmp_path / "mine.py").write_text(source.replace("FACTOR", str(factor)))
    return str(tmp_path / "mine.py")


def test_a_right_program_of_the_users(tmp_path: Path) -> None:
    code, out = run(f"{mine(tmp_path, 1.0)}:simulator", "--plot", str(tmp_path / "v.svg"))
    assert code == 0 and "right," in out and "converges" in out and "downhill" in out
    assert all(len(line) <= 80 for line in out.splitlines())
    assert (tmp_path / "v.svg").read_bytes().startswith(b"<?xml")


def test_a_wrong_program_of_the_users_as_json(tmp_path: Path) -> None:
    code, out = run(f"{mine(tmp_path, 1.5)}:simulator", "--json")
    found = json.loads(out)
    assert code == 1 and not found["ok"]
    assert found["program"]["blocks"]["a"] | {"digits": 0, "numerical": 0} == {
        "verdict": "wrong", "digits": 0, "given": pytest.approx(1.5 * found["program"]["blocks"]["a"]["numerical"]),
        "numerical": 0, "where": "entry 0", "first_bad_step": 1,
    }  # fmt: skip


def test_a_program_right_about_itself_that_is_not_the_cloth(tmp_path: Path) -> None:
    """Its gradient is its own derivative, and neither the physics' nor dsim's."""
    code, out = run(f"{mine(tmp_path, 1.0, CLOTH)}:make", "--json")
    found = json.loads(out)
    assert code == 1 and found["program"]["verdict"] == "right" and found["physics"]["verdict"] == "astray"
    assert found["agreement"]["gradient"] > 0.1 > found["agreement"]["allowed"]


def test_the_planted_bugs(monkeypatch: pytest.MonkeyPatch) -> None:
    few = [bug for bug in catalog.PLANTED if bug.name == "guarded division"]
    monkeypatch.setattr(catalog, "PLANTED", tuple(few))
    code, out = run("--planted")
    assert code == 0 and "mass, step 1" in out and "yes" in out
    monkeypatch.setattr(auditing, "caught", lambda bug, verdict: bug.name != "guarded division")
    code, out = run("--planted")
    assert code == 1 and "NO" in out


def test_peers_that_are_not_installed_are_skipped_with_a_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dsim.studies.peers.Peer.installed", False)
    code, out = run("--peers", "--peers-in", str(tmp_path))
    assert code == 2 and all(f"{peer.name}: skipped, the package {peer.package}" in out for peer in PEERS)
    assert 'pip install -e ".[peers]"' in out


def test_every_peer_has_its_program() -> None:
    directory = Path(__file__).parent / "peers"
    assert all("def make(problem)" in (directory / peer.file).read_text() for peer in PEERS)


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["mine.py"], "the function must be given as FILE.py:FUNCTION"),
        (["none.py:make"], "there is no file none.py"),
        (["a.py:make", "--peers"], "give one of FILE.py:FUNCTION, --peers and --planted"),
        (["--plot", "x.pdf"], "--plot must end in .png or .svg"),
        (["--peers", "--peers-in", "nowhere"], "--peers-in must be a directory"),
    ],
)
def test_bad_usage(
    arguments: list[str], message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["dsim", "audit", *arguments])
    with pytest.raises(SystemExit) as exit:
        main()
    assert exit.value.code == 2 and message in capsys.readouterr().err


def test_a_function_that_makes_no_simulator(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="must return a Simulator"):
        auditing.given(f"{mine(tmp_path, 1.0)}:nothing", {})


def test_an_error_inside_the_users_callables_is_one_line_with_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Not a traceback with exit code 1, which would say that a verdict is bad."""
    monkeypatch.setattr("sys.argv", ["dsim", "audit", "-q", f"{mine(tmp_path, 1.0)}:failing"])
    with pytest.raises(SystemExit) as exit:
        main()
    told = capsys.readouterr().err
    assert exit.value.code == 2 and "gradient raised TypeError" in told and "of mine.py)" in told


def test_what_a_program_prints_does_not_mix_with_the_json(tmp_path: Path) -> None:
    code, out = run(f"{mine(tmp_path, 1.0)}:talking", "--json")
    assert code == 0 and json.loads(out)["name"] == "talking"


@pytest.mark.parametrize(
    "answer, message",
    [
        ("3", "make must return (forward, gradient), two callables;"),
        ("(lambda k, v: (v, v, v), lambda k, v: (k, v))", "forward must return the last (q, v)"),
        ("(lambda k, v: 1 / 0, lambda k, v: (k, v))", "raised ZeroDivisionError: division by zero"),
    ],
)
def test_a_cloth_that_answers_something_else(
    answer: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One line and exit code 2: a traceback's 1 would read as a bad verdict."""
    (tmp_path / "mine.py").write_text(f"def make(problem):\n    return {answer}\n")
    monkeypatch.setattr("sys.argv", ["dsim", "audit", f"{tmp_path}/mine.py:make", "-q"])
    with pytest.raises(SystemExit) as stop:
        main()
    told = capsys.readouterr().err
    assert stop.value.code == 2 and message in told and "Traceback" not in told
