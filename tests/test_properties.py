"""Laws that hold for every system: drawn at random, each with mutants that the same law must catch."""

import dataclasses

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from dsim import System, adjoint, catalog, simulate
from dsim.arrays.frozen import replace
from dsim.effects import Actuation, Drag, Field, Gravity, SpringDamping, Springs
from dsim.gradients import Gradient
from dsim.simulation import record
from dsim.steppers import (
    RK4,
    BackwardEuler,
    ImplicitMidpoint,
    SymplecticEuler,
    TwoStepBackwardEuler,
    VelocityVerlet,
)
from dsim.strategies import KINDS, numbers, rotations, states, step_sizes, systems, translations

NET = ("springs", "spring_damping")
SMOOTH = tuple(kind for kind in KINDS if kind != "actuation")


def law(examples=20):
    """Run a property on the same random examples every time."""

    def decorate(test):
        phases = [Phase.generate, Phase.shrink]
        options = settings(max_examples=examples, derandomize=True, deadline=None, database=None, phases=phases)
        return options(given(st.data())(test))

    return decorate


def caught(prop, *arguments, examples=20):
    """The mutant is seen: the property fails on one of its examples (which need not be shrunk)."""

    @settings(max_examples=examples, derandomize=True, deadline=None, database=None, phases=[Phase.generate])
    @given(st.data())
    def run(data):
        prop(data, *arguments)

    with pytest.raises(AssertionError):
        run()


def close(a, b, tol=1e-11):
    a, b = np.asarray(a), np.asarray(b)
    bound = tol * max(1.0, np.abs(a).max(initial=0.0), np.abs(b).max(initial=0.0))
    assert np.isfinite(a).all() and np.isfinite(b).all() and np.abs(a - b).max(initial=0.0) <= bound


def with_effects(system, *effects):
    return System(system.mass, effects, system.dimension, system.fixed)


def directions(data, *shapes):
    """Arrays of normal numbers: long vectors are not worth shrinking entry by entry."""
    rng = np.random.default_rng(data.draw(st.integers(0, 10**6)))
    return [rng.normal(size=shape) for shape in shapes]


def draw_system(data, kinds, dimension=None, **options):
    dimension = dimension or data.draw(st.integers(1, 3))
    system = data.draw(systems(dimension=dimension, kinds=kinds, **options))
    y = data.draw(states(system))
    return system, y, data.draw(step_sizes(system, y))


# Mutants: one line of an effect is wrong


class OneSided(Springs):
    """The spring pulls at its second end alone."""

    def force(self, t, q, v):
        total = np.zeros_like(q).reshape(self.scatter.count, -1)
        ends = self.scatter.elements
        e = self.scatter.gather(q)[:, 1] - self.scatter.gather(q)[:, 0]
        length = np.linalg.norm(e, axis=1)
        np.add.at(total, ends[:, 1], -(self.stiffness * (length - self.rest_length) / length)[:, None] * e)
        return total.ravel()


class Crooked(Springs):
    """The force is turned away from the edge: ends balance, torques do not."""

    def force(self, t, q, v):
        x = super().force(t, q, v).reshape(self.scatter.count, -1)
        return (x + 0.1 * np.roll(x, 1, axis=1) * np.arange(1, x.shape[1] + 1)).ravel()


class AntiDamping(SpringDamping):
    def force(self, t, q, v):
        return -super().force(t, q, v)

    def dv(self, t, q, v):
        return -super().dv(t, q, v)

    def dq(self, t, q, v):
        return -super().dq(t, q, v)


class AntiDrag(Drag):
    def force(self, t, q, v):
        return -super().force(t, q, v)

    def dv(self, t, q, v):
        return -super().dv(t, q, v)


class LazyTranspose(SpringDamping):
    """vjp as if dq were symmetric."""

    def vjp(self, t, q, v, w):
        _, by_v, theta = super().vjp(t, q, v, w)
        return self.dq(t, q, v) @ w, by_v, theta


