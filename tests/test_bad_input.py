"""What is refused, and how: one clear error each, which names the argument, what came and what was expected."""

import re

import numpy as np
import pytest

from dsim import Flow, SimulationError, Status, System, adjoint, newton, simulate
from dsim.effects import Actuation, Drag, Field, Gravity, SpringDamping, Springs
from dsim.simulation import Trajectory, record
from dsim.steppers import RK4, BackwardEuler, ForwardEuler, SymplecticEuler, TwoStepBackwardEuler, VelocityVerlet

NAN, INF = float("nan"), float("inf")
Y0 = np.array([0, 0, 1.2, 0, 0, 0, 0, 0.3])


def pair(**options):
    return System([1.0, 1.0], Springs([(0, 1)], 1.0, 10.0), 2, **options)


def run(effects=(), stepper=None, steps=2, h=0.1):
    return simulate(stepper or SymplecticEuler(), System([1.0, 1.0], effects, 2), Y0, h, steps)


def flow(phi=lambda t, y: -y, jacobian=None, stepper=None, h=0.1):
    return simulate(stepper or RK4(), Flow(phi, 2, jacobian), [1.0, 2.0], h, 1)


def march(y0=Y0, h=0.1, steps=2, stepper=None, **options):
    return simulate(stepper or RK4(), pair(), y0, h, steps, **options)


def solve(residual=lambda z: z, slope=lambda z: np.eye(1), z0=(1.0,), **options):
    return newton(residual, slope, np.array(z0), **options)


def blocks(field):
    return System([1.0, 1.0], field, 2).dq(0.0, np.zeros(4), np.zeros(4))


def wrong(value, shape=(2, 2, 2)):
    return lambda *where: np.full(shape, value)


