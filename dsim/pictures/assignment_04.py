"""The picture of success of assignment 04."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from dsim.arrays.checks import Array
from dsim.arrays.rotation import conjugate, exponential, product, rotate
from dsim.geometry.inertia import box
from dsim.pictures.scene import projected
from dsim.pictures.style import COLOURS, label, look, style
from dsim.rigid import RigidBodies
from dsim.simulation import record
from dsim.steppers.euler import NormalisedEuler

SIDES = np.array([2.0, 1.0, 0.3])  # m
SPIN = np.array([0.05, 4.0, 0.05])  # rad/s, nearly about the axis of the middle moment
STEP, STEPS, FRAMES = 0.02, 600, 7
FACES = ((0, -1), (0, 1), (1, -1), (1, 1), (2, -1), (2, 1))  # axis and side
PAINT = (COLOURS[5], COLOURS[1], COLOURS[6], COLOURS[0], "#D8DEE4", "#8C959F")


def inertia() -> Array:
    """Of the box, 1 kg."""
    return np.asarray(box(SIDES, 1.0).inertia)


def carried() -> tuple[Array, Array]:
    """Attitudes (N+1,4) and spins (N+1,3) of the midpoint rule that carries the momentum in the world."""
    moments = np.diag(inertia())
    q, w = np.array([1.0, 0.0, 0.0, 0.0]), SPIN
    momentum, found = moments * w, [(q, w)]
    for _ in range(STEPS):
        middle = product(q, exponential(STEP / 2 * w))
        q = product(q, exponential(STEP * rotate(conjugate(middle), momentum) / moments))
        w = rotate(conjugate(q), momentum) / moments
        found.append((q, w))
    return np.array([one for one, _ in found]), np.array([one for _, one in found])


def looped() -> tuple[Array, Array]:
    """The same of the lecture's loop, by dsim's stepper."""
    body = RigidBodies([1.0], inertia()[None])
    run = record(NormalisedEuler(), body, body.state(np.zeros((1, 3)), spin=SPIN), STEP, STEPS)
    return run.q[:, 3:7], run.v[:, 3:]


@style()
def tumbling() -> Figure:
    """A box that turns over, frame by frame; its spin; and what must not change, for both methods."""
    figure = Figure(figsize=(9.0, 5.6))
    film, curves = np.asarray(figure.subfigures(2, 1, height_ratios=[1.0, 2.4]))
    t, (Q, W) = STEP * np.arange(STEPS + 1), carried()
    for panel, n in zip(film.subplots(1, FRAMES), frames(W), strict=True):
        draw(panel, Q[n])
        panel.set_title(f"{t[n]:.1f} s", loc="center", fontsize=10, fontweight="normal")
    left, right = curves.subplots(1, 2)
    for i, name in enumerate(("the long edge", "the middle edge", "the short edge")):
        left.plot(t, W[:, i], **{**look(i), "marker": ""}, label=name)
    label(left, "time (s)", "spin about the edges (rad/s)", "A free box turns over")
    left.set_ylim(-4.5, 7.5)
    left.legend(fontsize=9, loc="upper center", ncols=2)
    for i, (name, run) in enumerate((("free_body", (Q, W)), ("the lecture's loop", looped()))):
        for what, change, dash in zip(("momentum", "energy"), changes(*run), ("-", "--"), strict=True):
            shown = np.maximum(change[1:], 1e-17)
            right.semilogy(t[1:], shown, color=COLOURS[i], linestyle=dash, label=f"{what}, {name}")
    label(right, "time (s)", "change since the start, relative", f"What should stay, h = {STEP} s")
    right.set_ylim(1e-17, 1e2)
    right.legend(fontsize=9, loc=(0.32, 0.33))
    return figure


def changes(Q: Array, W: Array) -> tuple[Array, Array]:
    """Of the angular momentum in the world and of the energy, relative to their first values."""
    momentum, energy = rotate(Q, W @ inertia()), np.einsum("ni,ij,nj->n", W, inertia(), W)
    moved = np.linalg.norm(momentum - momentum[0], axis=1) / np.linalg.norm(momentum[0])
    return moved, np.abs(energy / energy[0] - 1)


def frames(W: Array) -> Array:
    """Rows of a turn over: around the first change of sign of the middle spin."""
    change = int(np.flatnonzero(W[:-1, 1] * W[1:, 1] < 0)[0])
    return change + np.round(np.linspace(-60, 60, FRAMES)).astype(int)


def draw(axes: Axes, q: Array) -> None:
    """The box, its nearer faces over the others."""
    corners, depths = [], []
    for axis, side in FACES:
        u, v = (axis + 1) % 3, (axis + 2) % 3
        face = np.zeros((4, 3))
        face[:, axis] = side
        face[:, u], face[:, v] = [-1, 1, 1, -1], [-1, -1, 1, 1]
        places, depth = projected(rotate(q, face * SIDES / 2))
        corners.append(places)
        depths.append(float(depth.mean()))
    order = np.argsort(depths)
    paint = [PAINT[i] for i in order]
    axes.add_collection(PolyCollection([corners[i] for i in order], facecolors=paint, edgecolors="#1f2328"))
    axes.set(xlim=(-1.15, 1.15), ylim=(-1.15, 1.15), aspect="equal")
    axes.axis("off")
