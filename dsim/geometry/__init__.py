"""Shapes: how heavy they are, how they resist turning, and their outlines for pictures."""

from dsim.geometry.faces import box_faces, racket_faces
from dsim.geometry.inertia import MassProperties, box, capsule, cylinder, polyhedron, read_mesh, solid, sphere

__all__ = [
    "MassProperties",
    "box",
    "box_faces",
    "capsule",
    "cylinder",
    "polyhedron",
    "racket_faces",
    "read_mesh",
    "solid",
    "sphere",
]
