"""The tables of the README, made from the catalog.  `python -m dsim.report.readme` writes them into README.md."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import numpy as np

from dsim import catalog
from dsim.pictures.files import write_atomically

BEGIN, END = "<!-- from the catalog -->", "<!-- end -->"


def first_sentence(thing: object) -> str:
    """The first sentence of a docstring's first paragraph."""
    paragraph = " ".join((inspect.getdoc(thing) or "").split("\n\n")[0].split())
    return re.split(r"(?<=\.)\s", paragraph)[0].rstrip(".")


def tables() -> str:
    """Steppers, effects and scenes, one line each."""
    lines = ["| stepper | order | implicit | formula |", "|---|---|---|---|"]
    names = {type(stepper).__name__ for stepper in catalog.STEPPERS}
    for stepper in (*catalog.STEPPERS, *(s for s in catalog.BODY_STEPPERS if type(s).__name__ not in names)):
        implicit = "yes" if stepper.implicit else "no"
        lines.append(f"| `{type(stepper).__name__}` | {stepper.order} | {implicit} | {first_sentence(type(stepper))} |")
    lines += ["", "| effect | force | derivatives by |", "|---|---|---|"]
    seen = set()
    for example in catalog.EFFECTS:
        effect = example.make(np.random.default_rng(0), 5, 2)
        if type(effect) in seen:
            continue
        seen.add(type(effect))
        parameters = ", ".join(["position, velocity", *getattr(effect, "parameters", ())])
        lines.append(f"| `{type(effect).__name__}` | {first_sentence(type(effect))} | {parameters} |")
    for body in catalog.BODY_EFFECTS:
        effect = body.make(np.random.default_rng(0), 3)
        if effect is not None and type(effect) not in seen:
            seen.add(type(effect))
            parameters = ", ".join(["position, velocity", *getattr(effect, "parameters", ())])
            lines.append(f"| `{type(effect).__name__}` | {first_sentence(type(effect))} | {parameters} |")
    lines += ["", "| scene | what it shows |", "|---|---|"]
    lines += [f"| `dsim show {build.__name__}` | {build().summary} |" for build in catalog.SCENES]
    return "\n".join(line.replace("|x_ij|", "\\|x_ij\\|") for line in lines)


def updated(text: str) -> str:
    """The README's text with its tables made anew.  Raises ValueError when the markers are missing."""
    head, begin, rest = text.partition(BEGIN)
    _, end, tail = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"README.md must contain {BEGIN} and {END}")
    return f"{head}{BEGIN}\n{tables()}\n{END}{tail}"


if __name__ == "__main__":
    readme = Path("README.md")
    write_atomically(readme, updated(readme.read_text()).encode())
