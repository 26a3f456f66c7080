"""Mass properties: closed forms against exact integrals of meshes, composition, principal axes, files, bad input."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dsim.arrays.rotation import exponential, to_matrix
from dsim.geometry import MassProperties, box, capsule, cylinder, polyhedron, solid, sphere
from dsim.geometry.inertia import read_mesh

CORNERS = np.array(list(itertools.product([-0.5, 0.5], repeat=3)))
sizes = st.floats(0.1, 3.0)
turns = st.tuples(*[st.floats(-3, 3)] * 3).map(lambda r: exponential(np.array(r)))


def ball_mesh(around: int = 48) -> tuple[np.ndarray, np.ndarray]:
    """A sphere's surface of triangles, closed and turning outward."""
    from scipy.spatial import ConvexHull

    i = np.arange(around**2) + 0.5
    polar, azimuth = np.arccos(1 - 2 * i / around**2), np.pi * (1 + 5**0.5) * i
    x = np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)], axis=1)
    faces = ConvexHull(x).simplices.copy()
    a, b, c = (x[faces[:, k]] for k in range(3))
    wrong = np.einsum("fi,fi->f", a, np.cross(b, c)) < 0
    faces[wrong] = faces[wrong][:, ::-1]
    return x, faces


@settings(deadline=None)  # the first one imports SciPy
@given(sides=st.tuples(sizes, sizes, sizes), mass=sizes, turn=turns, shift=st.tuples(*[st.floats(-5, 5)] * 3))
def test_a_box_is_the_hull_of_its_corners_wherever_it_stands(sides, mass, turn, shift):
    expected = box(sides, mass).turned(turn).moved(shift)
    found = polyhedron(CORNERS * sides @ to_matrix(turn).T + shift, mass)
    assert np.allclose(found.centre, expected.centre, atol=1e-12) and found.mass == mass
    assert np.allclose(found.inertia, expected.inertia, rtol=0, atol=1e-11 * mass * max(sides) ** 2)


def test_closed_forms_are_limits_of_meshes():
    x, faces = ball_mesh()
    assert np.allclose(solid(x, faces, 2.0).inertia, sphere(1.0, 2.0).inertia, rtol=5e-3, atol=5e-3)
    angle, up = 2 * np.pi * np.arange(400) / 400, np.array([0, 0, 0.7])
    ring = np.stack([0.5 * np.cos(angle), 0.5 * np.sin(angle), np.zeros(400)], axis=1)
    drum = polyhedron(np.concatenate([ring + up, ring - up]), 3.0)
    assert np.allclose(drum.inertia, cylinder(0.5, 1.4, 3.0).inertia, rtol=1e-4, atol=1e-4)
    pill = polyhedron(np.concatenate([0.5 * x + up, 0.5 * x - up]), 3.0)
    assert np.allclose(pill.inertia, capsule(0.5, 1.4, 3.0).inertia, rtol=5e-3, atol=2e-3)


def test_a_capsule_without_length_is_nearly_a_ball_and_a_thin_one_a_rod():
    assert np.allclose(capsule(0.5, 1e-9, 2.0).inertia, sphere(0.5, 2.0).inertia, rtol=1e-6)
    assert np.allclose(capsule(1e-6, 2.0, 3.0).inertia[0, 0], 3.0 * 4 / 12, rtol=1e-5)


def test_halves_make_a_whole_and_a_point_elsewhere_adds_parallel_axes():
    half = box([0.5, 1.0, 2.0], 1.5)
    whole = half.moved([0.25, 0, 0]) + half.moved([-0.25, 0, 0])
    assert np.allclose(whole.inertia, box([1.0, 1.0, 2.0], 3.0).inertia) and np.allclose(whole.centre, 0)
    assert np.allclose(half.about([0, 0, 3.0]), half.inertia + 1.5 * 9 * np.diag([1, 1, 0]))


@given(turns)
def test_principal_axes_are_found(turn):
    moments, attitude = box([1.0, 2.0, 3.0], 1.0).turned(turn).principal()
    R = to_matrix(attitude)
    assert np.allclose(moments, sorted(np.diag(box([1.0, 2.0, 3.0], 1.0).inertia)))
    assert (
        np.allclose(R @ np.diag(moments) @ R.T, box([1.0, 2.0, 3.0], 1.0).turned(turn).inertia) and np.linalg.det(R) > 0
    )


def test_a_wrong_integral_would_be_seen():
    """Mutation: the second moments with 1/10 for 1/20."""
    good = box([1.0, 2.0, 3.0], 1.0).inertia
    assert not np.allclose(2 * polyhedron(CORNERS * [1.0, 2.0, 3.0], 1.0).inertia, good)


@pytest.mark.parametrize("kind", ["obj", "ply", "stl"])
def test_meshes_are_read(kind, tmp_path):
    trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed: pip install 'dsim[meshes]'")
    made = trimesh.creation.box(extents=[1.0, 2.0, 3.0])
    made.export(tmp_path / f"box.{kind}")
    vertices, faces = read_mesh(tmp_path / f"box.{kind}")
    assert vertices.shape == (8, 3) and faces.shape == (12, 3)
    assert np.allclose(solid(vertices, faces, 2.0).inertia, box([1.0, 2.0, 3.0], 2.0).inertia)
    (tmp_path / "broken.obj").write_bytes(b"\x00\xff not a mesh")
    with pytest.raises(ValueError, match=r"broken\.obj"):
        read_mesh(tmp_path / "broken.obj")
    with pytest.raises(FileNotFoundError, match="there is none at"):
        read_mesh(tmp_path / "missing.obj")


def test_bad_shapes_and_meshes_are_refused():
    x, faces = CORNERS, np.array([[0, 1, 2]])
    tetrahedron = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    outward = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    assert solid(tetrahedron, outward, 1.0).mass == 1.0
    for call, words in (
        (lambda: sphere(-1.0, 1.0), "radius must be > 0"),
        (lambda: box([1, 2], 1.0), "sides must have shape"),
        (lambda: cylinder(1.0, 1.0, float("nan")), "mass must be finite"),
        (lambda: polyhedron(np.zeros((5, 3)), 1.0), "vertices must span a volume"),
        (lambda: solid(x, faces, 1.0), "faces must close"),
        (lambda: solid(tetrahedron, outward[:3], 1.0), "an open mesh"),
        (lambda: solid(tetrahedron, outward[:, ::-1], 1.0), "inside out"),
        (lambda: solid(tetrahedron, outward + 9, 1.0), "faces must be indices from 0 to 3"),
        (lambda: solid(tetrahedron, outward / 2, 1.0), "faces must be whole numbers"),
        (lambda: MassProperties(1.0, [0, 0], np.eye(3)), "centre must have shape"),
        (lambda: sphere(1.0, 1.0).turned([0, 0, 0, 0]), "quaternions other than 0"),
    ):
        with pytest.raises(ValueError, match=words):
            call()
