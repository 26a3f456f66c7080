"""A scene in pictures: one frame, a filmstrip, and the energy over time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dsim.arrays import rotation
from dsim.arrays.checks import Array
from dsim.effects import Actuation, Drag, Springs
from dsim.pictures.rigid import SIDE, shaded
from dsim.pictures.style import COLOURS, canvas, label, look, style
from dsim.rigid import RigidBodies
from dsim.scenes import Scene
from dsim.simulation import Trajectory
from dsim.system import System

# Blue is compressed, orange stretched: told apart under every kind of colour blindness.  The middle is dark, since a
# spring at rest must be seen on white.
STRAIN = LinearSegmentedColormap.from_list("strain", ["#1E9BF0", "#0B6FB8", "#55595E", "#C85200", "#FF8A1F"])
FAINT, AIR, INK = "#8C959F", "#7FB3A6", "#1F2328"
TURN, TILT = np.radians(35.0), np.radians(18.0)  # the direction from which a 3-D scene is seen


@dataclass(frozen=True, eq=False)
class Film:
    """A trajectory made ready to draw.

    places (N+1,points,2) m in the picture's plane, and depth (N+1,points) towards the viewer.  box (2,2): the lower
    and the upper corner of all there is to see, so that every frame has the same axes.  strain (N+1,E), or None.
    faces: of all bodies, corners (N+1,K,3) m in the world, each with its colour.
    """

    scene: Scene
    trajectory: Trajectory
    places: Array
    depth: Array
    box: Array
    strain: Array | None
    limit: float  # the |strain| from which on the colour is the strongest
    faces: tuple[tuple[Array, str], ...] = ()

    @property
    def frames(self) -> int:
        return len(self.places)


def film(scene: Scene, trajectory: Trajectory) -> Film:
    """Project and measure a whole trajectory.  Raises ValueError for a scene in more than three dimensions."""
    if scene.dimension > 3:
        raise ValueError(f"scene must be in 1, 2 or 3 dimensions to be drawn; {scene.name} is in {scene.dimension}")
    x = _points(scene, trajectory)
    faces = tuple(_faces(scene, trajectory))
    places, depth = projected(x)
    marks, _ = projected(np.reshape(scene.marks, (1, -1, scene.dimension)))
    corners = [projected(points)[0].reshape(-1, 2) for points, _ in faces]
    seen = np.concatenate([places.reshape(-1, 2), marks[0], *corners])
    low, high = seen.min(axis=0), seen.max(axis=0)
    motors = any(isinstance(effect, Actuation) for effect in getattr(scene.system, "effects", ()))
    margin = (0.18 if motors else 0.08) * max(*(high - low), 1e-9)  # room for the arrows of the motors
    strain = _strain(scene, x)
    # a spring that is jerked for a moment must not take the colour from all others: the strongest 2 % saturate
    limit = 1e-12 if strain is None or not strain.size else max(1e-12, float(np.quantile(np.abs(strain), 0.98)))
    return Film(scene, trajectory, places, depth, np.stack([low - margin, high + margin]), strain, limit, faces)


def _points(scene: Scene, trajectory: Trajectory) -> Array:
    """(N+1,points,d) m: of bodies the centres, then the knots."""
    system = scene.system
    if not isinstance(system, RigidBodies):
        return trajectory.q.reshape(len(trajectory.t), scene.points, scene.dimension)
    frame, (to, at) = system.frame, scene.knots
    found = []
    for q in map(system.unit, trajectory.q):
        centres = frame.centres_of(q)
        turns = frame.turns(q)[to - frame.particles]
        found.append(np.concatenate([centres, centres[to] + rotation.rotate(turns, at)]))
    return np.stack(found)


def _faces(scene: Scene, trajectory: Trajectory) -> Iterator[tuple[Array, str]]:
    """The faces of all bodies in the world: across its thinnest direction a body is blue and orange."""
    if not isinstance(scene.system, RigidBodies):
        return
    split = 3 * scene.system.frame.particles
    poses = trajectory.q[:, split:].reshape(len(trajectory.t), -1, 7)
    for pose, faces in zip(poses.transpose(1, 0, 2), scene.shapes, strict=False):
        flat = np.argmin(np.ptp(np.concatenate(faces), axis=0))  # the direction in which the body is thinnest
        for corners in faces:
            side = np.cross(corners[1] - corners[0], corners[2] - corners[1])
            across = abs(side[flat]) > 0.9 * np.linalg.norm(side)
            centre = np.concatenate(faces)[:, flat].mean()
            colour = SIDE if not across else COLOURS[0] if corners[0, flat] > centre else COLOURS[5]
            turns = rotation.normalised(pose[:, None, 3:])
            yield pose[:, None, :3] + rotation.rotate(turns, corners), colour


def projected(x: Array) -> tuple[Array, Array]:
    """x (...,d) m -> (...,2) in the picture's plane and the depth (...,) towards the viewer.

    3-D is seen from far away (parallel lines stay parallel): turned about the vertical z, then tilted.
    """
    if x.shape[-1] == 1:
        return np.stack([x[..., 0], np.zeros(x.shape[:-1])], axis=-1), np.zeros(x.shape[:-1])
    if x.shape[-1] == 2:
        return x, np.zeros(x.shape[:-1])
    right = x @ np.array([np.cos(TURN), np.sin(TURN), 0.0])
    away = x @ np.array([-np.sin(TURN), np.cos(TURN), 0.0])
    up = np.cos(TILT) * x[..., 2] + np.sin(TILT) * away
    return np.stack([right, up], axis=-1), np.sin(TILT) * x[..., 2] - np.cos(TILT) * away


def _strain(scene: Scene, x: Array) -> Array | None:
    """(l - l0)/l0 of every edge, (N+1,E); None where the edges are not the springs."""
    for effect in getattr(scene.system, "effects", ()):
        if isinstance(effect, Springs) and np.array_equal(effect.pairs, scene.edges) and (effect.rest_length > 0).all():
            edge = x[:, scene.edges[:, 1]] - x[:, scene.edges[:, 0]]
            strain: Array = np.linalg.norm(edge, axis=2) / effect.rest_length - 1
            return strain
    return None


def draw_frame(axes: Axes, film: Film, n: int) -> None:
    """State n: springs coloured by strain, points, pins, the trail so far, wind and motor forces."""
    places, scene = film.places[n], film.scene
    pinned = list(getattr(scene.system, "fixed", ()))
    loose = np.setdiff1d(np.arange(scene.points), pinned)
    free = loose[: len(loose) - len(scene.shapes)]  # a body with faces needs no dot
    _draw_air(axes, film, n)
    _draw_faces(axes, film, n)
    _draw_trail(axes, film, n, loose)
    if len(scene.edges):
        axes.add_collection(_springs(film, n))
    if scene.points <= 40:
        size = 60 if scene.points <= 3 else 7
        axes.scatter(
            places[free, 0],
            places[free, 1],
            s=size,
            color=COLOURS[0] if scene.points <= 3 else INK,
            zorder=4,
            linewidths=0,
        )
    axes.scatter(
        places[pinned, 0], places[pinned, 1], s=42, marker="s", color="white", edgecolors=INK, linewidths=1.4, zorder=5
    )
    marks, _ = projected(scene.marks)
    axes.scatter(
        marks[:, 0], marks[:, 1], s=150, marker="*", color=COLOURS[5], edgecolors=INK, linewidths=0.6, zorder=3
    )
    _draw_motors(axes, film, n)
    axes.set(xlim=film.box[:, 0], ylim=film.box[:, 1], aspect="equal")
    axes.set_title(f"t = {film.trajectory.t[n]:.2f} s", fontsize=10, fontweight="normal")


def _draw_faces(axes: Axes, film: Film, n: int) -> None:
    """Bodies, the farthest face first."""
    if not film.faces:
        return
    placed = [(corners[n], colour) for corners, colour in film.faces]
    flat = [projected(corners) for corners, _ in placed]
    order = np.argsort([depth.mean() for _, depth in flat], kind="stable")
    colours = [shaded(*placed[i]) for i in order]
    polygons = [flat[i][0] for i in order]
    axes.add_collection(PolyCollection(polygons, facecolors=colours, edgecolors=INK, linewidths=0.5, zorder=2.5))


def _springs(film: Film, n: int) -> LineCollection:
    edges = film.scene.edges
    order = np.argsort(film.depth[n][edges].sum(axis=1), kind="stable")  # the nearest last, on top
    width = 2.4 if len(edges) < 60 else 1.7 if len(edges) < 200 else 1.1
    lines = LineCollection(list(film.places[n][edges[order]]), linewidths=width, zorder=3, capstyle="round")
    if film.strain is None:
        lines.set_color(INK)
    else:
        lines.set(cmap=STRAIN, norm=Normalize(-film.limit, film.limit), array=film.strain[n][order])
    return lines


def _draw_trail(axes: Axes, film: Film, n: int, free: NDArray[np.int64]) -> None:
    """Of a few particles: where they have been (line), and where they are going (dots).  Of a body: its centre."""
    paths = film.places[:, free]
    if len(free) > 2:
        paths = paths.mean(axis=1, keepdims=True) if not getattr(film.scene.system, "fixed", ()) else paths[:, :0]
    for path in np.moveaxis(paths, 1, 0):
        axes.plot(*path.T, linestyle=":", linewidth=1.0, color=FAINT, zorder=1)
        axes.plot(*path[: n + 1].T, linestyle="-", linewidth=1.6, color=COLOURS[6], zorder=2)


def _draw_air(axes: Axes, film: Film, n: int) -> None:
    """Arrows of a wind that depends on place, in a plane scene."""
    for effect in getattr(film.scene.system, "effects", ()):
        if not isinstance(effect, Drag) or not callable(effect.wind) or film.scene.dimension != 2:
            continue
        size = film.box[1] - film.box[0]
        counts = np.maximum(2, np.round(6 * size / size.max()).astype(int))
        axis = [low + (np.arange(k) + 0.5) / k * s for low, k, s in zip(film.box[0], counts, size, strict=True)]
        grid = np.stack([a.ravel() for a in np.meshgrid(*axis)], axis=1)
        air = np.broadcast_to(effect.wind(film.trajectory.t[n], grid), grid.shape)
        fastest = max(1e-12, *(float(np.abs(effect.wind(t, grid)).max()) for t in film.trajectory.t[::10]))
        span = float(size.max()) / 7
        _arrows(axes, grid, air * span / fastest, AIR, zorder=0)


def _draw_motors(axes: Axes, film: Film, n: int) -> None:
    """Arrows of the actuation of the step that begins (at the end: of the last step)."""
    for effect in getattr(film.scene.system, "effects", ()):
        if isinstance(effect, Actuation) and film.scene.dimension == 2:
            force = effect.forces[min(n, len(effect.forces) - 1)]
            span = 0.18 * float((film.box[1] - film.box[0]).max()) / max(1e-12, float(np.abs(effect.forces).max()))
            _arrows(axes, film.places[n], span * force, COLOURS[3], zorder=6)


def _arrows(axes: Axes, x: Array, length: Array, color: str, zorder: int) -> None:
    """Arrows from x (K,2), `length` (K,2) long in the units of the axes."""
    how: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1, "width": 0.01, "minlength": 0.5}
    axes.quiver(*x.T, *length.T, color=color, zorder=zorder, **how)


@style()
def filmstrip(scene: Scene, trajectory: Trajectory, frames: int = 6) -> Figure:
    """`frames` states from the first to the last, in equal steps of time, on common axes."""
    ready = film(scene, trajectory)
    chosen = np.unique(np.linspace(0, ready.frames - 1, frames).round().astype(int))
    width, height = ready.box[1] - ready.box[0]
    columns = int(np.clip(round(np.sqrt(6.0 * len(chosen) * height / width / 2)), 2, len(chosen)))
    columns = -(-len(chosen) // -(-len(chosen) // columns))  # rows equally full
    rows = -(-len(chosen) // columns)
    beside = (0.1 if scene.dimension == 3 else 0.8) + (0.0 if ready.strain is None else 1.0)  # labels, colour bar
    panel = (12.6 - beside) / columns - 0.1
    tall = float(np.clip(panel * height / width + 0.35, 1.0, 6.0)) * rows + 0.9
    figure, panels = canvas(rows, columns, (12.6, tall), sharex=True, sharey=True, squeeze=False)
    for axes in panels.flat[len(chosen) :]:
        axes.set_visible(False)
    for axes, n in zip(panels.flat, chosen, strict=False):
        draw_frame(axes, ready, int(n))
        dress(axes, ready, outer=(axes in panels[-1], axes in panels[:, 0]))
    dress_figure(figure, list(panels.flat), ready)
    return figure


def dress(axes: Axes, film: Film, outer: tuple[bool, bool] = (True, True)) -> None:
    """Names and units of the axes at the outer sides; of a 3-D scene, a bar that tells the scale."""
    if film.scene.dimension == 3:
        axes.set(xticks=[], yticks=[])
        axes.spines[:].set_visible(False)
        _scale_bar(axes, film)
        return
    unit = "" if film.scene.name == "kepler" else " (m)"
    axes.locator_params(nbins=4)
    axes.set_xlabel(f"x{unit}" if outer[0] else "")
    axes.set_ylabel(f"y{unit}" if outer[1] else "")


def _scale_bar(axes: Axes, film: Film) -> None:
    low, size = film.box[0], film.box[1] - film.box[0]
    length = 10 ** np.floor(np.log10(size[0] / 2))
    length *= 5 if 5 * length < size[0] / 2 else 2 if 2 * length < size[0] / 2 else 1
    start = low + 0.03 * size
    axes.plot([start[0], start[0] + length], [start[1]] * 2, color=INK, linewidth=2, linestyle="-", marker="")
    axes.text(start[0] + length / 2, start[1] + 0.02 * size[1], f"{length:g} m", ha="center", va="bottom", fontsize=9)


def dress_figure(figure: Figure, panels: list[Axes], film: Film) -> None:
    """The title, and the meaning of the colours."""
    name = film.scene.name.replace("_", " ")
    figure.suptitle(f"{name}: {film.scene.summary}", x=0.01, ha="left", fontsize=12, fontweight="bold")
    figure.supxlabel(stepping(film.trajectory), x=0.01, ha="left", fontsize=9, color="#57606a")
    if film.strain is not None:
        bar = ScalarMappable(Normalize(-100 * film.limit, 100 * film.limit), STRAIN)
        figure.colorbar(bar, ax=panels, label="strain (%)", extend="both", fraction=0.03, pad=0.01, aspect=25)


@style()
def energy(scene: Scene, trajectory: Trajectory) -> Figure:
    """Kinetic and potential energy and their sum over time, J; below, for a scene that conserves it, the error."""
    system = scene.system
    if not isinstance(system, System):
        raise ValueError(f"scene must be a second-order system to have an energy; {scene.name} is a flow")
    conserved = "energy" in scene.invariants
    kinetic, potential = energies(system, trajectory)
    curves = {"kinetic": kinetic, "potential": potential, "total": kinetic + potential}
    rows = 2 if conserved else 1
    ratios = [2.2, 1.0][:rows]
    figure, panels = canvas(rows, 1, (8.0, 2.4 + 1.8 * rows), sharex=True, squeeze=False, height_ratios=ratios)
    for index, (name, value) in enumerate(curves.items()):
        lines: dict[str, Any] = look(index) | {"marker": "", "linewidth": 2.4 if name == "total" else 1.6}
        panels[0, 0].plot(trajectory.t, value, **lines, label=name)
    label(panels[0, 0], "time (s)", "energy (J)", f"{scene.name.replace('_', ' ')}: energy ({stepping(trajectory)})")
    panels[0, 0].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    if conserved:
        total = curves["total"]
        panels[0, 0].set_xlabel("")
        panels[1, 0].plot(trajectory.t, total - total[0], **(look(2) | {"marker": ""}))
        label(panels[1, 0], "time (s)", "change of total (J)")
    return figure


def stepping(trajectory: Trajectory) -> str:
    """How it was stepped: "RK4, h = 0.02 s"."""
    return f"{type(trajectory.stepper).__name__}, h = {trajectory.h:.4g} s"


def energies(system: System, trajectory: Trajectory) -> tuple[Array, Array]:
    """Kinetic and potential energy of every state, (N+1,) J.  Motors do work: they have no potential here."""
    stores: list[Any] = [e for e in system.having("energy") if not isinstance(e, Actuation)]
    states = [system.blocks(y) for y in trajectory.y]
    kinetic = [system.kinetic(v) for _, v in states]
    potential = [sum(e.energy(t, q) for e in stores) for t, (q, _) in zip(trajectory.t, states, strict=True)]
    return np.array(kinetic, dtype=float), np.array(potential, dtype=float)