class Scaled(Springs):
    """vjp with 1 % too much in the stiffness."""

    def vjp(self, t, q, v, w):
        by_q, by_v, theta = super().vjp(t, q, v, w)
        return by_q, by_v, theta * np.repeat([1.0, 1.01], len(self.stiffness))


def recast(effect, mutant):
    """The same effect with another class's methods."""
    twin = replace(effect)
    object.__setattr__(twin, "__class__", mutant)
    return twin


def mutated(system, original, mutant):
    """The system with every effect of a class sabotaged."""
    effects = tuple(recast(e, mutant) if type(e) is original else e for e in system.effects)
    return replace(system, effects=effects)


def unchanged(system):
    return system


# Newton's third law and momentum


def third_law(data, change=unchanged):
    """Forces of springs and of their damping add up to 0, and so do their torques."""
    system, y, _ = draw_system(data, NET)
    system = change(system)
    q, v = system.blocks(y)
    for effect in system.effects:
        f = effect.force(0.0, q, v).reshape(len(system.mass), -1)
        x = q.reshape(f.shape)
        torque = np.einsum("ni,nj->ij", x, f)
        close(f.sum(axis=0), np.zeros(system.dimension), 1e-12 * (1 + np.abs(f).sum()))
        close(torque - torque.T, 0 * torque, 1e-12 * (1 + np.abs(x).max() * np.abs(f).sum()))


@law(30)
def test_third_law(data):
    third_law(data)


@pytest.mark.parametrize("mutant", [OneSided, Crooked])
def test_third_law_can_fail(mutant):
    caught(third_law, lambda system: mutated(system, Springs, mutant))


def angular_momentum(system, y):
    """sum m x ^ v (d,d), antisymmetric: serves every dimension."""
    q, v = (part.reshape(-1, system.dimension) for part in system.blocks(y))
    product = np.einsum("n,ni,nj->ij", system.mass, q, v)
    return product - product.T


def momentum(data, stepper, change=unchanged, angular=False):
    """A free spring net keeps its momentum, and under a central-force symplectic method its angular momentum."""
    system, y, h = draw_system(data, ("springs",) if angular else NET)
    run = simulate(stepper, change(system), y, h, 15)
    P = np.einsum("n,tnd->td", system.mass, run.v.reshape(16, len(system.mass), -1))
    scale = 1 + np.abs(P).max() + np.sum(system.masses * np.abs(run.v).max(axis=0))
    assert np.abs(P - P[0]).max() <= 1e-12 * scale
    if angular:
        first, last = angular_momentum(system, run.y[0]), angular_momentum(system, run.y[-1])
        assert np.abs(first - last).max() <= 1e-12 * scale * (1 + np.abs(run.q).max())


TIGHT = {"tol": 1e-13}
STEPPERS = [SymplecticEuler(), VelocityVerlet(), RK4(), BackwardEuler(**TIGHT), ImplicitMidpoint(**TIGHT)]


@pytest.mark.parametrize("stepper", STEPPERS, ids=lambda s: type(s).__name__)
@law(8)
def test_linear_momentum(stepper, data):
    momentum(data, stepper)


@law(15)
def test_angular_momentum_of_symplectic_euler(data):
    momentum(data, SymplecticEuler(), angular=True)


def test_momentum_can_fail():
    caught(momentum, SymplecticEuler(), lambda system: mutated(system, Springs, OneSided))
    caught(momentum, SymplecticEuler(), lambda system: mutated(system, Springs, Crooked), True)
    caught(momentum, BackwardEuler(**TIGHT), unchanged, True)  # the method itself loses angular momentum


def test_an_overridden_force_is_the_force_of_the_run():
    """A subclass that states its own force is simulated with that force, not with its parent's."""

    class Weak(Springs):
        def force(self, t, q, v):
            return 0.5 * super().force(t, q, v)

    y0 = np.array([0.0, 2.0, 0.0, 0.0])
    weak, half = (System([1.0, 1.0], e, 1) for e in (Weak([(0, 1)], 1.0, 10.0), Springs([(0, 1)], 1.0, 5.0)))
    for stepper in (SymplecticEuler(), RK4()):
        close(simulate(stepper, weak, y0, 0.1, 5).y, simulate(stepper, half, y0, 0.1, 5).y, 1e-14)


