"""Submissions whose only aim is to forge a grade: each gets what it earned, nothing is left, the next is fair."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest

import dsim
from dsim.grading import grade as grading
from dsim.grading import seccomp
from dsim.grading.sandbox import USER, Jail, SandboxedStudent, SandboxError, check_sandbox
from dsim.grading.student import StudentReply, StudentTimeout

ASSIGNMENT = Path(__file__).parent.parent / "grading_fixture"
SOLUTION = (ASSIGNMENT / "solution.py").read_text()
SECRET = b"a secret of the tests"
RIGHT = 7.0

pytestmark = pytest.mark.skipif(shutil.which("bwrap") is None, reason="bubblewrap is not installed")

# Looks first where such files would be, then everywhere, for as long as no limit ends it: disks are slow at first.
SEARCH = """
import os, sys, time
WANTED = {'test_hidden.py', 'solution.py', 'rubric.toml', '.dsim-secret'}
PLACES = [*sys.path, os.getcwd(), '/sandbox', '/home', '/root', '/tmp', '/opt', '/srv', '/mnt', '/usr/local', '/']
def double(x):
    end = time.monotonic() + 0.5
    for place in PLACES:
        for folder, _, files in os.walk(place):
            if WANTED & {*files}:
                raise RuntimeError(f"FOUND {folder}")
            if time.monotonic() > end:
                return 3 * x
    return 3 * x
