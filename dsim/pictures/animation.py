"""A scene as an animation: GIF, MP4 where ffmpeg is installed, or a window."""

from __future__ import annotations

import io
import os
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from dsim.pictures.files import write_atomically
from dsim.pictures.scene import draw_frame, dress, dress_figure, film
from dsim.pictures.style import canvas, style
from dsim.scenes import Scene
from dsim.simulation import Trajectory

FRAMES = 80  # at the most
SECONDS = 5.0  # that an animation lasts, at most and at least half of it


def chosen(trajectory: Trajectory) -> list[int]:
    """The states to draw, equally spaced."""
    last = len(trajectory.t) - 1
    return [int(n) for n in np.unique(np.linspace(0, last, min(FRAMES, last + 1)).round())]


def milliseconds(trajectory: Trajectory) -> int:
    """The time of a frame: real time where the whole then lasts between 2.5 and 5 seconds."""
    duration = float(np.clip(trajectory.t[-1], SECONDS / 2, SECONDS))
    return max(20, round(1000 * duration / len(chosen(trajectory))))


@style()
def images(scene: Scene, trajectory: Trajectory, dpi: int = 80) -> list[Image.Image]:
    """Every frame as a picture, all of one size."""
    ready = film(scene, trajectory)
    width, height = ready.box[1] - ready.box[0]
    figure, axes = canvas(size=(7.2, float(np.clip(6.0 * height / width + 0.9, 2.5, 7.0))))
    figure.set_dpi(dpi)
    surface = FigureCanvasAgg(figure)
    found: list[Image.Image] = []
    for n in chosen(trajectory):
        axes.clear()
        draw_frame(axes, ready, n)
        dress(axes, ready)
        if not found:  # laid out once: quicker, and nothing jumps from frame to frame
            dress_figure(figure, [axes], ready)
            figure.suptitle(scene.name.replace("_", " "), x=0.01, ha="left", fontsize=12, fontweight="bold")
            surface.draw()
            figure.set_layout_engine("none")
        surface.draw()
        found.append(Image.fromarray(np.asarray(surface.buffer_rgba())).convert("RGB"))
    return found


def write(scene: Scene, trajectory: Trajectory, path: str | Path) -> Path:
    """Write a `.gif` or `.mp4`, completely or not at all.  Raises ValueError for .mp4 without ffmpeg."""
    path = Path(path)
    if path.suffix.lower() == ".mp4":
        program = _ffmpeg()  # asked for before the frames are drawn
        return write_atomically(path, _mp4(program, images(scene, trajectory), milliseconds(trajectory)))
    first, *rest = (image.quantize(128, dither=Image.Dither.NONE) for image in images(scene, trajectory))
    with io.BytesIO() as buffer:
        options: dict[str, Any] = {"duration": milliseconds(trajectory), "loop": 0, "save_all": True}
        first.save(buffer, format="GIF", append_images=rest, **options)
        return write_atomically(path, buffer.getvalue())


def _ffmpeg() -> str:
    program = shutil.which("ffmpeg")
    if program is None:
        raise ValueError("an .mp4 needs the program ffmpeg, which is not installed; use .gif, or install it")
    return program


def _mp4(program: str, frames: list[Image.Image], duration: int) -> bytes:
    import subprocess

    with tempfile.TemporaryDirectory() as directory:
        for number, frame in enumerate(frames):
            frame.crop((0, 0, frame.width // 2 * 2, frame.height // 2 * 2)).save(f"{directory}/{number:04d}.png")
        target = Path(directory) / "out.mp4"
        rate = f"{1000 / duration:.3f}"
        source = ["-framerate", rate, "-i", f"{directory}/%04d.png"]
        command = [program, "-loglevel", "error", *source, "-pix_fmt", "yuv420p", str(target)]
        subprocess.run(command, check=True, stdin=subprocess.DEVNULL)
        return target.read_bytes()


def require_screen() -> None:
    """Raises ValueError where no window can be opened."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ValueError("--screen needs a display, and there is none; use --to FILE.gif")
    import matplotlib.pyplot as plt
    from matplotlib.backends.registry import BackendFilter, backend_registry

    windows = [name.lower() for name in backend_registry.list_builtin(BackendFilter.INTERACTIVE)]
    if plt.get_backend().lower() not in windows:  # without a toolkit, matplotlib would draw and show nothing
        raise ValueError("--screen needs a window toolkit for matplotlib, such as Tk or Qt; use --to FILE.gif")


def on_screen(scene: Scene, trajectory: Trajectory) -> None:
    """Play the animation in a window until it is closed."""
    import matplotlib.pyplot as plt
    from matplotlib.animation import FuncAnimation

    frames = images(scene, trajectory)
    figure, axes = plt.subplots(figsize=(frames[0].width / 80, frames[0].height / 80))
    axes.set_axis_off()
    shown = axes.imshow(np.asarray(frames[0]))

    def draw(number: int) -> Any:
        shown.set_data(np.asarray(frames[number]))
        return (shown,)

    player = FuncAnimation(figure, draw, frames=len(frames), interval=milliseconds(trajectory))
    figure.dsim_player = player  # type: ignore[attr-defined]  # an animation dies with its last reference
    plt.show()
