"""What assignments 06 and 07 give to students: derivatives that are derivatives, and pictures that show success."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from dsim.pictures.assignment_06 import design
from dsim.pictures.assignment_07 import eight, steering
from dsim.studies.gradient_check import check_gradient

ROOT = Path(__file__).parent.parent / "assignments"


def kit(folder: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"kit_{folder}", ROOT / folder / "kit.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def assert_derivative(f: Any, z: Any, matrix: Any) -> None:
    """A random row combination of the matrix is the gradient of that combination of f."""
    w = np.random.default_rng(3).normal(size=np.shape(f(z)))
    report = check_gradient(lambda z: float(np.sum(w * f(z))), z, w @ matrix)
    assert report.verdict == "smooth", report


BODIES = {
    "net": np.full(12, 0.45),
    "truss": np.array([1.32, 1.16]),
    "follower": np.array([0.4, 0.4, 0.4, 1.0]),
    "bond": np.array([0.6, 5.0]),
}


@pytest.mark.parametrize("name", BODIES)
def test_bodies_at_rest_have_their_derivatives(name: str) -> None:
    body, p = getattr(kit("06_quasistatics"), name)(), BODIES[name]
    x = body.start() + 0.02 * np.random.default_rng(1).normal(size=body.start().shape)
    assert_derivative(lambda x: body.force(x, p), x, body.dfdx(x, p))
    assert_derivative(lambda p: body.force(x, p), p, body.dfdp(x, p))
    symmetric = np.allclose(body.dfdx(x, p), body.dfdx(x, p).T)
    assert symmetric == (name != "follower")
    assert np.linalg.eigvalsh(body.dfdx_definite(x, p)).max() < 1e-9
    assert (name == "truss") == bool(np.abs(body.dfdx_definite(x, p) - body.dfdx(x, p)).max() > 5)


@pytest.mark.parametrize("name, parameters", [("swimmer", 4), ("pendulums", 3)])
def test_bodies_that_move_have_their_derivatives(name: str, parameters: int) -> None:
    rng = np.random.default_rng(2)
    body = getattr(kit("07_discrete_adjoint"), name)()
    (x, v), p = rng.normal(size=(2, len(body.mass))), rng.uniform(0.5, 2.0, parameters)
    assert_derivative(lambda x: body.force(x, v, p), x, body.dfdx(x, v, p))
    assert_derivative(lambda v: body.force(x, v, p), v, body.dfdv(x, v, p))
    assert_derivative(lambda p: body.force(x, v, p), p, body.dfdp(x, v, p))


def test_costs_have_their_derivatives() -> None:
    rng = np.random.default_rng(4)
    target = kit("06_quasistatics").target(rng.normal(size=4), price=0.3, usual=rng.normal(size=2))
    x, p = rng.normal(size=4), rng.normal(size=2)
    assert check_gradient(lambda x: target.value(x, p), x, target.dOdx(x, p)).verdict == "smooth"
    assert check_gradient(lambda p: target.value(x, p), p, target.dOdp(x, p)).verdict == "smooth"
    cost = kit("07_discrete_adjoint").tracking(rng.normal(size=(3, 4)), np.array([1.0, 2.0, 3.0]), 0.3)
    assert check_gradient(lambda y: cost.state(1, y), x, cost.dldy(1, x)).verdict == "smooth"
    assert check_gradient(lambda u: cost.control(1, u), p, cost.dldu(1, p)).verdict == "smooth"


def test_the_glue_holds_as_much_as_the_kit_says() -> None:
    bond = kit("06_quasistatics").bond(depth=1.3, width=2.5)
    place, p = np.array([0.0, np.log(2) / 2.5]), np.array([1.3 * 2.5 / 2, 5.0])
    assert abs(bond.force(place, p)[1]) < 1e-12
    assert np.linalg.cond(bond.dfdx(place, p)) > 1e14


def test_the_chain_reaches_its_arc() -> None:
    """The handout says: from 0.56 m to 0.5 mm in three steps."""
    _, distances = design()
    assert abs(distances[0] - 0.56) < 0.01 and 4e-4 < distances[3] < 6e-4


def test_the_point_follows_its_eight() -> None:
    """The handout says: fewer than twenty gradients, from 15 to 0.06 m^2."""
    found, free, path, forces = steering()
    assert forces.size == 80 and found.evaluations < 20
    assert abs(found.values[0] - 15) < 0.5 and abs(found.value - 0.064) < 0.005
    far, near = (float(np.linalg.norm(p - eight(), axis=1).max()) for p in (free, path))
    assert far > 1.0 and near < 0.25
