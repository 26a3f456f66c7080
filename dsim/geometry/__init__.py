"""Shapes: how heavy they are and how they resist turning."""

from dsim.geometry.inertia import MassProperties, box, capsule, cylinder, polyhedron, solid, sphere

__all__ = ["MassProperties", "box", "capsule", "cylinder", "polyhedron", "solid", "sphere"]