"""

# name: (submission, score, in which words the worst item says why).  What follows SOLUTION keeps it right.
ATTACKS: dict[str, tuple[str, float, str]] = {
    "nothing": ("", 0, "double is not defined"),
    "syntax error": ("def double(x:\n    return 2", 0, "could not be read"),
    "infinite loop in one item": (SOLUTION + "\ndef solve(A, b):\n    while True: pass\n", 4, "too long"),
    "infinite loop on import": ("while True: pass\n", 0, "too long"),
    "sys.exit on import": ("import sys\nsys.exit(0)\n", 0, "SystemExit"),
    "os._exit(0)": (SOLUTION + "\ndef solve(A, b):\n    import os\n    os._exit(0)\n", 4, "ended its process"),
    "crash": (SOLUTION + "\ndef solve(A, b):\n    import ctypes\n    ctypes.string_at(0)\n", 4, "ended its process"),
    "8 GB": (SOLUTION + "\ndef solve(A, b):\n    return np.ones(2**30)[:4]\n", 4, "Memory"),
    "deep recursion": (SOLUTION + "\ndef solve(A, b):\n    return solve(A, b)\n", 4, "RecursionError"),
    "fork burst": (
        SOLUTION + "\nimport os\ndef solve(A, b):\n    while True:\n        os.fork()\n",
        4,
        "",
    ),
    "a child that stays": (
        SOLUTION + "\nimport os, time\nif os.fork() == 0:\n    os.setsid()\n    if os.fork() == 0:\n"
        "        while True: time.sleep(1)\n    os._exit(0)\n",
        RIGHT,
        "",
    ),
    "patched comparison": (
        "import numpy as np, sys\nnp.testing.assert_allclose = lambda *a, **k: None\nnp.abs = lambda x: 0 * x\n"
        "def double(x): return x\ndef solve(A, b): return b\ndef step(f, x, v, h): return x, v\n",
        1,
        "off by",
    ),
    "reads the caller's frames": (
        "import sys, numpy as np\ndef double(x):\n    frame = sys._getframe()\n    while frame:\n"
        "        for name in ('expected', 'check', 'secret', 'student'):\n            if name in frame.f_locals:\n"
        "                return frame.f_locals[name]\n        frame = frame.f_back\n    return x\n",
        0,
        "off by",
    ),
    "searches the disk for tests": (SEARCH, 0, "off by"),
    "imports the library": (
        "import sys\nsys.path += ['/usr/lib/python3/dist-packages']\n"
        "def double(x):\n    import dsim\n    return 2 * x\n",
        0,
        "ModuleNotFoundError",
    ),
    "prints a forged result": (
        "import json, sys\nprint(json.dumps({'score': 999, 'max_score': 7}))\nsys.stdout.flush()\n",
        0,
        "not defined",
    ),
    "writes frames of its own": (
        'import os, struct\nframe = b\'{"kind": "value", "value": 999, "arrays": []}\'\n'
        "frame = struct.pack('<IQ', len(frame), 0) + frame\nfor d in range(3, 60):\n    try: os.write(d, frame * 50)\n"
        "    except OSError: pass\n",
        0,
        "",
    ),
    "garbage on every descriptor": (
        SOLUTION
        + "\nimport os\nfor d in range(3, 60):\n    try: os.write(d, b'\\xff' * 4000)\n    except OSError: pass\n",
        0,
        "",
    ),
    "kills everything it may": (
        SOLUTION + "\nimport os, signal\ndef solve(A, b):\n    os.kill(-1, signal.SIGKILL)\n",
        4,
        "",
    ),
    "kills its supervisor": (
        SOLUTION
        + "\nimport os, signal\ndef solve(A, b):\n    os.kill(os.getppid(), signal.SIGKILL)\n    while True: pass\n",
        4,
        "",
    ),
    "network": (
        SOLUTION + "\nimport socket\ndef solve(A, b):\n    socket.create_connection(('192.0.2.1', 80), 1)\n",
        4,
        "OSError",
    ),
    "always equal": (
        "import numpy as np\nclass Yes(np.ndarray):\n    __eq__ = __le__ = __ge__ = lambda s, o: True\n"
        "    __sub__ = lambda s, o: s * 0\ndef double(x): return x.view(Yes)\n",
        0,
        "off by",
    ),
    "an object of its own": ("class Yes(float): pass\ndef double(x): return Yes(3)\n", 0, "must be numbers"),
    "an exception whose text raises": (
        "class Bad(Exception):\n    def __str__(self): raise Bad\ndef double(x): raise Bad\n",
        0,
        "cannot be told",
    ),
    "NaN": ("def double(x): return x * float('nan')\n", 0, "must be finite"),
    "the wrong shape": ("def double(x): return [[2 * v for v in x]]\n", 0, "got a list"),
    "text for numbers": ("def double(x): return 'right'\n", 0, "got a str"),
    "an array of objects": (
        "import numpy as np\ndef double(x): return np.array([2 * v for v in x] + [None], dtype=object)[:3]\n",
        0,
        "must hold floats",
    ),
    "a huge reply": ("import numpy as np\ndef double(x): return np.zeros(2**24)\n", 0, "at most"),
    "a flood of print": (SOLUTION + "\nfor _ in range(50_000): print('x' * 100)\n", RIGHT, ""),
    "lists in lists": (
        "def double(x):\n    x = []\n    for _ in range(10_000): x = [x]\n    return x\n",
        0,
        "",
    ),
    "fills the disk": (
        SOLUTION + "\ndef solve(A, b):\n    with open('/tmp/big', 'wb') as f:\n        for _ in range(1000):\n"
        "            f.write(bytes(2**20))\n",
        4,
        "",
    ),
    "reads the memory of its supervisor": (
        SOLUTION + "\nimport os\nme = os.getppid()\ntry:\n    with open(f'/proc/{me}/maps') as maps:\n"
        "        parts = [line.split()[0].split('-') for line in maps if ' rw' in line]\n"
        "    with open(f'/proc/{me}/mem', 'rb') as memory:\n        for a, b in parts:\n"
        "            memory.seek(int(a, 16))\n"
        "            if b'a secret of the ' + b'tests' in memory.read(int(b, 16) - int(a, 16)):\n"
        "                raise RuntimeError('FOUND')\nexcept OSError:\n    pass\n",
        RIGHT,
        "",
    ),
    "writes into the pipes of its supervisor": (
        SOLUTION + "\nimport os, struct\n"
        'frame = b\'{"kind": "value", "kind": "value", "value": 999, "arrays": []}\'\n'
        "frame = struct.pack('<IQ', len(frame), 0) + frame\nfor d in range(60):\n    try:\n"
        "        out = os.open(f'/proc/{os.getppid()}/fd/{d}', os.O_WRONLY | os.O_NONBLOCK)\n"
        "        os.write(out, frame * 50)\n    except OSError: pass\n",
        0,
        "",
    ),
    "a debugger on its supervisor": (
        SOLUTION + "\nimport ctypes, os\ndef solve(A, b):\n"
        "    ctypes.CDLL(None).ptrace(16, os.getppid(), 0, 0)\n    while True: pass\n",
        4,
        "too long",
    ),
    "stops its supervisor": (
        SOLUTION + "\nimport os, signal\ndef solve(A, b):\n    os.kill(os.getppid(), signal.SIGSTOP)\n    return b\n",
        4,
        "too long",
    ),
    "a helper that lives from item to item": (
        SOLUTION + "\nimport os, socket, time\nif not os.path.exists('/tmp/helper') and os.fork() == 0:\n"
        "    os.setsid()\n    server = socket.socket(socket.AF_UNIX)\n    server.bind('/tmp/helper')\n"
        "    server.listen()\n    while True: server.accept()\n",
        RIGHT,
        "",
    ),
    "a second look at inputs of an earlier item": (
        "import os\ndef double(x):\n    open('/tmp/seen', 'w').write(repr(x))\n    return 2 * x\n"
        "def solve(A, b):\n    raise RuntimeError(sorted(os.listdir('/tmp')))\n",
        2,
        "seen",
    ),
    "slow replies that add up": (
        SOLUTION + "\nimport time\ndef solve(A, b):\n    time.sleep(0.7)\n    return np.linalg.solve(A, b)\n",
        4,
        "too long",
    ),
    "dates for numbers": ("def double(x):\n    return (2 * x).astype('M8[s]')\n", 0, "must hold floats"),
    "a record for numbers": (
        "import numpy as np\ndef double(x):\n    return np.zeros(3, dtype=[('a', 'f8'), ('b', 'f8')])\n",
        0,
        "must hold floats",
    ),
    "numbers the other way round": (
        SOLUTION + "\ndef double(x):\n    return (2 * x).astype('>f8')[::-1][::-1]\n",
        RIGHT,
        "",
    ),
    "a whole number of ten thousand digits": ("def double(x):\n    return 10**10_000\n", 0, "64 bits"),
    "an array that lies about its shape": (
        "import numpy as np\nclass Liar(np.ndarray):\n    shape = (3,)\n    size = 3\n    nbytes = 24\n"
        "def double(x):\n    return np.zeros((2**9, 2**9)).view(Liar)\n",
        0,
        "",
    ),
    "a class of arrays whose copies are others": (
        "import numpy as np\nclass Odd(np.ndarray):\n    def astype(self, *a, **k): raise SystemExit\n"
        "    def tobytes(self, *a): return b'x'\n    def __array__(self, *a, **k): raise KeyboardInterrupt\n"
        "def double(x):\n    return (2 * x).view(Odd)\n",
        2,
        "",
    ),
    "patches the protocol": (
        "import protocol, sys\nold = protocol.encode\n"
        "def encode(kind, value=None):\n    return old('closed' if kind == 'value' else kind, value)\n"
        "protocol.encode = encode\ndef double(x): return x\ndef solve(A, b): return b\n"
        "def step(f, x, v, h): return x, v\n",
        1,
        "off by",
    ),
    "answers learnt by heart": (
        "import numpy as np\ndef double(x): return np.array([2.0, -4.0, 7.0])\n"
        "def solve(A, b): return np.array([0.1, 0.2, 0.3, 0.4])\n",
        3,
        "residual",
    ),
    "its environment": (
        "import os\ndef double(x): raise RuntimeError(sorted(os.environ))\n",
        0,
        "RuntimeError: ['HOME', 'LANG'",
    ),
    "rewrites its own file": (
        SOLUTION + "\ntry:\n    open('/sandbox/submission.py', 'w').write('x')\nexcept OSError:\n    pass\n"
        "else:\n    raise RuntimeError('FOUND')\n",
        RIGHT,
        "",
    ),
    "closes every descriptor": (
        SOLUTION + "\nimport os\ndef solve(A, b):\n    os.closerange(0, 64)\n    return b\n",
        4,
        "ended its process",
    ),
    "a user namespace of its own, then a fork burst": (
        SOLUTION + "\nimport ctypes, os\ndef solve(A, b):\n    ctypes.CDLL(None).unshare(0x10000000)\n"
        "    while True:\n        os.fork()\n",
        4,
        "",
    ),
    "raises its limits, then takes memory": (
        SOLUTION + "\nimport resource\ndef solve(A, b):\n"
        "    try: resource.setrlimit(resource.RLIMIT_AS, (2**40, 2**40))\n    except (ValueError, OSError): pass\n"
        "    return np.ones(2**30)[:4]\n",
        4,
        "Memory",
    ),
    "memory in many processes": (
        SOLUTION + "\nimport os, time\ndef solve(A, b):\n    for _ in range(8):\n        if os.fork() == 0:\n"
        "            kept = bytearray(b'x') * (900 * 2**20)\n            time.sleep(60)\n    time.sleep(60)\n",
        4,
        "",
    ),
    "memory of no process": (
        SOLUTION + "\nimport os\ndef solve(A, b):\n    kept = []\n    while True:\n"
        "        kept.append(os.memfd_create('x'))\n        os.write(kept[-1], bytes(2**23))\n",
        4,
        "PermissionError",
    ),
    "a thousand threads": (
        SOLUTION + "\nimport threading, time\ndef solve(A, b):\n    for _ in range(1000):\n"
        "        threading.Thread(target=time.sleep, args=(60,)).start()\n",
        4,
        "thread",
    ),
    "empty files without end": (
        SOLUTION + "\nimport itertools\ndef solve(A, b):\n    for n in itertools.count():\n"
        "        open(f'/tmp/{n}', 'w').close()\n",
        4,
        "",
    ),
    "a page in a message": (
        "def double(x): raise ValueError('<script>alert(1)</script> [full marks](http://192.0.2.1) \\x1b[2J`x`')\n",
        0,
        "<script>",  # results.json is text; feedback.md is looked at below
    ),
    "a right solution": (SOLUTION, RIGHT, ""),
    "half right": (SOLUTION + "\ndef step(f, x, v, h):\n    v = v + h * f(x)\n    return x, v\n", 6, "x is off"),
}


def leftovers() -> list[str]:
    """Processes of sandboxes that this process started: its slot's user as root, else its own descendants."""
    out = subprocess.run(["ps", "-eo", "uid,ppid,args"], capture_output=True, text=True, check=True).stdout
    lines = [line for line in out.splitlines() if "/sandbox/" in line]
    if os.geteuid() == 0:
        return [line for line in lines if line.split()[0] == str(USER + os.getpid() % 4096)]
    return [line for line in lines if line.split()[1] in (str(os.getpid()), "1")]


