"""Rigid bodies in pictures: plates, boxes and rackets as shaded polygons, and films of them.

A shape is a list of faces, (corners (K,3) m in the frame of the body, colour).  Every picture looks from the same side,
from the front, right and above; what lies farther off is drawn first.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from dsim.arrays import rotation
from dsim.arrays.checks import Array
from dsim.geometry import box_faces, racket_faces
from dsim.pictures.style import COLOURS, canvas, label, look, style
from dsim.rigid import RigidBodies
from dsim.studies.showcases.racket import Racket
from dsim.studies.showcases.tumbling import Tumbling

Face = tuple[Array, str]
UP, DOWN, SIDE, GRIP = COLOURS[0], COLOURS[5], "#c9d1d9", "#6e5849"
LIGHT = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])
RIGHT, AWAY = np.array([0.9, 0.44, 0.0]), np.array([-0.39, 0.8, -0.46])  # of the picture, and into it
RIGHT, AWAY = RIGHT / np.linalg.norm(RIGHT), AWAY / np.linalg.norm(AWAY)
ABOVE = np.cross(RIGHT, AWAY)


def box(size: Any, at: Any = (0.0, 0.0, 0.0), sides: str = SIDE) -> list[Face]:
    """A box (3,) m: its upper face (+z of the body) blue, its lower one orange, so that a flip is seen."""
    colours = [sides] * 4 + ([UP, DOWN] if sides == SIDE else [sides] * 2)
    return list(zip(box_faces(size, at), colours, strict=True))


def racket(length: float = 0.68, width: float = 0.26) -> list[Face]:
    """A tennis racket along x, its handle at -x: the head a flat plate, blue above and orange below."""
    return list(zip(racket_faces(length, width), [UP, DOWN] + [GRIP] * 6, strict=True))


def placed(shape: Sequence[Face], pose: Array) -> list[Face]:
    """The faces in the world, of a body at pose (7,) = (centre, quaternion)."""
    turn = np.asarray(pose[3:], dtype=float)[None]
    return [(pose[:3] + rotation.rotate(turn, corners), colour) for corners, colour in shape]


def draw(axes: Axes, faces: Sequence[Face], shift: Any = (0.0, 0.0)) -> None:
    """Faces in the world, far ones first; a face in the light is brighter."""
    corners = [points for points, _ in faces]
    order = np.argsort([-(points @ AWAY).mean() for points in corners])
    shown = [np.stack([corners[i] @ RIGHT, corners[i] @ ABOVE], axis=1) + shift for i in order]
    colours = [shaded(corners[i], faces[i][1]) for i in order]
    axes.add_collection(PolyCollection(shown, facecolors=colours, edgecolors="#1f2328", linewidths=0.5))


def shaded(points: Array, colour: str) -> tuple[float, ...]:
    """The colour of a face with corners (K,3) in the world, darker where it is turned away from the light."""
    across = np.cross(points[1] - points[0], points[2] - points[1])
    lit = abs(across @ LIGHT) / max(float(np.linalg.norm(across)), 1e-300)
    return tuple(1 - (0.45 + 0.55 * lit) * (1 - np.array(to_rgb(colour))))


def film(axes: Axes, system: RigidBodies, states: Array, shapes: Sequence[Sequence[Face]], apart: float) -> None:
    """Bodies at the states (K,ny), each state `apart` m to the right of the one before, whatever the centres do."""
    for number, y in enumerate(states):
        poses = system.frame.poses(y[: system.width])
        poses = np.concatenate([poses[:, :3] - poses[:, :3].mean(axis=0), poses[:, 3:]], axis=1)
        faces = [face for shape, pose in zip(shapes, poses, strict=True) for face in placed(shape, pose)]
        draw(axes, faces, (number * apart, 0.0))
    axes.set(xlim=(-0.6 * apart, (len(states) - 0.4) * apart), aspect="equal", xticks=[], yticks=[])
    axes.set_ylim(-0.62 * apart, 0.62 * apart)
    axes.spines[:].set_visible(False)


@style()
def flip(system: RigidBodies, t: Array, y: Array, flips: Array) -> Figure:
    """A racket that turns about its middle axis, each time its handle comes back to where it was: only the flips
    show; below, omega_2 with the flips by elliptic functions."""
    figure, (above, below) = canvas(2, 1, (9.5, 4.6), height_ratios=[1, 1.4])
    chosen = _returns(rotation.rotate(y[:, 3:7], np.array([1.0, 0.0, 0.0])))
    film(above, system, y[chosen], [racket()], 0.72)
    above.set_title("Thrown about its middle axis, a racket turns over; blue is its upper face")
    below.plot(t, y[:, 11], **{**look(0), "marker": ""}, label="simulated")
    below.plot(flips, 0 * flips, "o", color=COLOURS[1], label="flips, by elliptic functions")
    below.plot(
        t[chosen], y[chosen, 11], "|", color="#57606a", markersize=14, label="frames of the film, after each turn"
    )
    label(below, "time (s)", "omega_2 (rad/s)")
    below.legend(loc="upper right", fontsize=9, ncols=3)
    below.set_ylim(-1.35, 1.75)
    return figure


def _returns(handle: Array) -> Array:
    """Where a direction (K,3) is nearest to its first one, turn after turn."""
    near = handle @ handle[0]
    peaks = np.flatnonzero((near[1:-1] > near[:-2]) & (near[1:-1] >= near[2:]) & (near[1:-1] > 0.5)) + 1
    return np.concatenate([[0], peaks])


@style()
def caught(result: Racket, frames: int = 9) -> Figure:
    """The racket at nine times of its flight: above after a plain turn, below with the spin that was found."""
    figure, panels = canvas(2, 1, (10.0, 3.6))
    rows = (("one plain turn", result.before), ("the spin found", result.after))
    for axes, (words, run) in zip(panels, rows, strict=True):
        chosen = np.linspace(0, result.toss.steps, frames).round().astype(int)
        film(axes, result.toss.system, run.y[chosen], [racket()], 0.72)
        face, handle = result.toss.angles(run)
        axes.set_title(f"{words}: the face is {face:.1f} degrees off at the end, the handle {handle:.1f}", fontsize=11)
    for number, n in enumerate(chosen):
        panels[1].annotate(f"{n * result.toss.h:.2f} s", (number * 0.72, -0.44), ha="center", fontsize=9)
    return figure


@style()
def weighed(result: Tumbling) -> Figure:
    """Found against true, each with its bar, in percent of the largest moment and of the spin; and without a push."""
    figure, (left, right) = canvas(1, 2, (10.0, 4.2), width_ratios=[1, 1.2])
    names = ("I_xx", "I_yy", "I_zz", "I_yz", "I_xz", "I_xy", "w_x", "w_y", "w_z")
    truth, places = result.sight.truth, np.arange(9)
    percent = 100 / np.repeat([np.abs(truth[:6]).max(), np.linalg.norm(truth[6:])], [6, 3])
    error, bars = percent * (result.noisy.stiffness - truth), percent * result.noisy.bars
    left.errorbar(error, places, xerr=bars, fmt="o", color=COLOURS[0], capsize=4, label="found - true, 95 %")
    left.axvline(0.0, color="#57606a", linewidth=1)
    left.set_yticks(places, names)
    left.invert_yaxis()
    label(left, "error (% of the largest moment, of |w|)", "number", "from one film, marks seen to 1 mm")
    left.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), fontsize=9)
    for row, (words, one) in enumerate((("pushed by a known torque", result.noisy), ("free", result.free))):
        known, top = np.isfinite(one.bars), 10 * float(bars.max())
        right.semilogy(places[known], (percent * one.bars)[known], **{**look(row), "linestyle": ""}, label=words)
        if not known.all():
            right.plot(
                places[~known], np.full((~known).sum(), top), "^", color=look(row)["color"], label="no end: unknown"
            )
    right.set_xticks(places, names, fontsize=9)
    label(right, "number", "half a bar (%)", "what a free body does not tell: its size")
    right.legend(fontsize=9)
    return figure
