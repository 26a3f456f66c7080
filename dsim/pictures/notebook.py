"""Pictures in notebooks: static PNG with a text for those who cannot see it."""

from __future__ import annotations

from typing import Any

from matplotlib.figure import Figure

from dsim.pictures.style import to_png


class Shown:
    """A picture that a notebook displays."""

    def __init__(self, png: bytes, alt: str) -> None:
        self.png, self.alt = png, alt

    def __repr__(self) -> str:
        return f"picture: {self.alt}"

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        return {"image/png": self.png, "text/plain": repr(self)}, {"image/png": {"alt": self.alt}}


def show(figure: Figure, alt: str, dpi: int = 110) -> Shown:
    """The last expression of a cell: the figure as PNG.  alt: what it shows, in a sentence.

    Raises ValueError without an alternative text.
    """
    if not alt.strip():
        raise ValueError(f"alt must say what the picture shows; got {alt!r}")
    png = to_png(figure, dpi)
    figure.clear()
    return Shown(png, alt)
