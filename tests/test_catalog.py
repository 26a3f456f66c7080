"""Checks generated from the catalog, and the mutations that prove they can fail."""

import copy
import importlib
import inspect
import pkgutil
from dataclasses import replace

import numpy as np
import pytest

import dsim
from dsim import catalog
from dsim.effects import Drag, Effect
from dsim.effects.at_points import AtPoints
from dsim.effects.gyroscopic import Gyroscopic
from dsim.kernels import Kernel
from dsim.scenes import Scene
from dsim.solve.linear import make_definite
from dsim.steppers import BackwardEuler, RuleStepper, SymplecticEuler
from dsim.studies.convergence import check_order, fit_order
from dsim.studies.derivatives import EffectExample, check_effect, check_kernel
from dsim.studies.steps import check_stepper, everything, river

NAMES = {type(stepper).__name__: stepper for stepper in catalog.STEPPERS}


def failures(checks):
    return [(c.subject, c.statement, c.measured, c.bound) for c in checks if not c.passed]


def problems(stepper):
    found = [everything(2), everything(3)]
    return [*found, river()] if stepper.form == 1 else found


@pytest.mark.parametrize("kernel", catalog.KERNELS, ids=lambda k: k.name)
@pytest.mark.parametrize("seed", range(3))
def test_kernel_derivatives(kernel, seed):
    assert not failures(check_kernel(kernel, seed))


@pytest.mark.parametrize("example", catalog.EFFECTS, ids=lambda e: e.name)
def test_effect_derivatives(example):
    checks = check_effect(example, seed=1)
    assert len(checks) >= 8 and not failures(checks)


@pytest.mark.parametrize("name", NAMES)
def test_stepper_linearization(name):
    stepper = NAMES[name]
    for problem in problems(stepper):
        checks = check_stepper(stepper, problem, seed=2)
        assert len(checks) >= 7 and not failures(checks)


@pytest.fixture(scope="module")
def order_problems():
    return {problem.name: problem for problem in (build() for build in catalog.ORDER_PROBLEMS)}


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if getattr(s, "implicit", False) else n for n, s in NAMES.items()]
)
def test_observed_order(name, order_problems):
    for problem in order_problems.values():
        if NAMES[name].form <= problem.system.components:
            check, fit = check_order(NAMES[name], problem)
            assert check.passed and len(fit.h) == 6 and fit.r_squared >= 0.999, check


# What is public stands in the catalog


def public_objects():
    for module in pkgutil.walk_packages(dsim.__path__, "dsim."):
        if module.name.split(".")[1] in ("effects", "kernels", "steppers", "scenes", "studies"):
            for name, value in vars(importlib.import_module(module.name)).items():
                if not name.startswith("_"):
                    yield f"{module.name}.{name}", value


def escaped(objects):
    """Public kernels, effects, steppers and scene builders that no generated check would see."""
    effects = {type(e.make(np.random.default_rng(0), 5, 2)) for e in catalog.EFFECTS}
    effects |= {type(e.make(np.random.default_rng(0), 3)) for e in catalog.BODY_EFFECTS}
    effects |= {Gyroscopic, AtPoints}  # what RigidBodies makes of its own inertia, and of the others
    steppers = {type(s) for s in (*catalog.STEPPERS, *catalog.BODY_STEPPERS)}
    bases = {RuleStepper, *(b for s in steppers for b in s.__mro__[1:])}
    for label, value in objects:
        if isinstance(value, Kernel) and value not in catalog.KERNELS:
            yield label
        elif inspect.isclass(value) and issubclass(value, RuleStepper) and value not in steppers | bases:
            yield label
        elif inspect.isclass(value) and hasattr(value, "force") and hasattr(value, "name") and value not in effects:
            if label.startswith("dsim.effects."):
                yield label if value is not Effect else None
        elif inspect.isfunction(value) and inspect.signature(value).return_annotation in ("Scene", Scene):
            if value not in catalog.SCENES:
                yield label


def test_nothing_public_escapes_the_catalog():
    assert [label for label in escaped(public_objects()) if label] == []


def test_an_unlisted_method_is_found():
    class Unlisted(RuleStepper):
        pass

    kernel = catalog.KERNELS[0]._replace(name="unlisted")
    strangers = [("stepper", Unlisted), ("kernel", kernel), ("dsim.effects.x", type("X", (), {"force": 0, "name": ""}))]
    assert list(escaped(strangers)) == ["stepper", "kernel", "dsim.effects.x"]


# Mutations: every check must be able to fail


SPRING = catalog.KERNELS[0]
KERNEL_MUTANTS = {
    "gradient = d energy/dx": SPRING._replace(gradient=lambda x, p: -SPRING.gradient(x, p)),
    "hessian = d gradient/dx": SPRING._replace(hessian=lambda x, p: 1.01 * SPRING.hessian(x, p)),
    "mixed = d gradient/dtheta": SPRING._replace(mixed=lambda x, p: SPRING.mixed(x, p) * [1.01, 1.0]),
}


@pytest.mark.parametrize("statement", KERNEL_MUTANTS)
def test_a_wrong_kernel_derivative_is_red(statement):
    assert statement in [c.statement for c in check_kernel(KERNEL_MUTANTS[statement]) if not c.passed]


