"""Parts of the report's gradients section: green as they are, red where what they show is not so."""

from __future__ import annotations

from dataclasses import replace

import pytest

from dsim import catalog
from dsim.report import gradients
from dsim.steppers.checkpoints import Checkpoints
from dsim.studies import horizons


def test_the_verdicts_of_the_report_are_green_and_can_be_red(monkeypatch: pytest.MonkeyPatch) -> None:
    few = [bug for bug in catalog.PLANTED if bug.name == "guarded division"]
    monkeypatch.setattr(gradients.catalog, "PLANTED", tuple(few))
    part = gradients.verdicts(lambda text: None, False)
    assert part.checks and all(check.passed for check in part.checks)
    table = part.tables[0]
    names = ["dsim", "logistic map, 4 steps", "logistic map, 60 steps", "ball over a wall"]
    assert [row[0] for row in table.rows] == names
    unforeseen = [replace(bug, wrong={}) for bug in few]
    monkeypatch.setattr(gradients.catalog, "PLANTED", tuple(unforeseen))
    monkeypatch.setattr(gradients.horizons, "logistic", lambda n: horizons.over_the_wall())
    red = [check.statement for check in gradients.verdicts(lambda text: None, False).checks if not check.passed]
    assert 'descent: the verdict is "chaotic"' in red and "found in the blocks and from the steps foretold" in red


def test_the_checkpoints_of_the_report_are_green_and_can_be_red(monkeypatch: pytest.MonkeyPatch) -> None:
    assert all(check.passed for check in gradients.checkpoints(lambda text: None, False).checks)
    monkeypatch.setattr(Checkpoints, "advances", lambda self, steps: 60)
    red = [check.passed for check in gradients.checkpoints(lambda text: None, False).checks]
    assert not any(red)