# Invariance


def moved(system, y, R, shift):
    """The state turned by R and shifted."""
    q, v = (part.reshape(-1, system.dimension) for part in system.blocks(y))
    return np.concatenate([(q @ R.T + shift).ravel(), (v @ R.T).ravel()])


def equivariance(data, change=unchanged, stepper=None):
    """Turn and shift the state: the same energy, turned forces, a turned trajectory."""
    system, y, h = draw_system(data, NET, dimension=data.draw(st.integers(2, 3)))
    system = change(system)
    R, shift = data.draw(rotations(system.dimension)), data.draw(translations(system.dimension))
    there = moved(system, y, R, shift)
    close(system.energy(0.0, there), system.energy(0.0, y))
    force = system.force(0.0, *system.blocks(y)).reshape(-1, system.dimension)
    close(system.force(0.0, *system.blocks(there)), (force @ R.T).ravel())
    if stepper is not None:
        here, turned = simulate(stepper, system, y, h, 5), simulate(stepper, system, there, h, 5)
        close(turned.y[-1], moved(system, here.y[-1], R, shift), 1e-9)


@law(25)
def test_energy_and_force_are_equivariant(data):
    equivariance(data)


@pytest.mark.parametrize("stepper", [*STEPPERS, TwoStepBackwardEuler(**TIGHT)], ids=lambda s: type(s).__name__)
@law(6)
def test_trajectories_are_equivariant(stepper, data):
    equivariance(data, stepper=stepper)


def test_equivariance_can_fail():
    caught(equivariance, lambda system: mutated(system, Springs, Crooked))
    anchored = Field(lambda x: -1e-3 * x, lambda x: np.broadcast_to(-1e-3 * np.eye(x.shape[1]), (*x.shape, x.shape[1])))
    caught(equivariance, lambda system: with_effects(system, *system.effects, anchored))


def permutation(data, forget=False):
    """Renumber the points: everything is renumbered along."""
    system, y, h = draw_system(data, ("gravity", "drag", "springs", "spring_damping"))
    count, d = len(system.mass), system.dimension
    order = np.array(data.draw(st.permutations(range(count))))
    place = np.argsort(order)  # point i of old is point place[i] of new
    gravity, drag, springs, damping = system.effects
    twin = System(
        system.mass if forget else system.mass[order],
        (
            gravity,
            Drag(drag.coefficient[order]),
            Springs(place[springs.pairs], springs.rest_length, springs.stiffness),
            SpringDamping(place[springs.pairs], damping.coefficient),
        ),
        d,
    )
    q, v = (part.reshape(count, d) for part in system.blocks(y))
    run = simulate(BackwardEuler(**TIGHT), system, y, h, 3)
    other = simulate(BackwardEuler(**TIGHT), twin, np.concatenate([q[order].ravel(), v[order].ravel()]), h, 3)
    close(other.q[-1], run.q[-1].reshape(count, d)[order].ravel(), 1e-10)
    close(other.v[-1], run.v[-1].reshape(count, d)[order].ravel(), 1e-10)


@law(12)
def test_renumbered_points(data):
    permutation(data)


def test_renumbering_can_fail():
    caught(permutation, True)


# Energy


def convex(data):
    """A free or pinned net of springs without rest length, damped: U is convex."""
    system, y, h = draw_system(data, ("springs", "spring_damping", "drag"), pinned=True)
    springs, damping, drag = system.effects
    slack = Springs(springs.pairs, 0.0, springs.stiffness)
    return with_effects(system, slack, damping, drag), y, 20 * h


def decay(data, stepper, change=unchanged):
    """Energy never rises, whatever the step; a step too long to be solved ends the run, and says so."""
    system, y, h = convex(data)
    system = change(system)
    energies = [system.energy(0.0, row) for row in record(stepper, system, y, h, 8).y]
    assert (np.diff(energies) <= 1e-12 * energies[0]).all()


@law(20)
def test_energy_never_rises_under_backward_euler(data):
    decay(data, BackwardEuler(**TIGHT))


