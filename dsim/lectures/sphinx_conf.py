"""The configuration of the site; its conf.py takes all names from here."""

from __future__ import annotations

import re
from typing import Any

project = "dsim"
copyright = "the authors of dsim, MIT License"
extensions = ["sphinx.ext.autodoc", "sphinx.ext.mathjax", "myst_nb", "sphinx-mathjax-offline"]
html_theme = "furo"
html_title = "dsim: differentiable simulation"
html_static_path = ["_extra"]
html_css_files = ["course.css"]
html_show_sourcelink = False
html_copy_source = False
nb_execution_mode = "off"  # the notebooks come with their outputs
nb_merge_streams = True
nb_code_prompt_show = "Show the code"
myst_enable_extensions = ["dollarmath", "amsmath"]
myst_heading_anchors = 3
mathjax_path = "mathjax/tex-chtml.js"  # a file of the site, not of a network
mathjax3_config = {"options": {"enableMenu": False, "enableAssistiveMml": False}}
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True}
autodoc_preserve_defaults = True
autodoc_typehints = "none"
python_maximum_signature_line_length = 80
suppress_warnings = ["myst.header", "mystnb.unknown_mime_type"]

CSS = """
.highlight pre, pre { overflow-x: auto }
div.math { overflow-x: auto; overflow-y: hidden }
.cell_output img, article img { background: white; border-radius: 4px }
table { display: block; overflow-x: auto }
details { border-left: 3px solid var(--color-brand-primary); padding: .2rem .8rem; margin: .6rem 0 }
body { --mystnb-hide-prompt-opacity: 100% }
div.cell details.hide > summary, div.cell details.hide > summary > p.admonition-title {
  color: var(--color-foreground-primary); background: var(--color-background-secondary) }
.content :not(pre) > code { overflow-wrap: anywhere }
dt.sig { overflow-wrap: anywhere }
"""


def as_rst(lines: list[str]) -> list[str]:
    """A docstring of ours as reStructuredText: text is text, what is indented or typed at a prompt is set as it is.

    >>> as_rst(["f = `m` a_*", "", "    x = 1"])
    ['f = ``m`` a\\\\_\\\\*', '', '::', '', '    x = 1', '']
    """
    out: list[str] = []
    for block in re.split(r"\n\s*\n", "\n".join(lines).strip("\n")):
        rows = block.splitlines()
        if not rows:
            continue
        if rows[0].startswith((" ", ">>>", "|")):
            out += ["::", "", *("    " + row.removeprefix("    ") for row in rows), ""]
        else:
            out += [*_text(rows), ""]
    return out


def _text(rows: list[str]) -> list[str]:
    """Paragraphs and lists; a deeper row goes on with the one above."""
    out: list[str] = []
    for row in rows:
        item = row.startswith("- ")
        if item and out and not out[-1].startswith("- ") and out[-1]:
            out.append("")
        text = _escaped(row.strip().removeprefix("- ") if item else row.strip())
        listed = any(line.startswith("- ") for line in out)
        out.append(f"- {text}" if item else f"  {text}" if listed else text)
    return out


def _escaped(text: str) -> str:
    parts = re.split(r"(`+[^`]+`+)", text)
    return "".join(
        f"``{part.strip('`')}``" if part.startswith("`") else re.sub(r"([*_|\\])", r"\\\1", part) for part in parts
    )


def setup(app: Any) -> None:
    """Docstrings pass through `as_rst`."""

    def convert(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
        lines[:] = as_rst(list(lines))

    app.connect("autodoc-process-docstring", convert)