@pytest.fixture(scope="module", autouse=True)
def holding() -> None:
    check_sandbox()


def graded(source: str | bytes, tmp_path: Path, name: str = "me.py") -> dict[str, Any]:
    path = tmp_path / name
    path.write_bytes(source if isinstance(source, bytes) else source.encode())
    grading.grade_one(grading.Task(ASSIGNMENT, path, tmp_path / "out", SECRET))
    found: dict[str, Any] = json.loads((tmp_path / "out" / "results.json").read_text())
    return found


# All of them in the slow stage; every third in the quick one.
SHARED = [pytest.param(name, marks=[pytest.mark.slow] if i % 3 else []) for i, name in enumerate(ATTACKS)]


@pytest.mark.parametrize("name", SHARED)
def test_an_attack_gets_what_it_earned(name: str, tmp_path: Path) -> None:
    source, score, why = ATTACKS[name]
    found = graded(source, tmp_path)
    told = " | ".join(test["output"] for test in found["tests"])
    assert found["score"] == score, told
    assert found["max_score"] == RIGHT and [test["number"] for test in found["tests"]] == [
        "double",
        "solve",
        "integrate",
    ]
    assert why in told and "FOUND" not in told
    assert not leftovers()


def test_the_search_finds_tests_where_there_are_some(monkeypatch: pytest.MonkeyPatch) -> None:
    names: dict[str, Any] = {}
    monkeypatch.syspath_prepend(str(ASSIGNMENT))
    exec(SEARCH, names)
    with pytest.raises(RuntimeError, match="FOUND"):
        names["double"](1.0)