@law(15)
def test_energy_never_rises_under_midpoint_with_damping(data):
    decay(data, ImplicitMidpoint(**TIGHT))


def test_decay_can_fail():
    caught(decay, ImplicitMidpoint(**TIGHT), lambda s: mutated(mutated(s, SpringDamping, AntiDamping), Drag, AntiDrag))
    caught(decay, SymplecticEuler())  # unstable at such steps


def power(data, change=unchanged):
    """Damping and drag in still air never do positive work."""
    system, y, _ = draw_system(data, ("spring_damping", "drag"))
    q, v = system.blocks(y)
    assert all(effect.force(0.0, q, v) @ v <= 1e-14 for effect in change(system).effects)


@law(25)
def test_damping_takes_energy(data):
    power(data)


@pytest.mark.parametrize("original, mutant", [(SpringDamping, AntiDamping), (Drag, AntiDrag)])
def test_power_can_fail(original, mutant):
    caught(power, lambda system: mutated(system, original, mutant))


def modified_energy(data, stepper, sign):
    """Symplectic Euler on x'' = -w^2 x conserves v^2/2 + w^2 x^2/2 - h w^2 x v/2."""
    w2 = data.draw(st.integers(1, 400)) / 4
    h = data.draw(st.integers(1, 18)) / 10 / np.sqrt(w2)
    x, v = data.draw(numbers(2)) + np.array([1.5, 0.0])
    oscillator = System([1.0], Field(lambda x: -w2 * x, lambda x: np.full((1, 1, 1), -w2)), 1)
    run = simulate(stepper, oscillator, [x, v], h, 200)
    kept = run.v**2 / 2 + w2 * run.q**2 / 2 - sign * h * w2 * run.q * run.v / 2
    assert np.ptp(kept) <= 1e-12 * (w2 * np.abs(run.q).max() ** 2 + np.abs(run.v).max() ** 2)


@law(30)
def test_modified_energy_of_symplectic_euler(data):
    modified_energy(data, SymplecticEuler(), 1)


def test_modified_energy_can_fail():
    caught(modified_energy, SymplecticEuler(), 0)
    caught(modified_energy, SymplecticEuler(), -1)
    caught(modified_energy, VelocityVerlet(), 1)


def reversal(data, stepper, kinds):
    """Forward, turn the velocities round, forward: back at the start."""
    system, y, h = draw_system(data, kinds, pinned=True)
    flip = np.repeat([1.0, -1.0], system.n)
    y = np.concatenate(system.blocks(y))
    there = simulate(stepper, system, y, h, 10).y[-1]
    close(flip * simulate(stepper, system, flip * there, h, 10).y[-1], y, 1e-9)


@pytest.mark.parametrize("stepper", [VelocityVerlet(), ImplicitMidpoint(**TIGHT)], ids=lambda s: type(s).__name__)
@law(10)
def test_time_reversal(stepper, data):
    reversal(data, stepper, ("gravity", "springs", "field"))


def test_reversal_can_fail():
    caught(reversal, VelocityVerlet(), ("springs", "drag"))
    caught(reversal, SymplecticEuler(), ("springs",))


# Effects add up


def superposition(data, weight=1.0):
    """The system's force is the sum of its effects'; two nets are one with all their springs."""
    system, y, _ = draw_system(data, tuple(KINDS))
    q, v = system.blocks(y)
    parts = [effect.force(0.0, q, v) for effect in system.effects]
    close(system.force(0.0, q, v), weight * sum(parts), 1e-14)
    springs = next(e for e in system.effects if isinstance(e, Springs))
    cut = data.draw(st.integers(0, len(springs.pairs)))
    both = [
        Springs(springs.pairs[part], springs.rest_length[part], weight * springs.stiffness[part], name=name)
        for name, part in (("first", slice(None, cut)), ("second", slice(cut, None)))
    ]
    one, two = with_effects(system, springs), with_effects(system, *both)
    close(one.force(0.0, q, v), two.force(0.0, q, v), 1e-13)
    close(one.potential(0.0, q), two.potential(0.0, q), 1e-13)
    close(one.dq(0.0, q, v).toarray(), two.dq(0.0, q, v).toarray(), 1e-13)


