"""A whole explicit run of rigid bodies on component rows, one contiguous row a component: poses (7,B), twists (6,B).

The rules and the maps are those of the plain path, the forces those of the effects, in place where they have rows.
Tests hold the states against the plain path; gradients are made from the states, step by step.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from dsim.arrays import rotation
from dsim.arrays.checks import Array
from dsim.effects.bodies import BodyRows
from dsim.effects.gyroscopic import InertiaRows
from dsim.effects.rows import has_rows
from dsim.rigid import RigidBodies
from dsim.steppers.rule import RuleStepper


def applies(stepper: Any, system: Any) -> bool:
    """Whether the run is one of `BodyRun`: an explicit one-step rule that turns by a map, on bodies alone."""
    if type(system) is not RigidBodies or system.frame.particles or any(hasattr(e, "at") for e in system.effects):
        return False
    plain = type(stepper).step is RuleStepper.step and not stepper.implicit and stepper.history == 1
    return plain and stepper.rotation in ("exponential", "cayley")


class Place:
    """Where a stage stands, xi (6,B) from the start of the step; its poses are made when a force asks for them."""

    def __init__(self, run: BodyRun, start: Array, xi: Array) -> None:
        self._run, self._start, self._xi = run, start, xi

    @property
    def poses(self) -> Array:
        """(7,B)."""
        return self._run.reached(self._start, self._xi) if self._xi.any() else self._start


class BodyRun:
    """Forces bound to rows; `evaluate` makes the states."""

    def __init__(self, stepper: Any, system: RigidBodies, h: float) -> None:
        self.stepper, self.h, self.bodies = stepper, h, system.frame.bodies
        self._map = getattr(rotation, stepper.rotation)
        self._still = np.zeros((6, self.bodies))
        self._still.setflags(write=False)
        self._constant = np.zeros((6, self.bodies))  # forces that are the same anywhere, summed once
        self._forces: list[BodyRows] = []  # the others
        for effect in system.effects:
            rows: Any = effect.rows() if has_rows(effect) else ByForce(effect)
            if (constant := getattr(rows, "constant", None)) is not None:
                self._constant += constant
            else:
                self._forces.append(rows)
        self._light, self._inverse = 1 / system.mass, InertiaRows(system.inverse_inertia)
        self._evaluations = 0

    def evaluate(self, y0: Array, steps: int) -> tuple[Array, int]:
        """(states (K+1,13B), rates asked for): of the steps that stayed finite, K = steps unless one did not."""
        split, self._evaluations = 7 * self.bodies, 0
        y = np.empty((steps + 1, len(y0)))
        y[0] = y0
        now, new = (tuple(np.empty((rows, self.bodies)) for rows in (7, 6)) for _ in range(2))
        now[0][:], now[1][:] = y0[:split].reshape(-1, 7).T, y0[split:].reshape(-1, 6).T
        now[0][3:] = rotation.normalised(now[0][3:].T).T
        zeros, done = np.zeros(len(y0)), 0
        while done < steps:
            self._advance(done * self.h, now, new)
            row = y[done + 1]
            row[:split].reshape(-1, 7).T[:], row[split:].reshape(-1, 6).T[:] = new
            if row @ zeros != 0.0:  # 0 times what is not finite is NaN
                break
            now, new, done = new, now, done + 1
        return y[: done + 1], self._evaluations

    def _advance(self, t: float, state: tuple[Array, ...], new: tuple[Array, ...]) -> None:
        start, v = state
        still = self._still

        def rate(t: float, xi: Array, v: Array) -> Array:
            return self._rate(t, Place(self, start, xi), v)

        if self.stepper.form == 2:
            xi, new[1][:] = self.stepper.rule({0: still}, {0: v}, rate, t, self.h)
        else:
            whole = {0: np.stack([still, v])}
            xi, new[1][:] = self.stepper.rule(whole, lambda t, y: np.stack([y[1], rate(t, *y)]), t, self.h)
        self.reached(start, xi, new[0])

    def reached(self, start: Array, xi: Array, out: Array | None = None) -> Array:
        """q0 (x) map(xi) on rows."""
        out = np.empty_like(start) if out is None else out
        np.add(start[:3], xi[:3], out=out[:3])
        turned = rotation.product(start[3:].T, self._map(xi[3:].T)).T
        np.divide(turned, np.sqrt(np.einsum("ib,ib->b", turned, turned)), out=out[3:])
        return out

    def _rate(self, t: float, place: Place, v: Array) -> Array:
        """M^-1 f."""
        self._evaluations += 1
        out = self._constant.copy()
        for effect in self._forces:
            effect.add_force(t, place, v, out)
        out[:3] *= self._light
        out[3:] = self._inverse.times(out[3:])
        return out


class ByForce:
    """Any effect, through its public `force`."""

    def __init__(self, effect: Any) -> None:
        self.effect = effect

    def add_force(self, t: float, place: Place, v: Array, out: Array) -> None:
        force = np.asarray(self.effect.force(t, place.poses.T.flatten(), v.T.flatten()))
        if force.shape != (out.size,):
            raise ValueError(f"force of {self.effect.name!r} must return shape {(out.size,)}; got {force.shape}")
        out += force.reshape(-1, 6).T
