"""`dsim check`: exit codes, files in and out, and one clear line for everything that can go wrong."""

import json
import os
import stat
import subprocess
import sys
import textwrap

import numpy as np
import pytest
from typer.testing import CliRunner

from dsim.cli import app, main
from dsim.studies.foreign import Program, load_function, read_point

COST = """
    import numpy as np

    def right(x):
        return float(np.sin(x).sum()), np.cos(x)

    def wrong(x):
        gradient = np.cos(x)
        gradient[1] *= 1 + 1e-5
        return float(np.sin(x).sum()), gradient

    def kink(x):
        return float(np.abs(x - x.round(1)).sum()), np.sign(x)

    def bare(x):
        return float(x @ x)

    def broken(x):
        return 1 / 0

    def listed(x):
        return [float(x @ x), 2 * x]

    def short(x):
        return float(x @ x), 2 * x[:2]
"""

SMALL = """
    import json, math, sys

    x = json.load(open(sys.argv[-2]))["x"]  # no NumPy: it is started for every point
    scale = 1.01 if "wrong" in sys.argv else 1.0
    answer = {"value": sum(map(math.sin, x)), "gradient": [scale * math.cos(a) for a in x]}
    json.dump(answer, open(sys.argv[-1], "w"))
"""

PROGRAM = """
    import json, sys
    import numpy as np

    source, target = sys.argv[-2:]
    batch = "batch" in sys.argv
    x = np.load(source)["x"] if source.endswith("npz") else np.array(json.load(open(source))["x"])
    open("calls.log", "a").write(".")
    value, gradient = np.sin(x).sum(axis=-1), np.cos(x) * (1.01 if "wrong" in sys.argv else 1.0)
    if "die" in sys.argv:
        sys.exit("out of fuel")
    if "silent" in sys.argv:
        sys.exit(0)
    if "sleep" in sys.argv:
        import time; time.sleep(30)
    if "short" in sys.argv:
        gradient = gradient[..., :2]
    if "partial" in sys.argv:
        np.savez(target, value=value)
    elif "garbage" in sys.argv:
        open(target, "w").write("not a file")
    elif target.endswith("npz"):
        np.savez(target, value=value, gradient=gradient)
    else:
        json.dump({"value": value.tolist(), "gradient": gradient.tolist()}, open(target, "w"))
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cost.py").write_text(textwrap.dedent(COST))
    for name, source, options in (("program", PROGRAM, ""), ("small", SMALL, " -IS")):
        program = tmp_path / name
        program.write_text(f"#!{sys.executable}{options}\n" + textwrap.dedent(source))
        program.chmod(program.stat().st_mode | stat.S_IEXEC)
    np.save("x.npy", np.array([0.1, 0.5, -0.3]))
    return tmp_path


def run(*arguments):
    return CliRunner().invoke(app, ["check", *arguments])


def refused(*arguments):
    """The one line that bad usage prints."""
    result = run(*arguments)
    assert isinstance(result.exception, ValueError | FileNotFoundError), result.output
    return str(result.exception)


@pytest.mark.parametrize("name, code, verdict", [("right", 0, "smooth"), ("wrong", 1, "wrong"), ("kink", 2, "kink")])
def test_exit_codes(folder, name, code, verdict):
    result = run(f"cost.py:{name}", "--at", "x.npy")
    assert result.exit_code == code and f"verdict   {verdict}" in result.stdout


def test_json_is_all_that_is_printed(folder):
    result = run("cost.py:wrong", "--at", "x.npy", "--json")
    data = json.loads(result.stdout)
    assert result.exit_code == 1 and data["verdict"] == "wrong" and data["worst"]["entry"] == "entry 1"


@pytest.mark.parametrize("form", ["npz", "json"])
def test_a_program_that_takes_batches(folder, form):
    Program("./program", form)  # the constructor alone starts nothing
    assert not os.path.exists("calls.log")
    for words, code in (("./program batch", 0), ("./program batch wrong", 1)):
        result = run("--exec", words, "--format", form, "--at", "x.npy", "--batch")
        assert result.exit_code == code and ("smooth" in result.stdout) == (code == 0)


@pytest.mark.parametrize("words, code", [("./small", 0), ("./small wrong", 1)])
def test_a_program_that_takes_one_point(folder, words, code):
    assert run("--exec", words, "--format", "json", "--at", "0.1").exit_code == code


def test_one_point_as_arrays(folder):
    x = np.array([0.1, 0.5])
    value, gradient = Program("./program", "npz")(x)
    assert value == np.sin(x).sum() and np.array_equal(gradient, np.cos(x))


def test_a_batch_saves_calls(folder):
    run("--exec", "./program batch", "--at", "x.npy", "--batch")
    assert len((folder / "calls.log").read_text()) <= 1 + 3


def test_plots_are_pictures(folder):
    result = run("cost.py:wrong", "--at", "x.npy", "--plot", "v.png")
    assert result.exit_code == 1 and (folder / "v.png").read_bytes().startswith(b"\x89PNG")
    assert sorted(p.name for p in folder.iterdir() if "tmp" in p.name) == []


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--at", "x.npy"], "either FILE.py:FUNCTION or --exec"),
        (["cost.py:right", "--exec", "./program", "--at", "x.npy"], "either FILE.py:FUNCTION or --exec"),
        (["cost.py:right"], "--at must give the point"),
        (["cost.py", "--at", "x.npy"], "FILE.py:FUNCTION; got 'cost.py'"),
        (["none.py:f", "--at", "x.npy"], "no file none.py"),
        (["cost.py:absent", "--at", "x.npy"], "no function 'absent'; it has right, wrong"),
        (
            ["cost.py:broken", "--at", "x.npy"],
            r"broken raised ZeroDivisionError: division by zero (line 19 of cost.py)",
        ),
        (["cost.py:listed", "--at", "x.npy"], "listed must return the tuple (value, gradient); got a list"),
        (["cost.py:short", "--at", "x.npy"], "gradient must have the shape of x, (3,); got (2,)"),
        (
            ["--exec", "./program short", "--at", "x.npy"],
            "gradient must have the shape of x, (3,); ./program short wrote",
        ),
        (
            ["--exec", "./program batch short", "--batch", "--at", "x.npy"],
            "gradient must have shape (1, 3) for a batch; ./program batch short wrote (1, 2)",
        ),
        (
            ["--exec", "./program 'a b", "--at", "x.npy"],
            '--exec must be a command line; got "./program \'a b" (No closing',
        ),
        (["cost.py:bare", "--at", "x.npy"], "must return (value, gradient)"),
        (["cost.py:right", "--at", "none.npy"], "there is none at none.npy"),
        (["cost.py:right", "--at", "zero,one"], "numbers like 0.1,0.2; got 'zero,one'"),
        (["cost.py:right", "--at", "nan,1"], "x must be finite"),
        (["cost.py:right", "--at", "x.npy", "--plot", "v.gif"], "--plot must end in .png or .svg"),
        (["--exec", "./program die", "--at", "x.npy"], "ended with code 1: out of fuel"),
        (["--exec", "./program silent", "--at", "x.npy"], "wrote no output.npz"),
        (["--exec", "./program partial", "--at", "x.npy"], "must write value and gradient; it wrote value"),
        (["--exec", "./program garbage", "--at", "x.npy"], "no readable npz file"),
        (["--exec", "./program sleep", "--at", "x.npy", "--timeout", "0.5"], "more than 0.5 s"),
        (["--exec", "./absent", "--at", "x.npy"], "a program that can be started"),
        (["--exec", "./program", "--at", "x.npy", "--format", "xml"], "one of npz, json; got 'xml'"),
        (["--exec", "./program", "--at", "x.npy", "--timeout", "-1"], "--timeout must be > 0"),
    ],
)
def test_bad_usage_is_one_clear_line(folder, arguments, message):
    assert message in refused(*arguments)


def test_the_command_line_turns_errors_into_code_2(folder, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["dsim", "check", "none.py:f", "--at", "0.1"])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 2 and capsys.readouterr().err.strip() == "dsim: there is no file none.py"


@pytest.mark.parametrize(
    "arguments",
    [
        ["cost.py:listed", "--at", "x.npy"],
        ["cost.py:short", "--at", "x.npy"],
        ["--exec", "./program short", "--at", "x.npy"],
        ["--exec", "./program 'a b", "--at", "x.npy"],
    ],
)
def test_an_answer_that_cannot_be_judged_is_code_2_and_one_line(folder, capsys, monkeypatch, arguments):
    monkeypatch.setattr(sys, "argv", ["dsim", "check", *arguments])
    with pytest.raises(SystemExit) as stop:
        main()
    said = capsys.readouterr()
    assert stop.value.code == 2 and said.out == "" and said.err.strip().count("\n") == 0


def test_every_printed_line_fits_80_columns(folder):
    for name in ("right", "wrong", "kink"):
        assert max(map(len, run(f"cost.py:{name}", "--at", "x.npy").stdout.splitlines())) <= 80


def test_as_a_program(folder):
    """The whole command in a process of its own, as a script would call it."""
    command = [sys.executable, "-c", "from dsim.cli import main; main()", "check", "cost.py:right", "--at", "0.1,0.2"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0 and done.stdout.startswith("verdict   smooth") and done.stderr == ""


def test_points_come_from_many_files(folder):
    np.savez("a.npz", x=np.arange(3.0), other=1)
    np.savez("b.npz", start=np.arange(3.0))
    (folder / "c.json").write_text('{"x": [0, 1, 2]}')
    for name in ("a.npz", "b.npz", "c.json", "0,1,2"):
        assert read_point(name).tolist() == [0, 1, 2]
    (folder / "bad.npy").write_text("not numpy")
    with pytest.raises(ValueError, match=r"bad\.npy does not"):
        read_point("bad.npy")


def test_a_file_that_cannot_be_run_says_where(folder):
    (folder / "typo.py").write_text("x = 1\ny = = 2\n")
    with pytest.raises(ValueError, match=r"typo.py could not be run: SyntaxError.*line 2 of typo.py"):
        load_function("typo.py:f")