@law(20)
def test_superposition(data):
    superposition(data)


def test_superposition_can_fail():
    caught(superposition, 1.01)


def nothing(data, strength=0.0):
    """An effect of strength 0 changes no bit of a force or a step, and no trajectory beyond round-off."""
    system, y, h = draw_system(data, ("gravity", "springs"), pinned=True)
    pairs = system.effects[1].pairs
    idle = [
        Drag(strength),
        SpringDamping(pairs, strength),
        Springs(pairs, 1.0, strength, name="idle springs"),
        Field(lambda x: strength * x, lambda x: np.full((*x.shape, x.shape[1]), strength)),
        Actuation(np.full((4, len(system.mass), system.dimension), strength), h),
        Gravity(np.full(system.dimension, strength), name="idle gravity"),
    ]
    chosen = data.draw(st.sampled_from(idle))
    more = with_effects(system, *system.effects, chosen)
    assert (more.force(0.0, *system.blocks(y)) == system.force(0.0, *system.blocks(y))).all()
    for stepper in (SymplecticEuler(), RK4()):
        assert (stepper.step(more, 0.0, y, h).y1 == stepper.step(system, 0.0, y, h).y1).all()
    for stepper in (RK4(), BackwardEuler()):
        close(simulate(stepper, more, y, h, 4).y, simulate(stepper, system, y, h, 4).y, 1e-13)


@law(20)
def test_an_effect_of_no_strength_is_absent(data):
    nothing(data)


def test_nothing_can_fail():
    caught(nothing, 1e-6)


def pins(data, stepper, mass=1e10, pinned=True):
    """Pinned points do not move, and are the limit of an infinite mass at rest."""
    system, y, h = draw_system(data, ("springs", "spring_damping", "drag"), pinned=True)
    y = np.concatenate(system.blocks(y))
    held = system if pinned else System(system.mass, system.effects, system.dimension)
    run = simulate(stepper, held, y, h, 5)
    still = system.free == 0
    assert (run.q[:, still] == run.q[0, still]).all() and not run.v[:, still].any()
    heavy = system.mass.copy()
    heavy[list(system.fixed)] = mass
    limit = simulate(stepper, System(heavy, system.effects, system.dimension), y, h, 5)
    close(limit.y, run.y, 1e-7)


@pytest.mark.parametrize("stepper", [SymplecticEuler(), BackwardEuler(), RK4()], ids=lambda s: type(s).__name__)
@law(8)
def test_pinned_points(stepper, data):
    pins(data, stepper)


def test_pins_can_fail():
    caught(pins, SymplecticEuler(), 1.0)
    caught(pins, SymplecticEuler(), 1e10, False)


def twins(data, one, two):
    """Two methods that are the same."""
    system, y, h = draw_system(data, (*NET, "gravity", "wind"), pinned=True)
    close(simulate(one, system, y, 3 * h, 8).y, simulate(two, system, y, 3 * h, 8).y, 1e-9)


@law(12)
def test_two_step_backward_euler_is_backward_euler(data):
    twins(data, BackwardEuler(**TIGHT), TwoStepBackwardEuler(**TIGHT))


def test_twins_can_fail():
    caught(twins, BackwardEuler(**TIGHT), ImplicitMidpoint(**TIGHT))


# Parameters and derivatives


@law(20)
def test_theta_round_trip(data):
    system, y, _ = draw_system(data, tuple(KINDS), pinned=True)
    twin = system.with_theta(system.theta)
    q, v = system.blocks(y)
    assert (twin.theta == system.theta).all() and (twin.force(0, q, v) == system.force(0, q, v)).all()
    assert (system.join(**system.split(system.theta)) == system.theta).all()
    (other,) = directions(data, system.parameter_count)
    assert (system.with_theta(other).theta == other).all() and (
        system.with_theta(other).mass == other[: len(twin.mass)]
    ).all()
    assert sum(part.size for part in system.split(other).values()) == other.size


