"""Mass, centre and inertia of solids of uniform density.  Lecture: "Rigid bodies", I = moment of inertia.

    I = rho int (|x|^2 1 - x x^T) dV about the centre of mass, kg m^2

Shapes stand at the origin with their axis along z; `moved`, `turned` and `+` make others of them.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dsim.arrays.checks import Array, Numbers, as_array, as_positive
from dsim.arrays.rotation import as_unit, from_matrix, to_matrix


@dataclass(frozen=True, eq=False)
class MassProperties:
    """mass kg > 0, centre (3,) m, inertia (3,3) kg m^2 about the centre, in the axes of the shape."""

    mass: Numbers
    centre: Numbers
    inertia: Numbers

    def __post_init__(self) -> None:
        values = {
            "mass": float(as_positive("mass", self.mass, ())),
            "centre": as_array("centre", self.centre, (3,)),
            "inertia": as_array("inertia", self.inertia, (3, 3)),
        }
        _check_inertia(as_array("inertia", self.inertia, (3, 3)))
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def moved(self, by: Any) -> MassProperties:
        """Shifted by (3,) m; the inertia about its own centre stays."""
        return MassProperties(self.mass, self.centre + as_array("by", by, (3,)), self.inertia)

    def turned(self, attitude: Any) -> MassProperties:
        """Turned about the origin by a quaternion (4,): R I R^T."""
        R = to_matrix(as_unit("attitude", attitude))
        return MassProperties(self.mass, R @ self.centre, R @ self.inertia @ R.T)

    def about(self, point: Any) -> Array:
        """The inertia (3,3) about another point, by the theorem of parallel axes: I + m (|d|^2 1 - d d^T)."""
        return np.asarray(
            self.inertia + _points(np.array([self.mass]), (self.centre - as_array("point", point, (3,)))[None])
        )

    def __add__(self, other: MassProperties) -> MassProperties:
        """Both together, rigidly joined."""
        if not isinstance(other, MassProperties):
            return NotImplemented
        mass = self.mass + other.mass
        centre = (self.mass * self.centre + other.mass * other.centre) / mass
        return MassProperties(mass, centre, self.about(centre) + other.about(centre))

    def __radd__(self, other: object) -> MassProperties:
        """For `sum`, which begins with 0."""
        if isinstance(other, int) and other == 0:
            return self
        return NotImplemented

    def principal(self) -> tuple[Array, Array]:
        """(moments (3,) ascending, quaternion of the frame of principal axes): I = R diag(moments) R^T."""
        moments, axes = np.linalg.eigh(self.inertia)
        if np.linalg.det(axes) < 0:
            axes = axes * [1.0, 1.0, -1.0]
        return moments, from_matrix(axes)


def _check_inertia(inertia: Array) -> None:
    """ValueError for one that no body has; 0, that of a point, is one."""
    size, (low, middle, high) = np.abs(inertia).max(), np.linalg.eigvalsh(inertia)
    if np.abs(inertia - inertia.T).max() > 1e-9 * size:
        raise ValueError(f"inertia must be symmetric; got {inertia.tolist()}")
    told = f"got principal moments {low:.6g}, {middle:.6g}, {high:.6g}"
    if low < -1e-9 * size:
        raise ValueError(f"inertia must be positive definite; {told}")
    if high > (low + middle) * (1 + 1e-9) + 1e-9 * size:
        raise ValueError(f"inertia: no principal moment may exceed the sum of the others; {told}")


def _points(masses: Array, x: Array) -> Array:
    """Inertia about the origin of point masses (N,) at x (N,3)."""
    outer = np.einsum("n,ni,nj->ij", masses, x, x)
    return np.asarray(np.trace(outer) * np.eye(3) - outer)


def sphere(radius: float, mass: float) -> MassProperties:
    """2/5 m r^2."""
    r, m = _sizes(radius=radius, mass=mass)
    return MassProperties(m, np.zeros(3), 0.4 * m * r**2 * np.eye(3))


def box(sides: Any, mass: float) -> MassProperties:
    """m/12 (b^2 + c^2) and so on.  sides (3,) m, whole edges."""
    a, (m,) = as_positive("sides", sides, (3,)), _sizes(mass=mass)
    return MassProperties(m, np.zeros(3), m / 12 * np.diag((a**2).sum() - a**2))


def cylinder(radius: float, length: float, mass: float) -> MassProperties:
    """m r^2/2 about its axis z, m (3 r^2 + l^2)/12 across."""
    r, length, m = _sizes(radius=radius, length=length, mass=mass)
    across = m * (3 * r**2 + length**2) / 12
    return MassProperties(m, np.zeros(3), np.diag([across, across, m * r**2 / 2]))


def capsule(radius: float, length: float, mass: float) -> MassProperties:
    """A cylinder of that length along z between two half balls.

    A half ball of mass m' has its centre 3/8 r from its flat side, about which it has 2/5 m' r^2 in every direction.
    """
    r, length, m = _sizes(radius=radius, length=length, mass=mass)
    volumes = np.pi * r**2 * np.array([length, 2 / 3 * r, 2 / 3 * r])
    parts = m * volumes / volumes.sum()
    middle = cylinder(r, length, parts[0])
    half = 0.4 * parts[1] * r**2
    across = half - parts[1] * (3 / 8 * r) ** 2
    cap = MassProperties(parts[1], np.zeros(3), np.diag([across, across, half]))
    offset = np.array([0.0, 0.0, length / 2 + 3 / 8 * r])
    return middle + cap.moved(offset) + cap.moved(-offset)


def polyhedron(vertices: Any, mass: float) -> MassProperties:
    """The convex hull of points (N,3) m, by the exact integrals of `solid`."""
    from scipy.spatial import ConvexHull, QhullError

    x, (m,) = as_array("vertices", vertices, (None, 3)), _sizes(mass=mass)
    if len(x) < 4:
        raise ValueError(f"vertices must be four points or more; got {len(x)}")
    try:
        hull = ConvexHull(x)
    except QhullError as error:
        raise ValueError(
            f"vertices must span a volume; {len(x)} points do not: {str(error).splitlines()[0]}"
        ) from error
    faces = hull.simplices.copy()
    inside = x.mean(axis=0)
    corners = x[faces] - inside
    flipped = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) < 0
    faces[flipped] = faces[flipped][:, ::-1]
    return solid(x, faces, m)


def solid(vertices: Any, faces: Any, mass: float) -> MassProperties:
    """A closed triangle mesh, vertices (N,3) m and faces (F,3) that turn counter-clockwise seen from outside.

    Exact: over the tetrahedra (0, a, b, c) of its faces, with volume v = a.(b x c)/6,
    int x dV = v (a+b+c)/4 and int x x^T dV = v/20 (s s^T + a a^T + b b^T + c c^T), s = a+b+c.
    Raises ValueError for a mesh that is open, or inside out.
    """
    x, (m,) = as_array("vertices", vertices, (None, 3)), _sizes(mass=mass)
    used, triangles = np.unique(_closed(faces, len(x)), return_inverse=True)
    x, triangles = x[used], triangles.reshape(-1, 3)
    middle = x.mean(axis=0)  # integrals about a point nearby lose no digits
    a, b, c = (x[triangles[:, i]] - middle for i in range(3))
    volumes = np.einsum("fi,fi->f", a, np.cross(b, c)) / 6
    volume = float(volumes.sum())
    size = float(np.ptp(x, axis=0).max())
    if volume <= 1e-12 * size**3:
        told = "inside out: its faces must turn counter-clockwise seen from outside" if volume < 0 else "flat"
        raise ValueError(f"faces must enclose a volume; this mesh has {volume:.3g} m^3 and is {told}")
    _check_parts(x, triangles, volumes)
    corners = np.stack([a, b, c])
    s = corners.sum(axis=0)
    centre = volumes @ s / 4 / volume
    second = np.einsum("f,fi,fj->ij", volumes, s, s) + np.einsum("f,pfi,pfj->ij", volumes, corners, corners)
    second = second / 20 / volume - np.outer(centre, centre)
    return MassProperties(m, centre + middle, m * (np.trace(second) * np.eye(3) - second))


def _check_parts(x: Array, triangles: NDArray[np.int64], volumes: Array) -> None:
    """ValueError for a part that is inside out and no hollow of another: it is not within one's bounding box."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    edges = np.concatenate([triangles[:, :2], triangles[:, 1:]])
    graph = csr_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(len(x), len(x)))
    count, part = connected_components(graph, directed=False)
    sizes = np.bincount(part[triangles[:, 0]], volumes, count)
    boxes = [(x[part == k].min(axis=0), x[part == k].max(axis=0)) for k in range(count)]
    solids = [boxes[k] for k in np.flatnonzero(sizes > 0)]
    for k in np.flatnonzero(sizes < 0):
        low, high = boxes[k]
        if not any((outer[0] <= low).all() and (high <= outer[1]).all() for outer in solids):
            raise ValueError(f"faces: one of the mesh's {count} parts is inside out, and no hollow in another")