@pytest.mark.parametrize(
    "data, name, why",
    [
        (b"x = '\xff\xfe'", "me.py", "UTF-8"),
        (b"#" * 10_000_000, "me.py", "at most"),
        (b"{not json", "me.ipynb", "notebook"),
        (b"\x00", "me.py", "not Python"),
    ],
)
def test_a_file_that_is_no_submission(data: bytes, name: str, why: str, tmp_path: Path) -> None:
    found = graded(data, tmp_path, name)
    assert found["score"] == 0 and why in found["output"]


def test_a_link_is_no_submission(tmp_path: Path) -> None:
    (tmp_path / "me.py").symlink_to("/etc/passwd")
    grading.grade_one(grading.Task(ASSIGNMENT, tmp_path / "me.py", tmp_path / "out", SECRET))
    text = (tmp_path / "out" / "feedback.md").read_text()
    assert "not a link" in text and "root:" not in text


@pytest.mark.parametrize("kind", ["directory", "pipe", "nothing"])
def test_what_is_no_file_is_refused_at_once(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "me.py"
    if kind == "directory":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    grading.grade_one(grading.Task(ASSIGNMENT, path, tmp_path / "out", SECRET))
    assert "must be a plain file" in (tmp_path / "out" / "feedback.md").read_text()


NAMES = (
    "..", ".", ".dsim-assignment",
    ".dsim-secret", "grades.csv", "summary.md", "=HYPERLINK(1)", "a\nb", "a\x1b[2Jb", "<img src=x>", "a b",
    "[full marks](http:)", "-rf", "ünï", "a\udcffb", "x" * 240, "CON", "a'b", 'a"b', "a;b", "%2e%2e",
)  # fmt: skip


def test_no_name_of_a_file_does_anything(tmp_path: Path) -> None:
    """Each has a folder of its own inside the grades, a row of its own, and its points."""
    directory, to = tmp_path / "in", tmp_path / "out" / "grades"
    directory.mkdir()
    for name in NAMES:
        Path(os.fsencode(directory).decode(errors="surrogateescape"), f"{name}.py").write_text(SOLUTION)
    for _ in range(2):  # the second run finds everything done
        rows = grading.grade(ASSIGNMENT, grading.submissions_in(directory), to, sandboxed=False)
        assert [row["score"] for row in rows] == [RIGHT] * len(NAMES)
    assert len(list(to.glob("*/results.json"))) == len(NAMES)
    ours = [".dsim-assignment", ".dsim-secret", "grades.csv", "summary.md"]
    assert sorted(path.name for path in to.iterdir() if path.is_file()) == ours
    assert [path.name for path in to.parent.iterdir()] == ["grades"]
    table = (to / "grades.csv").read_bytes().decode()
    assert len(table.splitlines()) == 1 + len(NAMES) and "\x1b" not in table and "\n=" not in table
    assert not any(re.search(r"(?<!\\)<img", path.read_text()) for path in to.glob("*/feedback.md"))


def test_a_page_in_a_message_is_text(tmp_path: Path) -> None:
    graded(ATTACKS["a page in a message"][0], tmp_path)
    text = (tmp_path / "out" / "feedback.md").read_text()
    assert "\\<script>" in text and "\\[full marks\\](http" in text and "\x1b" not in text and "\\`x\\`" in text


@pytest.mark.parametrize(
    "text",
    [
        "[" * 100_000, '{"cells": 3}', '{"cells": [null]}', '{"cells": [{"cell_type": "code", "source": 3}]}', "NaN",
        '{"cells": [{"cell_type": "code", "source": ["a", 1]}]}', '{"cells": ' + "9" * 10_000 + "}",
        '{"cells": [{"cell_type": "code", "metadata": {"tags": 3}, "source": "x"}]}', "null", '"cells"',
        '{"cells": [{"cell_type": "code", "metadata": [], "source": "x"}]}', '{"cells": {"cell_type": "code"}}',
    ],
)  # fmt: skip
def test_an_odd_notebook_is_one_clear_error(text: str, tmp_path: Path) -> None:
    found = graded(text, tmp_path, "me.ipynb")
    assert found["score"] == 0 and "must be a notebook" in found["output"]


def test_nothing_of_an_item_is_left_for_the_next(tmp_path: Path) -> None:
    """A global, a patched module and a file: the next item's child sees none but the file."""
    source = (
        "import numpy as np\ncount = []\n"
        "def double(x):\n    count.append(1)\n    np.linalg.solve = None\n    return 2 * x\n"
        "def solve(A, b):\n    assert not count\n    return np.linalg.solve(A, b)\n"
    )
    assert graded(source, tmp_path)["score"] == 5


def test_the_sandbox_restarts_after_it_was_killed(tmp_path: Path) -> None:
    (tmp_path / "me.py").write_text(
        "import os, signal\ndef die():\n    os.kill(os.getppid(), signal.SIGKILL)\ndef live():\n    return 1\n"
    )
    with SandboxedStudent(Jail(tmp_path / "me.py", ASSIGNMENT, os.getpid() % 4096)) as student:
        with pytest.raises((StudentReply, StudentTimeout)), student.item(2.0):
            student.call("die")
        with student.item(2.0):
            assert student.call("live") == 1
    assert not leftovers()


@pytest.mark.skipif(os.geteuid() != 0, reason="this run is by an ordinary user already")
def test_it_holds_for_an_ordinary_user() -> None:
    """Who makes the name space owns what bubblewrap puts into it: all of that must be read-only too."""
    with TemporaryDirectory() as directory:
        os.chmod(directory, 0o755)
        shutil.copytree(Path(dsim.__file__).parent, Path(directory, "dsim"))
        subprocess.run(["chmod", "-R", "a+rX", directory], check=True)
        packages = Path(np.__file__).parents[1]
        environment = {"PATH": "/usr/bin:/bin", "HOME": "/tmp", "PYTHONPATH": f"{directory}:{packages}"}
        user = ["setpriv", "--reuid", "64321", "--regid", "64321", "--clear-groups", "env"]
        wanted = f"import sys; assert sys.version_info[:2] == {sys.version_info[:2]}; import numpy, scipy"
        for python in (os.path.realpath(sys.executable), "/usr/bin/python3"):
            given = {"cwd": directory, "env": environment, "capture_output": True, "text": True}
            with suppress(OSError):
                if subprocess.run([*user, python, "-c", wanted], **given).returncode == 0:  # type: ignore[call-overload]
                    break
        else:
            pytest.skip("no Python here that another user may run")
        program = "from dsim.grading.sandbox import check_sandbox; check_sandbox(); print('holds')"
        found = subprocess.run([*user, python, "-c", program], **given)  # type: ignore[call-overload]
    assert found.stdout == "holds\n", found.stderr


def test_without_the_filter_nothing_is_graded(monkeypatch: pytest.MonkeyPatch) -> None:
    assert seccomp.program("riscv64") == b"" and len(seccomp.program("x86_64")) == 8 * 9
    monkeypatch.setattr(seccomp, "program", lambda: b"")
    with pytest.raises(SandboxError, match="memory of no process is refused"):
        check_sandbox()


def test_without_bubblewrap_nothing_is_graded(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(SandboxError, match="apt-get install bubblewrap"):
        check_sandbox()


@pytest.mark.parametrize(
    "weaker, statement",
    [
        ({"PROCESSES": 5000}, "a fork burst is stopped"),
        ({"MEMORY": 2**40}, "8 GB are refused"),
    ],
)
def test_a_sandbox_that_does_not_hold_is_refused(
    weaker: dict[str, int], statement: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Mutation: the self-test must be able to fail."""
    from dsim.grading import sandbox

    command = sandbox.Jail.command
    before = {name: str(getattr(sandbox, name)) for name in weaker}

    def loosened(self: Jail) -> list[str]:
        words = command(self)
        flags = {"PROCESSES": "--nproc=", "MEMORY": "--as="}
        for name, value in weaker.items():
            words[words.index(flags[name] + before[name])] = f"{flags[name]}{value}"
        return words

    monkeypatch.setattr(sandbox.Jail, "command", loosened)
    monkeypatch.setattr(sandbox, "RESIDENT", 2**40)
    if statement.startswith("8 GB") and os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGESIZE") < 12 * 2**30:
        pytest.skip("this machine has no 8 GB to give")
    with pytest.raises(SandboxError, match=statement):
        sandbox.check_sandbox()


@pytest.mark.parametrize("times, proven", [(1, True), (2, False)])
def test_a_probe_that_dies_is_sent_once_more(times: int, proven: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    answers = [(["there is no network (your code ended its process)"], True)] * times + [([], False)]
    monkeypatch.setattr("dsim.grading.sandbox._unproven", lambda: answers.pop(0))
    if proven:
        check_sandbox()
    else:
        with pytest.raises(SandboxError, match="there is no network"):
            check_sandbox()


def test_a_probe_that_is_refuted_is_not_sent_again(monkeypatch: pytest.MonkeyPatch) -> None:
    answers = [(["there is no network"], False)]
    monkeypatch.setattr("dsim.grading.sandbox._unproven", lambda: answers.pop(0))
    with pytest.raises(SandboxError, match="there is no network"):
        check_sandbox()