# name: what is done, and the whole message (* stands for anything)
REFUSED = {
    # masses, sizes, pins
    "mass nan": (lambda: System([1, NAN]), "mass must be finite; got nan at index 1"),
    "mass inf": (lambda: System([INF]), "mass must be finite; got inf at index 0"),
    "mass negative": (lambda: System([1, -1]), "mass must be > 0; got -1.0 at index 1"),
    "mass zero": (lambda: System([0.0]), "mass must be > 0; got 0.0 at index 0"),
    "mass a number": (lambda: System(1.0), "mass must have shape (any,); got ()"),
    "mass 2-D": (lambda: System([[1.0]]), "mass must have shape (any,); got (1, 1)"),
    "mass empty": (lambda: System([]), "mass must have at least one point; got shape (0,)"),
    "mass text": (lambda: System("abc"), "mass must be numbers; got 'abc'"),
    "mass None": (lambda: System(None), "mass must be numbers; got None"),
    "mass complex": (lambda: System([1j]), "mass must be numbers; got [1j]"),
    "mass ragged": (lambda: System([[1], [1, 2]]), "mass must be numbers; got [[1], [1, 2]]"),
    "dimension zero": (lambda: System([1.0], dimension=0), "dimension must be a whole number >= 1; got 0"),
    "dimension half": (lambda: System([1.0], dimension=1.5), "dimension must be a whole number >= 1; got 1.5"),
    "dimension inf": (lambda: System([1.0], dimension=INF), "dimension must be a whole number >= 1; got inf"),
    "fixed too large": (lambda: pair(fixed=[0, 2]), "fixed must be indices from 0 to 1; got 2"),
    "fixed negative": (lambda: pair(fixed=[-1]), "fixed must be indices from 0 to 1; got -1"),
    "fixed half": (lambda: pair(fixed=[0.5]), "fixed must be whole numbers, indices of points; got [0.5]"),
    "fixed a mask": (
        lambda: pair(fixed=[True, False]),
        "fixed must be whole numbers, indices of points; got [True, False]",
    ),
    "fixed 2-D": (lambda: pair(fixed=[[0], [1]]), "fixed must be whole numbers, indices of points; got [[0], [1]]"),
    "fixed ragged": (lambda: pair(fixed=[[0], [0, 1]]), "fixed must be whole numbers, indices of points; got [[0]*"),
    # springs
    "pair out of range": (
        lambda: System([1.0], Springs([(0, 1)], 1, 1)),
        "pairs must be indices below 1, the number of points; got 1",
    ),
    "damped pair out of range": (
        lambda: System([1.0], SpringDamping([(0, 1)], 1)),
        "pairs must be indices below 1, the number of points; got 1",
    ),
    "pair on itself": (
        lambda: Springs([(0, 1), (1, 1)], 1, 1),
        "pairs must join two different points; got (1, 1) at row 1",
    ),
    "pair negative": (lambda: Springs([(-1, 1)], 1, 1), "pairs must be indices >= 0; got (-1, 1) at row 0"),
    "pair of floats": (
        lambda: Springs([(0, 1.0)], 1, 1),
        "pairs must be whole numbers of shape (E, 2); got float64 (1, 2)",
    ),
    "pair of three": (
        lambda: SpringDamping([(0, 1, 2)], 1),
        "pairs must be whole numbers of shape (E, 2); got int64 (1, 3)",
    ),
    "pairs ragged": (
        lambda: Springs([(0, 1), (2,)], 1, 1),
        "pairs must be whole numbers of shape (E, 2); got [(0, 1), (2,)]",
    ),
    "pair beyond 64 bits": (
        lambda: System([1.0], Springs(np.array([[0, 2**63]], dtype=np.uint64), 1, 1)),
        "pairs must be indices below 1, the number of points; got 9223372036854775807",
    ),
    "stiffness negative": (lambda: Springs([(0, 1)], 1, -1), "stiffness must be >= 0; got -1.0"),
    "stiffness nan": (lambda: Springs([(0, 1)], 1, [NAN]), "stiffness must be finite; got nan at index 0"),
    "stiffness count": (
        lambda: Springs([(0, 1)], 1, [1, 2]),
        "stiffness must be a number or have shape (1,), one a pair; got (2,)",
    ),
    "rest length negative": (
        lambda: Springs([(0, 1), (1, 2)], [1, -1], 1),
        "rest_length must be >= 0; got -1.0 at index 1",
    ),
    "damping negative": (lambda: SpringDamping([(0, 1)], -1), "coefficient must be >= 0; got -1.0"),
    "damping inf": (lambda: SpringDamping([(0, 1)], INF), "coefficient must be finite; got inf"),
    # gravity, drag and wind
    "gravity shape": (lambda: System([1.0], Gravity([1, 2])), "acceleration must have shape (3,); got (2,)"),
    "gravity a number": (lambda: Gravity(9.81), "acceleration must have shape (any,); got ()"),
    "gravity nan": (lambda: Gravity([0, NAN]), "acceleration must be finite; got nan at index 1"),
    "drag negative": (lambda: Drag(-1), "coefficient must be >= 0; got -1.0"),
    "drag count": (lambda: System([1.0], Drag([1, 2])), "coefficient must have shape (1,); got (2,)"),
    "drag 2-D": (lambda: Drag([[1]]), "coefficient must be a number or (N,); got shape (1, 1)"),
    "wind shape": (lambda: System([1.0], Drag(1, wind=[1, 2])), "wind must have shape (3,); got (2,)"),
    "wind nan": (lambda: Drag(1, wind=[NAN]), "wind must be finite; got nan at index 0"),
    "wind returns shape": (lambda: run(Drag(1, lambda t, x: x[:1])), "wind must return shape (2, 2); got (1, 2)"),
    "wind returns text": (lambda: run(Drag(1, lambda t, x: "west")), "wind must return numbers; got 'west'"),
    "wind returns None": (lambda: run(Drag(1, lambda t, x: None)), "wind must return shape (2, 2); got ()"),
    "wind's slope shape": (
        lambda: run(Drag(1, lambda t, x: x, lambda t, x: x), BackwardEuler()),
        "wind_jacobian must have shape (2, 2, 2); got (2, 2)",
    ),
    "wind's slope nan": (
        lambda: run(Drag(1, lambda t, x: x, wrong(NAN)), BackwardEuler()),
        "wind_jacobian must be finite; got nan at index (0, 0, 0)",
    ),
    "wind's slope a number": (
        lambda: Drag(1, lambda t, x: x, 3),
        "wind_jacobian must be a callable (t, x), for a callable wind; got 3",
    ),
    "slope of no wind": (
        lambda: Drag(1, None, wrong(0.0)),
        "wind_jacobian must go with a callable wind (t, x): leave it out, or give one; got wind None",
    ),
    "slope of a constant wind": (
        lambda: Drag(1, [1.0, 2.0], wrong(0.0)),
        "wind_jacobian must go with a callable wind (t, x): leave it out, or give one; got wind [1.0, 2.0]",
    ),
    "differenced wind returns text": (
        lambda: blocks(Drag(1, lambda t, x: "west")),
        "wind must return numbers; got 'west'",
    ),
    "differenced wind returns shape": (
        lambda: blocks(Drag(1, lambda t, x: x[:1])),
        "wind must return shape (2, 2); got (1, 2)",
    ),
    # fields
    "field a number": (lambda: Field(3), "force must be a callable of x (N,d); got 3"),
    "field's slope a number": (lambda: Field(lambda x: x, 3), "jacobian must be a callable of x (N,d); got 3"),
    "field returns shape": (lambda: run(Field(lambda x: x[0])), "field.force must return shape (2, 2); got (2,)"),
    "field returns text": (lambda: run(Field(lambda x: "up")), "field.force must return numbers; got 'up'"),
    "field returns ragged": (
        lambda: run(Field(lambda x: [[0, 1], [2]])),
        "field.force must return numbers; got [[0, 1], [2]]",
    ),
    "field jacobian returns text": (
        lambda: blocks(Field(lambda x: x, lambda x: "steep")),
        "field.jacobian must return numbers; got 'steep'",
    ),
    "differenced field returns text": (
        lambda: blocks(Field(lambda x: "up")),
        "field.force must return numbers; got 'up'",
    ),
    "differenced field returns shape": (
        lambda: blocks(Field(lambda x: x[0])),
        "field.force must return shape (2, 2); got (2,)",
    ),
    "field returns None": (lambda: run(Field(lambda x: None)), "field.force must return shape (2, 2); got ()"),
    "field's slope shape": (
        lambda: run(Field(lambda x: x, lambda x: x), BackwardEuler()),
        "field.jacobian must return shape (2, 2, 2); got (2, 2)",
    ),
    "field's potential shape": (
        lambda: System([1.0], Field(lambda x: x, potential=lambda x: x), 2).energy(0, np.zeros(4)),
        "field.potential must return shape (1,); got (1, 2)",
    ),
    # actuation
    "actuation shape": (
        lambda: Actuation([[1.0]], 0.1),
        "forces must have shape (steps, points, dimension); got (1, 1)",
    ),
    "actuation points": (
        lambda: System([1.0], Actuation(np.zeros((2, 2, 3)), 0.1)),
        "forces must have shape (any, 1, 3); got (2, 2, 3)",
    ),
    "actuation h": (lambda: Actuation(np.zeros((1, 1, 3)), 0), "h must be > 0; got 0.0"),
    "another h": (
        lambda: run(Actuation(np.zeros((9, 2, 2)), 0.2)),
        "h must be 0.2, the step actuation was made for; got 0.1",
    ),
    "rows run out": (
        lambda: run(Actuation(np.zeros((3, 2, 2)), 0.1), steps=4),
        "actuation has 3 rows of h = 0.1; got t = 0.3, which asks for row 3",
    ),
    "no rows": (
        lambda: run(Actuation(np.zeros((0, 2, 2)), 0.1)),
        "actuation has 0 rows of h = 0.1; got t = 0, which asks for row 0",
    ),
    # effects and their names
    "two of a name": (
        lambda: System([1.0], (Drag(1), Drag(2))),
        "effects must have different names; got two called 'drag' (use name=\"...\")",
    ),
    "name with a dot": (
        lambda: System([1.0], Drag(1, name="a.b")),
        "an effect may not be called 'a.b': \"mass\" and dots are taken",
    ),
    "name mass": (
        lambda: System([1.0], Drag(1, name="mass")),
        "an effect may not be called 'mass': \"mass\" and dots are taken",
    ),
    "name empty": (lambda: System([1.0], Drag(1, name="")), "an effect's name must be a word; got ''"),
    "name a number": (lambda: System([1.0], Drag(1, name=3)), "an effect's name must be a word; got 3"),
    "no effect": (lambda: System([1.0], 3), "effects must have a name and a force(t, q, v); got 3"),
    "an effect's class": (lambda: System([1.0], Drag), "effects must have a name and a force(t, q, v); got <class*"),
    # parameters
    "join unknown": (
        lambda: pair().join(nope=1),
        "no parameter is called 'nope'; this system has mass, springs.rest_length, springs.stiffness",
    ),
    "join shape": (lambda: pair().join(mass=[1.0]), "mass must have shape (2,); got (1,)"),
    "join nan": (lambda: pair().join(mass=[1.0, NAN]), "mass must be finite; got nan at index 1"),
    "theta shape": (lambda: pair().with_theta([1.0]), "theta must have shape (4,); got (1,)"),
    "theta nan": (lambda: pair().with_theta([NAN] * 4), "theta must be finite; got nan at index 0"),
    "split shape": (lambda: pair().split([1.0]), "theta must have shape (4,); got (1,)"),
    # runs
    "h zero": (lambda: march(h=0), "h must be > 0; got 0.0"),
    "h negative": (lambda: march(h=-0.1), "h must be > 0; got -0.1"),
    "h nan": (lambda: march(h=NAN), "h must be finite; got nan"),
    "h inf": (lambda: march(h=INF), "h must be finite; got inf"),
    "h an array": (lambda: march(h=[0.1]), "h must be a number; got shape (1,)"),
    "h None": (lambda: march(h=None), "h must be a number; got None"),
    "steps negative": (lambda: march(steps=-1), "steps must be a whole number >= 0; got -1"),
    "steps half": (lambda: march(steps=1.5), "steps must be a whole number >= 0; got 1.5"),
    "steps inf": (lambda: march(steps=INF), "steps must be a whole number >= 0; got inf"),
    "steps nan": (lambda: march(steps=NAN), "steps must be a whole number >= 0; got nan"),
    "steps text": (lambda: march(steps="3"), "steps must be a whole number >= 0; got '3'"),
    "y0 short": (lambda: march(Y0[:3]), "y0 must have shape (8,); got (3,)"),
    "y0 2-D": (lambda: march(Y0.reshape(2, 4)), "y0 must have shape (8,); got (2, 4)"),
    "y0 nan": (lambda: march(Y0 * NAN), "y0 must be finite; got nan at index 0"),
    "keep": (lambda: march(keep="nope"), "keep must be *; got 'nope'"),
    "a stepper's class": (lambda: march(stepper=RK4), "stepper must be a method such as BackwardEuler(); got <class*"),
    "no system": (lambda: simulate(RK4(), 3, Y0, 0.1, 1), "system must be a System or a Flow; got 3"),
    "tol zero": (lambda: BackwardEuler(tol=0), "tol must be > 0; got 0.0"),
    "tol nan": (lambda: BackwardEuler(tol=NAN), "tol must be finite; got nan"),
    "globalize": (
        lambda: BackwardEuler(globalize="x"),
        'globalize must be "none", "line_search" or "energy"; got \'x\'',
    ),
    "no iterations": (
        lambda: march(stepper=BackwardEuler(max_iterations=0)),
        "max_iterations must be a whole number >= 1; got 0",
    ),
    "history missing": (
        lambda: TwoStepBackwardEuler().step(pair(), 0.0, Y0, 0.1),
        "y0 must have shape (16,); got (8,); pass it through `start` first",
    ),
    # flows
    "phi a number": (lambda: Flow(3, 2), "phi must be a callable (t, y) -> (ny,); got 3"),
    "flow of no size": (lambda: Flow(lambda t, y: y, 0), "size must be a whole number >= 1; got 0"),
    "phi returns shape": (lambda: flow(lambda t, y: y[:1]), "phi must return shape (2,); got (1,)"),
    "phi returns None": (lambda: flow(lambda t, y: None), "phi must return shape (2,); got ()"),
    "jacobian a number": (lambda: flow(jacobian=3), "jacobian must be a callable (t, y) -> (ny,ny); got 3"),
    "jacobian shape": (
        lambda: flow(jacobian=lambda t, y: y, stepper=BackwardEuler()),
        "jacobian must return shape (2, 2); got (2,)",
    ),
    **{
        f"{type(stepper).__name__} on a flow": (
            lambda stepper=stepper: flow(stepper=stepper),
            f"{type(stepper).__name__} needs a second-order System; got a Flow (use ForwardEuler, *)",
        )
        for stepper in (SymplecticEuler(), VelocityVerlet(), TwoStepBackwardEuler())
    },
    # gradients and Newton
    "dJdy shape": (lambda: adjoint(march(), np.zeros(7)), "dJdy must have shape (3, 8), or (8,) *; got (7,)"),
    "dJdy rows": (lambda: adjoint(march(), np.zeros((2, 8))), "dJdy must have shape (3, 8), or (8,) *; got (2, 8)"),
    "dJdy nan": (lambda: adjoint(march(), np.full((3, 8), NAN)), "dJdy must be finite; got nan at index (0, 0)"),
    "newton tol": (lambda: solve(tol=0), "tol must be > 0; got 0.0"),
    "newton z0": (lambda: solve(z0=[NAN]), "z0 must be finite; got nan at index 0"),
    "newton globalize": (lambda: solve(globalize="x"), "globalize must be *, a callable; got 'x'"),
    "newton iterations": (lambda: solve(max_iterations="a"), "max_iterations must be a whole number >= 1; got 'a'"),
    "residual shape": (lambda: solve(lambda z: z[:0]), "residual must return shape (1,); got (0,)"),
    "slope shape": (
        lambda: solve(slope=lambda z: np.eye(2)),
        "linearize must return shape (1, 1), or an object with .solve; got (2, 2)",
    ),
    "slope a number": (
        lambda: solve(slope=lambda z: 3.0),
        "linearize must return shape (1, 1), or an object with .solve; got float",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refused(name):
    act, message = REFUSED[name]
    with pytest.raises(ValueError) as caught:
        act()
    pattern = re.escape(message).replace(r"\*", ".*")
    assert re.fullmatch(pattern, str(caught.value), re.DOTALL), str(caught.value)
    assert re.search("got|no parameter|may not", str(caught.value))


def test_an_unknown_gradient_is_named():
    gradient = adjoint(march(), np.zeros((3, 8)))
    with pytest.raises(KeyError, match=r"no parameter is called 'nope'; this system has mass, springs\.rest_length"):
        gradient["nope"]
    with pytest.raises(KeyError, match=r"by the start it is \.y0"):
        gradient["velocities"]


# What looks bad and is allowed


def test_numbers_at_the_edge_are_taken():
    Springs([], 1.0, 1.0)
    System([1.0], (Springs([], 0.0, 0.0), Drag(0.0)), fixed=0)
    for stepper in (RK4(), BackwardEuler(), TwoStepBackwardEuler()):
        still = march(steps=0, stepper=stepper)
        assert (still.y == Y0).all() and still.y.shape == (1, 8)
        assert (adjoint(still, [Y0]).y0 == Y0).all()
    assert march(steps=2.0).y.shape == march(steps=np.int64(2)).y.shape == (3, 8)


def test_with_theta_may_go_below_zero():
    """Signs are checked where a system is made; a derivative at 0 has to look at both sides."""
    slack = System([1.0, 1.0], Springs([(0, 1)], 1.0, 0.0), 2)
    below = slack.with_theta(slack.join(**{"springs.stiffness": [-2.0]}))
    assert below.effects[0].stiffness == [-2.0]
    q = np.array([0, 0, 1.5, 0])
    assert below.force(0, q, q) == pytest.approx([-1.0, 0, 1.0, 0])


@pytest.mark.parametrize("stepper", [SymplecticEuler(), BackwardEuler(tol=1e-13)], ids=lambda s: type(s).__name__)
def test_differences_at_no_stiffness(stepper):
    slack = System([1.0, 1.0], Springs([(0, 1)], 1.0, 0.0), 2)

    def last(stiffness):
        moved = slack.with_theta(slack.join(**{"springs.stiffness": [stiffness]}))
        return simulate(stepper, moved, Y0, 0.1, 5).y[-1, 2]

    dJdy = np.zeros((6, 8))
    dJdy[-1, 2] = 1.0
    gradient = adjoint(simulate(stepper, slack, Y0, 0.1, 5), dJdy)["springs.stiffness"]
    assert (last(1e-4) - last(-1e-4)) / 2e-4 == pytest.approx(gradient[0], rel=1e-6)


def test_input_is_copied_and_read_only():
    mass, y0 = np.array([1.0, 1.0]), Y0.copy()
    system = System(mass, (), 2)
    mass[0] = 5.0
    trajectory = simulate(SymplecticEuler(), system, y0, 0.1, 1)
    assert system.mass[0] == 1.0 and (y0 == Y0).all() and trajectory.y[0] is not y0
    with pytest.raises(ValueError, match="read-only"):
        system.mass[0] = 2.0


# Runs that fail on the way


def failure(act):
    with pytest.raises(SimulationError) as caught:
        act()
    error = caught.value
    assert error.status is error.trajectory.status and error.status is not Status.CONVERGED
    assert np.isfinite(error.trajectory.y).all() and len(error.trajectory.t) == len(error.trajectory.y)
    return error


def test_a_run_that_overflows_names_its_step():
    """Forward Euler on y' = 1e100 y: factors of 1e99, so that the fourth step leaves the floating-point range."""
    error = failure(lambda: simulate(ForwardEuler(), Flow(lambda t, y: 1e100 * y, 1), [1.0], 0.1, 9))
    assert error.status is Status.NOT_FINITE
    assert error.trajectory.y[:, 0] == pytest.approx([1.0, 1e99, 1e198, 1e297])
    assert str(error).startswith("ForwardEuler failed in step 3 (t = 0.3): not_finite; ")


@pytest.mark.parametrize("stepper", [SymplecticEuler(), RK4(), BackwardEuler(), VelocityVerlet()])
def test_a_force_that_turns_nan_ends_the_run_there(stepper):
    def storm(x):
        return np.where(np.abs(x) < 0.55, 0.0 * x, NAN)

    system = System([1.0], Field(storm, lambda x: np.zeros((1, 1, 1))), 1)
    error = failure(lambda: simulate(stepper, system, [0.0, 1.0], 0.1, 20))
    assert error.status is Status.NOT_FINITE and "a force is NaN" in str(error)
    done = len(error.trajectory.t) - 1
    assert 4 <= done <= 6 and f"in step {done} (t = {0.1 * done:.6g})" in str(error)
    assert error.trajectory.q[-1, 0] == pytest.approx(0.1 * done)


def test_nan_from_a_wind_or_a_flow():
    for act in (
        lambda: run(Drag(1, lambda t, x: x * NAN)),
        lambda: run(Drag(1, lambda t, x: x * NAN), BackwardEuler()),
        lambda: flow(lambda t, y: y * NAN),
        lambda: flow(lambda t, y: y * NAN, stepper=BackwardEuler()),
    ):
        error = failure(act)
        assert error.status is Status.NOT_FINITE and len(error.trajectory.y) == 1


def test_a_slope_that_is_nan_is_no_answer():
    for act in (
        lambda: run(Field(lambda x: x, wrong(NAN)), BackwardEuler()),
        lambda: run(Field(lambda x: x, wrong(NAN), lambda x: x.sum(axis=1)), BackwardEuler(globalize="energy")),
        lambda: flow(jacobian=wrong(NAN, (2, 2)), stepper=BackwardEuler()),
    ):
        error = failure(act)
        assert error.status is Status.SINGULAR and "not finite" in str(error)


FAILING = {  # y' = phi(y) under backward Euler with h = 1: what its Newton ends with
    Status.SINGULAR: (lambda t, y: y + 1, lambda t, y: np.eye(1), "line_search"),
    Status.MAX_ITERATIONS: (lambda t, y: y + y**2 + 1, lambda t, y: np.diag(1 + 2 * y), "none"),
    Status.LINE_SEARCH_FAILED: (lambda t, y: -(y**3) - 2, lambda t, y: np.full((1, 1), 3.0), "line_search"),
}


@pytest.mark.parametrize("status", FAILING)
def test_a_newton_that_cannot_converge(status):
    phi, slope, globalize = FAILING[status]
    error = failure(lambda: simulate(BackwardEuler(globalize=globalize), Flow(phi, 1, slope), [0.3], 1.0, 3))
    assert error.status is status and f"step 0 (t = 0): {status.value}; " in str(error)
    assert len(error.trajectory.y) == 1


def test_record_returns_what_simulate_raises():
    ode = Flow(lambda t, y: 1e100 * y, 1)
    trajectory = record(ForwardEuler(), ode, [1.0], 0.1, 9)
    assert trajectory.status is Status.NOT_FINITE and len(trajectory.y) == 4


# Files


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "run.npz"
    trajectory = march()
    trajectory.save(path)
    return path, trajectory


def test_what_is_saved_comes_back(saved):
    path, trajectory = saved
    again = Trajectory.load(path, trajectory.stepper, trajectory.system)
    assert (again.y == trajectory.y).all() and (again.t == trajectory.t).all() and again.h == trajectory.h
    assert again.status is trajectory.status and again.counters == trajectory.counters
    dJdy = np.ones_like(trajectory.y)
    assert adjoint(again, dJdy).theta == pytest.approx(adjoint(trajectory, dJdy).theta, rel=1e-12)


def test_a_trajectory_without_its_system_says_so(saved):
    with pytest.raises(ValueError, match=r"no system: load it with Trajectory.load\(path, stepper, system\)"):
        adjoint(Trajectory.load(saved[0]), np.zeros((3, 8)))


def test_a_missing_file_is_missing(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.npz"):
        Trajectory.load(tmp_path / "nowhere.npz")


def refused_file(path, *arguments):
    with pytest.raises(ValueError, match="path must") as caught:
        Trajectory.load(path, *arguments)
    assert str(path) in str(caught.value)


def test_a_file_of_another_system_is_refused(saved):
    path, _ = saved
    with pytest.raises(ValueError, match=r"path must hold states of size 2; .*run.npz has 8"):
        Trajectory.load(path, RK4(), System([1.0], (), 1))


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.7, 0.99])
def test_a_truncated_file_is_refused(saved, share):
    path, _ = saved
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    refused_file(path)


def test_a_corrupt_file_is_refused(saved):
    """Every tenth byte turned, one at a time: refused, or an intact trajectory (bytes that carry no data)."""
    path, trajectory = saved
    data, refused = path.read_bytes(), 0
    for place in range(0, len(data), 10):
        path.write_bytes(data[:place] + bytes([data[place] ^ 0xFF]) + data[place + 1 :])
        try:
            assert (Trajectory.load(path).y == trajectory.y).all()
        except ValueError as error:
            assert "path must be a trajectory written by save" in str(error)
            refused += 1
    assert refused > 0.2 * len(data) / 10


def test_other_files_are_refused(tmp_path):
    path = tmp_path / "other.npz"
    for data in (b"", b"hello", b"PK\x03\x04" + bytes(60)):
        path.write_bytes(data)
        refused_file(path)
    np.savez(path, t=np.zeros(2))
    refused_file(path)
    counters = {f"counter_{name}": 0 for name in ("forces", "jacobians")}
    good = {"t": np.zeros(2), "y": np.zeros((2, 4)), "h": 0.1, "status": "converged", "n": 2, **counters}
    np.savez(path, **good)
    assert Trajectory.load(path).y.shape == (2, 4)
    lies = ({"status": "fine"}, {"t": np.zeros(3)}, {"y": np.zeros(2)}, {"h": "a"}, {"counter_luck": 3})
    for lie in lies:
        np.savez(path, **(good | lie))
        refused_file(path)
    np.savez(path, **(good | {"y": np.array([None])}))
    refused_file(path)
    refused_file(tmp_path)  # a folder


@pytest.mark.parametrize("interruption", [OSError("no space left"), KeyboardInterrupt()], ids=["disk", "ctrl-c"])
@pytest.mark.parametrize("moment", ["write", "rename"])
def test_an_interrupted_save_leaves_the_old_file(saved, monkeypatch, interruption, moment):
    path, trajectory = saved
    before = path.read_bytes()

    def fail(*arguments):
        raise interruption

    def half(self, data):
        with self.open("wb") as file:
            file.write(data[: len(data) // 2])
        raise interruption

    if moment == "rename":
        monkeypatch.setattr("os.replace", fail)
    else:
        monkeypatch.setattr("pathlib.Path.write_bytes", half)
    with pytest.raises(type(interruption)):
        march(steps=7).save(path)
    monkeypatch.undo()
    assert path.read_bytes() == before and (Trajectory.load(path).y == trajectory.y).all()
    assert [file.name for file in path.parent.iterdir()] == ["run.npz"]  # nothing half-written is left


@pytest.mark.parametrize("method", [SymplecticEuler(), BackwardEuler()])
@pytest.mark.parametrize("value", [1.0, np.ones(1), np.ones((2, 2))])
def test_a_force_of_another_shape_is_named(method, value):
    """It would be broadcast otherwise."""

    class Push:
        name = "push"

        def force(self, t, q, v):
            return value

    system = System([1.0, 1.0], Push(), 2)
    with pytest.raises(ValueError, match=r"force of 'push' must return shape \(4,\); got"):
        simulate(method, system, np.zeros(8), 0.1, 1)
