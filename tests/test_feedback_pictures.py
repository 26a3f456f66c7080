"""Pictures beside the feedback: drawn whatever the numbers are, telling no input of a hidden item."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from dsim.arrays.checks import Array
from dsim.cli import app
from dsim.grading import compare, items, results
from dsim.grading.curves import Entries, Lines, Picture
from dsim.grading.results import Graded
from dsim.grading.student import ItemLost

ITEM = items.Item("spin", "Spin", 2, "public", 1.0, "Look again.")


def pixels(png: bytes) -> Array:
    with Image.open(io.BytesIO(png)) as image:
        return np.asarray(image.convert("RGB"), dtype=float)


def lost(picture: Picture | None, visible: items.Visibility = "public") -> items.Outcome:
    return items.Outcome(replace(ITEM, visible=visible), 1.0, "off", picture=picture)


ODD = (0.0, 1e300, -1e300, np.nan, np.inf, 5e-324, -1.0)


@pytest.mark.parametrize(("found", "expected"), list(zip(ODD, 3 * [0.0, 1e300, 2e-300], strict=False)))
def test_a_picture_is_drawn_of_any_numbers(found: float, expected: float) -> None:
    pair = np.full(6, expected), np.array([found, 0.0, 1.0, found, -found, 1e-9])
    for shape in ((3, 2), (6,)):
        for public in (True, False):
            png = Entries("x", *(z.reshape(shape) for z in pair), 1e-9).png(public)
            assert len(png) < 60_000 and pixels(png).std() > 1
    logs: tuple[Literal["", "y", "xy"], ...] = ("", "y", "xy")
    for log in logs:
        drawn = (("yours", np.arange(6), pair[1]), ("right", np.arange(6), pair[0]))
        assert pixels(Lines("x", "h (s)", "error", drawn, log).png(True)).std() > 1


def test_what_is_large_is_cut() -> None:
    assert len(Entries("x", np.zeros((300, 300)), np.ones((300, 300)), 1e-9).png(True)) < 200_000
    assert len(Lines("x", "t (s)", "y", (("a", np.arange(10**6), np.arange(10**6)),)).png(True)) < 100_000


def test_a_hidden_item_shows_errors_and_no_values() -> None:
    """The same errors of other values: the hidden item's picture is the same, the public one's is not."""
    rng = np.random.default_rng(1)
    for shape in ((4,), (3, 3)):
        one, other, error = rng.normal(size=(3, *shape))
        error = np.round(64 * error) / 64
        one, other = np.round(64 * one) / 64, np.round(64 * other) / 64  # so that sums are exact
        pictures = [Entries("x", values, values + error, 1e-9) for values in (one, other)]
        assert pictures[0].png(public=False) == pictures[1].png(public=False)
        assert pictures[0].png(public=True) != pictures[1].png(public=True)
        assert results.picture_of(lost(pictures[0], "hidden")) is None  # every entry is off: words say as much
        error.flat[0] = 0.0
        some = Entries("x", one, one + error, 1e-9)
        assert results.picture_of(lost(some, "hidden")) == some.png(public=False)


def test_comparisons_bring_their_picture() -> None:
    with pytest.raises(ItemLost) as entries:
        compare.close("x", np.array([1.0, 3.0]), [1.0, 2.0], 1e-9)
    assert isinstance(entries.value.picture, Entries) and entries.value.picture.tolerance == 2e-9
    with pytest.raises(ItemLost) as number:
        compare.close("x", 1.0, 2.0, 1e-9)
    assert number.value.picture is None
    h = np.array([0.1, 0.05])
    assert compare.order(h, 3 * h**2, 2, 1.8, 2.2) == pytest.approx(2)
    with pytest.raises(ItemLost, match=r"order is 1\.0; it must be about 2") as slope:
        compare.order(h, h, 2, 1.8, 2.2)
    assert isinstance(slope.value.picture, Lines) and slope.value.picture.log == "xy"
    for errors in ([0.0, 0.0], [np.inf, np.inf], [np.nan, 1.0]):
        with pytest.raises(ItemLost):
            compare.order(h, errors, 2, 1.8, 2.2)


def test_feedback_links_its_pictures_and_old_ones_go(tmp_path: Path) -> None:
    picture = Entries("x", np.zeros(2), np.ones(2), 1e-9)
    results.write(Graded("ann", (lost(picture),)), tmp_path)
    assert (
        "](spin.png)" in (tmp_path / "feedback.md").read_text() and pixels((tmp_path / "spin.png").read_bytes()).any()
    )
    results.write(Graded("ann", (lost(None),)), tmp_path)
    assert "spin.png" not in (tmp_path / "feedback.md").read_text() and not (tmp_path / "spin.png").exists()
    right = items.Outcome(ITEM, 2.0, picture=picture)
    assert results.picture_of(right) is None


def test_a_picture_that_cannot_be_drawn_costs_nothing(tmp_path: Path) -> None:
    broken = Entries("x", np.zeros(2), np.zeros((3, 3)), 1e-9)
    results.write(Graded("ann", (lost(broken),)), tmp_path)
    assert json.loads((tmp_path / "results.json").read_text())["score"] == 1.0


def test_check_submission_draws_public_items(tmp_path: Path) -> None:
    root = Path(__file__).parents[1] / "assignments"
    file = tmp_path / "01_time_stepping.py"
    file.write_text((root / "01_time_stepping" / "mutants" / "wind_has_the_wrong_sign.py").read_text())
    command = ["check-submission", str(file), "--assignments", str(root)]
    found = CliRunner().invoke(app, command)
    assert found.exit_code == 1 and "forces.png" in found.stdout.replace("\n", "")
    assert pixels((tmp_path / "01_time_stepping-feedback" / "forces.png").read_bytes()).std() > 1
    file.write_text((root / "01_time_stepping" / "solution.py").read_text())
    found = CliRunner().invoke(app, command)
    assert found.exit_code == 0 and "Picture" not in found.stdout
    assert not list((tmp_path / "01_time_stepping-feedback").iterdir())