def _closed(faces: Any, count: int) -> NDArray[np.int64]:
    """Faces whose every edge is passed once in each direction."""
    triangles = np.asarray(faces)
    if triangles.ndim != 2 or triangles.shape[1] != 3 or not np.issubdtype(triangles.dtype, np.integer):
        raise ValueError(f"faces must be whole numbers of shape (F, 3); got {triangles.dtype} {triangles.shape}")
    if triangles.size and not (0 <= triangles.min() and triangles.max() < count):
        raise ValueError(f"faces must be indices from 0 to {count - 1}; got {triangles.min()}..{triangles.max()}")
    if not len(triangles):
        raise ValueError("faces must enclose a volume; got none")
    edges = Counter(map(tuple, np.concatenate([triangles[:, [i, (i + 1) % 3]] for i in range(3)]).tolist()))
    if bad := [edge for edge, times in edges.items() if times != 1 or edges.get(edge[::-1], 0) != 1]:
        raise ValueError(
            f"faces must close: every edge passed once each way; {len(bad)} are not, the first joins {bad[0][0]} and "
            f"{bad[0][1]} (an open mesh, or faces that turn in different directions)"
        )
    return triangles.astype(np.int64)


def read_mesh(path: str | Path) -> tuple[Array, NDArray[np.int64]]:
    """Vertices (N,3) and triangles (F,3) of an OBJ, PLY or STL file, doubled vertices merged; through trimesh.

    Raises ValueError for a file that is none, and says how to install trimesh where it is not there.
    """
    try:
        import trimesh
    except ImportError as error:
        raise ValueError('reading meshes needs trimesh: pip install "dsim[meshes]"') from error
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"path must be a mesh file; there is none at {path}")
    try:
        mesh: Any = trimesh.load(path, force="mesh", process=True)
        mesh.merge_vertices()
        vertices: Array = np.array(mesh.vertices, dtype=np.float64)
        faces = np.array(mesh.faces, dtype=np.int64)
    except Exception as error:  # trimesh raises what its readers raise
        raise ValueError(
            f"path must be an OBJ, PLY or STL mesh; {path.name} is not ({type(error).__name__})"
        ) from error
    if not len(faces):
        raise ValueError(f"path must hold triangles; {path.name} has none")
    return vertices, faces


def _sizes(**values: float) -> tuple[float, ...]:
    return tuple(float(as_positive(name, value, ())) for name, value in values.items())
