"""`dsim show`: pictures that show something, errors that help, nothing half-written."""

import io

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from dsim import catalog, scenes
from dsim.cli import app
from dsim.pictures import animation
from dsim.pictures import scene as pictures
from dsim.pictures.style import to_png
from dsim.report import showing


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*arguments):
    return CliRunner().invoke(app, ["show", *arguments])


def ink(data):
    """The variance of a picture's pixels: 0 for a blank one."""
    return float(np.asarray(Image.open(io.BytesIO(data)).convert("L"), dtype=float).var())


def test_a_blank_picture_has_no_ink():
    blank = io.BytesIO()
    Image.new("RGB", (40, 40), "white").save(blank, "PNG")
    assert ink(blank.getvalue()) == 0


def test_a_filmstrip_is_the_default(folder):
    result = run("projectile")
    assert result.exit_code == 0 and result.stdout == "wrote projectile.png\n"
    assert ink((folder / "projectile.png").read_bytes()) > 1
    assert [p.name for p in folder.iterdir()] == ["projectile.png"]


def test_an_animation(folder):
    result = run("river", "--to", "leaf.gif", "--steps", "30")
    with Image.open(folder / "leaf.gif") as picture:
        assert result.exit_code == 0 and picture.n_frames == 31 and picture.info["duration"] >= 20


def test_a_run_that_blows_up_is_drawn_as_far_as_it_went(folder):
    result = run("pendulum_stiff", "--stepper", "forward_euler", "--energy", "energy.png")
    assert result.exit_code == 1
    assert "ForwardEuler failed in step" in result.stderr and "not_finite" in result.stderr
    assert (folder / "pendulum_stiff.png").exists() and (folder / "energy.png").exists()


def test_the_list_names_every_scene():
    result = run("--list")
    assert result.exit_code == 0 and len(result.stdout.splitlines()) == len(catalog.SCENES)
    assert run().exit_code == 2


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["clot"], "got 'clot'; did you mean cloth"),
        (["unicorn"], "there are projectile, "),
        (["cloth", "--stepper", "RK5"], "did you mean RK4"),
        (["cloth", "--to", "cloth.txt"], "--to must end in .png, .svg, .gif, .mp4; got cloth.txt"),
        (["river", "--energy", "e.png"], "river is a first-order flow"),
        (["kepler", "--h", "-1"], "h must be > 0"),
        (["kepler", "--steps", "-1"], "steps must be a whole number >= 0"),
        (["river", "--stepper", "VelocityVerlet"], "needs a second-order System"),
    ],
)
def test_bad_usage_is_one_clear_line(folder, arguments, message):
    result = run(*arguments)
    assert isinstance(result.exception, ValueError) and message in str(result.exception)
    assert list(folder.iterdir()) == []


def test_a_window_needs_a_display(folder, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    assert "there is none; use --to FILE.gif" in str(run("kepler", "--screen").exception)


def test_an_mp4_without_ffmpeg_says_so(folder, monkeypatch):
    monkeypatch.setattr(animation.shutil, "which", lambda name: None)
    assert "needs the program ffmpeg" in str(run("kepler", "--to", "k.mp4", "--steps", "3").exception)
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("build", catalog.SCENES, ids=lambda b: b.__name__)
def test_every_scene_can_be_drawn(build):
    small = {"cloth": {"n": 5}, "soft_body": {"floors": 3}, "chain": {"links": 6}}
    scene = build(**small.get(build.__name__, {}), steps=20)
    run = scene.simulate()
    assert ink(to_png(pictures.filmstrip(scene, run), dpi=50)) > 1
    if scene.system.components == 2:
        assert ink(to_png(pictures.energy(scene, run), dpi=50)) > 1


def test_steppers_are_found_by_any_spelling():
    for name in ("BackwardEuler", "backward_euler", "backward-euler", "BACKWARDEULER"):
        assert type(showing.prepared("cloth", name).stepper).__name__ == "BackwardEuler"


def test_real_time_where_it_fits():
    run = scenes.river().simulate()
    assert 2500 <= animation.milliseconds(run) * len(animation.chosen(run)) <= 5300


def test_steppers_of_bodies_have_names_too(tmp_path):
    result = CliRunner().invoke(
        app, ["show", "racket", "--stepper", "rkmk4", "--steps", "5", "--to", str(tmp_path / "a.png")]
    )
    assert result.exit_code == 0 and (tmp_path / "a.png").exists()
    refused = CliRunner().invoke(app, ["show", "racket", "--stepper", "bdf2", "--to", str(tmp_path / "b.png")])
    assert "looks back over two states" in str(refused.exception) and not (tmp_path / "b.png").exists()
