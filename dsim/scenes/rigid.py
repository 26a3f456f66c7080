"""Rigid bodies: one that flips of itself, and a board on chains.  Lecture: "Rigid bodies"."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dsim.arrays.checks import Array, as_count
from dsim.arrays.rotation import exponential, rotate
from dsim.effects import AngularDrag, Attached, Drag, Gravity, SpringDamping, Springs
from dsim.geometry import MassProperties, box, box_faces, racket_faces
from dsim.rigid import RigidBodies, compose, compose_states
from dsim.scenes.scene import Scene, at_rest
from dsim.steppers import ImplicitMidpoint
from dsim.system import System


def racket_properties() -> MassProperties:
    """0.3 kg: an elliptic head, as a flat box of its moments, and a handle; about the common centre of mass."""
    return box([0.30, 0.21, 0.02], 0.17).moved([0.15, 0.0, 0.0]) + box([0.30, 0.04, 0.03], 0.13).moved([-0.19, 0, 0])


def racket(spin: float = 6.0, wobble: float = 0.02, h: float = 0.015, steps: int = 350) -> Scene:
    """A tennis racket of 0.3 kg that floats and turns about its middle axis, a turn a frame of a filmstrip, and flips.

    spin rad/s about the middle axis, wobble rad/s about the handle's, the axis of the smallest moment.
    """
    whole = racket_properties()
    system = RigidBodies([whole.mass], whole.inertia)
    y0 = system.state([0.0, 0.0, 0.0], spin=[wobble, spin, 0.0])

    along = system.angular_momentum(y0) / np.linalg.norm(system.angular_momentum(y0))
    invariants = {"energy": system.energy, "angular momentum": lambda t, y: float(along @ system.angular_momentum(y))}
    summary = "A racket that turns about its middle axis flips, again and again"
    return Scene("racket", summary, system, y0, h, steps, ImplicitMidpoint(), invariants=invariants,
                 shapes=[racket_faces()])  # fmt: skip


def sign(
    twist: float = 1.0, links: int = 2, stiffness: float = 4000.0, wind: float = 2.0, h: float = 0.01, steps: int = 100
) -> Scene:
    """A board of 0.6 m x 0.4 m and 1.5 kg on two chains of 0.5 m, let go after a `twist` (rad) about the vertical.

    It untwists and twists the other way, and sinks and rises with that, in a steady wind of `wind` m/s across it.
    links: of each chain; stiffness N/m of a link.  Raises ValueError for a twist that two chains of 0.5 m do not reach.
    """
    links, sides = as_count("links", links, least=1), np.array([0.6, 0.03, 0.4])
    aside = sides[0] * np.sin(0.5 * twist)  # how far a corner stands from under its hook
    if not abs(twist) < np.pi or abs(aside) >= 0.5:
        raise ValueError(f"twist must lie between -1.97 and 1.97 rad, which chains of 0.5 m reach; got {twist}")
    plate, corners = box(sides, 1.5), 0.5 * sides * [[-1, 0, 1], [1, 0, 1]]
    attitude = exponential(np.array([[0.0, 0.0, twist]]))
    hooks = np.add(corners, [0.0, 0.0, np.sqrt(0.5**2 - aside**2)])
    x, edges = _chains(hooks, rotate(attitude, corners), links)
    chains = System(np.full(len(x), 0.1 / links), [Drag(0.02 / links)], fixed=[0, links])
    board = RigidBodies([plate.mass], plate.inertia, [AngularDrag(0.005)])
    knots = np.full(2, len(x)), corners  # the board's centre comes after the points of the chains
    tied = np.concatenate([np.arange(len(x)), knots[0]]), np.concatenate([np.zeros_like(x), corners])
    scene = compose(chains, board, effects=[
        Gravity([0.0, 0.0, -9.81]),
        Attached(Springs(edges, 0.5 / links, stiffness), *tied),
        Attached(SpringDamping(edges, 2.0), *tied),
        Attached(Drag(0.05, wind=[0.0, wind, 0.0], name="wind"), np.full(4, len(x)), _pressed(sides)),
    ])  # fmt: skip
    y0 = compose_states((chains, board), (at_rest(x), board.state([0.0, 0.0, 0.0], attitude)))
    drawn = edges + (edges >= len(x))  # in a picture the board's centre comes before its corners
    summary = "A board on two chains, twisted and let go in the wind"
    return Scene("sign", summary, scene, y0, h, steps, ImplicitMidpoint(), edges=drawn, knots=knots,
                 shapes=[box_faces(sides)])  # fmt: skip


def _chains(hooks: Array, ends: Array, links: int) -> tuple[Array, NDArray[np.int64]]:
    """Points (2 links,3) of two straight chains from `hooks` to short of `ends` (2,3), and their links (2 links,2).

    The last link of each ends at a corner of the board, which counts after all points.
    """
    along = np.arange(links)[:, None] / links
    x = np.concatenate([hook + along * (end - hook) for hook, end in zip(hooks, ends, strict=True)])
    first = np.arange(2 * links).reshape(2, links)
    second = first + 1
    second[:, -1] = 2 * links + np.arange(2)
    return x, np.stack([first.ravel(), second.ravel()], axis=1)


def _pressed(sides: Array) -> Array:
    """Four points (4,3) at which the wind presses on the board, the middles of its quarters."""
    return 0.25 * sides * np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]])