def transposes(data, change=unchanged):
    """vjp(w) is (K^T w, D^T w, (df/dtheta)^T w)."""
    system, y, _ = draw_system(data, tuple(KINDS))
    q, v = system.blocks(y)
    system, (w,) = change(system), directions(data, system.n)
    theta_bar = np.zeros(system.parameter_count)
    by_q, by_v = system.vjp(0.0, q, v, w, theta_bar)
    place = 0.0, q, v
    close(by_q, system.dq(*place).T @ w, 1e-12)
    close(by_v, system.dv(*place).T @ w, 1e-12)
    close(theta_bar, system.dtheta(*place).T @ w, 1e-12)


@law(20)
def test_vjp_is_the_transpose(data):
    transposes(data)


@pytest.mark.parametrize("original, mutant", [(SpringDamping, LazyTranspose), (Springs, Scaled)])
def test_transposes_can_fail(original, mutant):
    caught(transposes, lambda system: mutated(system, original, mutant))


def linear(data, gradient):
    """The adjoint is linear in dJdy, and the same whatever the run kept."""
    system, y, h = draw_system(data, tuple(KINDS), pinned=True)
    stepper = data.draw(st.sampled_from([SymplecticEuler(), BackwardEuler(**TIGHT), TwoStepBackwardEuler(**TIGHT)]))
    states_only, steps = (simulate(stepper, system, y, h, 3, keep=keep) for keep in ("states", "steps"))
    a, b = directions(data, states_only.y.shape, states_only.y.shape)
    of_a, of_b, of_both = (gradient(states_only, dJdy) for dJdy in (a, b, 2 * a - 3 * b))
    close(of_both.y0, 2 * of_a.y0 - 3 * of_b.y0, 1e-10)
    close(of_both.theta, 2 * of_a.theta - 3 * of_b.theta, 1e-10)
    kept = gradient(steps, a)
    close(kept.y0, of_a.y0, 1e-8)
    close(kept.theta, of_a.theta, 1e-8)


@law(12)
def test_adjoint_is_linear_and_keeps_agree(data):
    linear(data, adjoint)


def test_linear_can_fail():
    def clipped(trajectory, dJdy):
        return adjoint(trajectory, np.maximum(dJdy, -0.5))

    def forgetful(trajectory, dJdy):
        found = adjoint(trajectory, dJdy)
        return found if trajectory.steps is None else Gradient(found.y0, 1.001 * found.theta, {})

    caught(linear, clipped)
    caught(linear, forgetful)


def slopes(data, stepper, change=unchanged):
    """The adjoint against the difference quotient along a random direction of y0 and theta.

    A central difference with Richardson's step: relative error about 1e-9 where nothing is singular.
    """
    kinds = tuple(KINDS)
    system, y, h = draw_system(data, kinds, pinned=True)
    run = simulate(stepper, change(system), y, h, 3)
    weights, bend, u, w = directions(data, run.y.shape, run.y.shape, y.size, system.parameter_count)

    def J(s):
        states = simulate(stepper, change(system).with_theta(system.theta + 0.3 * s * w), y + s * u, h, 3).y
        return float((weights * states + bend * states**2 / 2).sum())

    gradient = adjoint(run, weights + bend * run.y)
    predicted = gradient.y0 @ u + 0.3 * gradient.theta @ w
    wide, narrow = ((J(s) - J(-s)) / (2 * s) for s in (2e-4, 1e-4))
    close(predicted, (4 * narrow - wide) / 3, 1e-7)


SHARP = [dataclasses.replace(s, **TIGHT) if s.implicit else s for s in catalog.STEPPERS]


@pytest.mark.parametrize("stepper", SHARP, ids=lambda s: type(s).__name__)
@law(4)
def test_adjoint_against_differences(stepper, data):
    slopes(data, stepper)


@pytest.mark.parametrize("original, mutant", [(SpringDamping, LazyTranspose), (Springs, Scaled)])
def test_slopes_can_fail(original, mutant):
    caught(slopes, SymplecticEuler(), lambda system: mutated(system, original, mutant))
