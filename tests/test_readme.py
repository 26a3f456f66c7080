"""The README says what is true: its tables come from the catalog, its code runs, its commands are the tested ones."""

import re
from pathlib import Path

import numpy as np
import pytest

from dsim.report.readme import updated

README = Path(__file__).parent.parent / "README.md"
TEXT = README.read_text()
BLOCKS = re.findall(r"```python\n(.*?)```", TEXT, flags=re.S)

EFFECT = next(block for block in BLOCKS if "trap" in block)


def test_tables_are_those_of_the_catalog():
    assert updated(TEXT) == TEXT, "run: python -m dsim.report.readme"


def test_a_stale_table_is_noticed():
    assert updated(TEXT.replace("| `RK4` | 4 |", "| `RK4` | 5 |")) == TEXT
    with pytest.raises(ValueError, match=r"README\.md must contain"):
        updated("nothing")


def test_the_cloth_prints_a_checked_gradient(capsys):
    exec(BLOCKS[0], {"__name__": "readme"})
    assert "verdict   smooth" in capsys.readouterr().out


def test_ten_lines_are_ten():
    section = TEXT[TEXT.index("## Ten lines") :]
    assert BLOCKS[0] in section and len([line for line in BLOCKS[0].splitlines() if line.strip()]) == 10


def test_the_effect_is_checked(capsys):
    exec(EFFECT, {"__name__": "readme"})
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) >= 8 and all(line.startswith("pass  trap ") and len(line) <= 80 for line in lines)
    quoted = re.search(r"```text\n(.*?)```", TEXT, flags=re.S).group(1).splitlines()
    statements = [line.split(";")[0] for line in lines]
    assert [line.split(";")[0] for line in quoted] == statements[: len(quoted)]


def test_the_effect_without_its_derivative_is_red(capsys):
    source = re.sub(r"    def dq.*?(?=    def dtheta)", "", EFFECT, flags=re.S)
    exec(source, {"__name__": "readme"})
    assert "FAIL  trap 2-D: dq of the force" in capsys.readouterr().out


def test_a_method_of_ones_own_is_put_on_the_plane(capsys):
    block = next(block for block in BLOCKS if "class Heun" in block)
    exec(block, {"__name__": "readme"})
    found = re.fullmatch(r"order (\S+); cheapest for 1e-6: RK4\n", capsys.readouterr().out)
    assert found and abs(float(found[1]) - 2) < 0.1


def test_a_throw_is_aimed(capsys):
    names: dict = {"__name__": "readme"}
    exec(next(block for block in BLOCKS if "def throw" in block), names)
    assert names["found"].converged and names["found"].value < 1e-8 and capsys.readouterr().out


def test_a_racket_turns_over(capsys):
    names: dict = {"__name__": "readme"}
    exec(next(block for block in BLOCKS if "racket = inertia" in block), names)
    spin, by_inertia = names["run"].y[:, 11], names["by_inertia"].ravel()
    assert spin[0] == 6 and spin[-1] < -4 and capsys.readouterr().out
    assert abs(by_inertia @ names["body"].theta[1:]) < 1e-9 * np.abs(by_inertia).max() and np.abs(by_inertia).max() > 1


def test_a_network_learns_to_throw(capsys):
    pytest.importorskip("torch", reason="torch is not installed: pip install -e '.[layers]'")
    names: dict = {"__name__": "readme"}
    exec(next(block for block in BLOCKS if "torch_layer" in block), names)
    off = names["miss"](names["targets"][12:]).detach()
    assert names["before"] > 2 and off.mean() < 0.1 and off.max() < 0.3 and " m after" in capsys.readouterr().out


def test_the_quoted_stepper_is_the_real_one():
    source = (README.parent / "dsim/steppers/euler.py").read_text()
    assert BLOCKS[1].splitlines()[-1].strip() == "return y[0] + h * phi(t + h, y[1])"
    assert BLOCKS[1].splitlines()[-1] in source


def test_the_two_commands_stand_at_the_top():
    top = TEXT[: TEXT.index("## ")]
    assert "\npython -m pip install . && dsim verify\n" in top
    assert '\npython -m pip install -e ".[test]" && pytest\n' in top


def test_every_linked_file_exists():
    for target in re.findall(r"\]\(([^)#]+)\)", TEXT):
        assert (README.parent / target).exists(), target