def test_a_projected_hessian_is_red():
    def projected(x, theta):
        blocks = SPRING.hessian(x, theta).reshape(len(x), x[0].size, x[0].size)
        return np.stack([make_definite(block) for block in blocks]).reshape(SPRING.hessian(x, theta).shape)

    red = [c.statement for c in check_kernel(SPRING._replace(hessian=projected)) if not c.passed]
    assert red == ["hessian = d gradient/dx"]


def sabotaged(effect, capability, factor):
    """The effect with one capability scaled by a factor, or dropped (factor None)."""
    original = getattr(type(effect), capability)

    def scaled(value):
        return tuple(factor * part for part in value) if isinstance(value, tuple) else value * factor

    if factor is None:
        changed = None
    elif isinstance(original, property):
        changed = property(lambda self: lambda *a: scaled(original.fget(self)(*a)))
    else:

        def changed(self, *a):
            return scaled(original(self, *a))

    twin = copy.copy(effect)
    object.__setattr__(twin, "__class__", type("Mutant", (type(effect),), {capability: changed}))
    return twin


MUTATIONS = [
    (name, capability, factor)
    for name, capabilities in {
        "drag, wind of place": ("dq", "dv", "dtheta", "vjp"),
        "springs": ("dq", "dtheta", "vjp", "energy"),
        "spring damping": ("dq", "dv", "dtheta", "vjp"),
        "gravity": ("dtheta", "energy"),
        "field, potential": ("dq", "energy"),
    }.items()
    for capability in capabilities
    for factor in ((1.0, 1.01, -1.0) if capability in ("vjp", "energy") else (1.0, 1.01, -1.0, None))
]


@pytest.mark.parametrize("name, capability, factor", MUTATIONS)
def test_a_wrong_capability_is_red(name, capability, factor):
    example = next(e for e in catalog.EFFECTS if e.name == name)

    mutant = EffectExample("mutant", lambda rng, n, d: sabotaged(example.make(rng, n, d), capability, factor))
    assert bool(failures(check_effect(mutant))) == (factor != 1.0)  # the sabotage itself does no harm


STATEMENTS = {
    "A": "A = dR/dy1",
    "B": "B = dR/dy0",
    "C": "C = dR/dtheta",
    "tangent": "tangent = -A^-1 (B dy0 + C dtheta)",
    "pullback": "pullback = tangent transposed",
    "pullback_tangent": "pullback_tangent = d pullback",
}


class Warped:
    """A linearization with one of its parts scaled by 1.01."""

    def __init__(self, inner, part):
        self._inner, self._part = inner, part

    def __getattr__(self, label):
        value = getattr(self._inner, label)
        if label != self._part:
            return value
        return (lambda *a: 1.01 * value(*a)) if callable(value) else 1.01 * value


@pytest.mark.parametrize("part", STATEMENTS)
@pytest.mark.parametrize("base", [SymplecticEuler, BackwardEuler])
def test_a_wrong_linearization_is_red(base, part):
    class Mutant(base):
        def linearize(self, system, step):
            return Warped(super().linearize(system, step), part)

    red = [c.statement for c in check_stepper(Mutant(), everything(2)) if not c.passed]
    assert STATEMENTS[part] in red


def test_an_unsolved_step_is_red():
    class Lazy(BackwardEuler):
        def step(self, system, t, y0, h):
            step = super().step(system, t, y0, h)
            return replace(step, y1=step.y1 + 1e-8)

    assert "residual of a solved step" in [c.statement for c in check_stepper(Lazy(), everything(2)) if not c.passed]


def test_a_force_that_hides_its_velocity_is_red():
    """Dropping dv from an effect: the residual's own Jacobians disagree with the linearization."""
    problem = everything(2)
    blind = tuple(sabotaged(e, "dv", None) if isinstance(e, Drag) else e for e in problem.system.effects)
    system = dsim.System(problem.system.mass, blind, 2, problem.system.fixed)
    red = [c.statement for c in check_stepper(BackwardEuler(), replace(problem, system=system)) if not c.passed]
    assert "A = dR/dy1" in red and "Taylor remainder slope" in red


def test_a_method_of_lower_order_is_red(order_problems):
    class Boaster(SymplecticEuler):
        order = 2

    check, fit = check_order(Boaster(), order_problems["pendulum in wind"])
    assert not check.passed and fit.order == pytest.approx(1, abs=0.1)


def test_fit_order_recovers_a_slope_and_refuses_nonsense():
    h = 0.1 / 2.0 ** np.arange(6)
    fit = fit_order(h, 3.0 * h**2.5)
    assert fit.order == pytest.approx(2.5) and fit.r_squared == pytest.approx(1) and fit.standard_error < 1e-12
    assert fit_order(h, 3.0 * h**2 * (1 + 0.3 * (-1) ** np.arange(6))).standard_error > 0.01
    with pytest.raises(ValueError, match="at least 3 positive finite"):
        fit_order(h[:2], h[:2])
    with pytest.raises(ValueError, match="at least 3 positive finite"):
        fit_order(h, np.array([1, 2, 3, np.nan, 1, 1]))


@pytest.mark.parametrize("build", catalog.SCENES, ids=lambda b: b.__name__)
def test_scenes_are_named_after_their_builders(build):
    scene = build()
    assert isinstance(scene, Scene) and scene.name == build.__name__ and scene.summary
