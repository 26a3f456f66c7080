"""A stub as a notebook: a cell a function, tagged so that grading finds what the student wrote."""

from __future__ import annotations

import ast
import json

from dsim.grading.submission import TAG


def notebook(source: str, name: str) -> str:
    """The notebook NAME.ipynb of Python text: its docstring in words, its parts in cells tagged "submission".

    The tagged cells, joined, are the text again but for blank lines; the last cell, not tagged, runs the public checks.
    """
    lines, body = source.splitlines(), ast.parse(source).body
    cells, start = [], 0
    if body and ast.get_docstring(ast.parse(source)):
        start = body[0].end_lineno or 0
        rule = (
            f'Write in the cells that are tagged "{TAG}", helpers too: other cells are yours to play, and not graded.'
        )
        cells.append(_cell("markdown", f"{ast.get_docstring(ast.parse(source))}\n\n{rule}"))
        body = body[1:]
    for number, node in enumerate(body):
        following = body[number + 1] if number + 1 < len(body) else None
        if following is not None and not _is_part(node) and not _is_part(following):
            continue  # imports and constants share a cell
        end = node.end_lineno or 0
        if following is None:
            end = len(lines)
        cells.append(_cell("code", "\n".join(lines[start:end]).strip("\n"), TAG))
        start = end
    cells.append(_cell("markdown", "Save, then run the public checks. Write in the cells above: what is graded are the "
                       f'cells tagged "{TAG}"; cells that you add for trying things out are left out.'))  # fmt: skip
    cells.append(_cell("code", f"!dsim check-submission {name}.ipynb"))
    for number, cell in enumerate(cells):
        cell["id"] = f"part-{number:02d}"
    kernel = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
              "language_info": {"name": "python"}}  # fmt: skip
    return json.dumps({"cells": cells, "metadata": kernel, "nbformat": 4, "nbformat_minor": 5}, indent=1) + "\n"


def _is_part(node: ast.stmt) -> bool:
    """Whether it has a cell of its own."""
    return isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)


def _cell(kind: str, text: str, *tags: str) -> dict[str, object]:
    code: dict[str, object] = {"execution_count": None, "outputs": []} if kind == "code" else {}
    return {"cell_type": kind, "metadata": {"tags": list(tags)} if tags else {},
            "source": text.splitlines(keepends=True), **code}  # fmt: skip
