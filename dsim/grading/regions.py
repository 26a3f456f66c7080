"""What a student writes stands between two marks of the solution; the stub is made from it, and kept nowhere."""

from __future__ import annotations

import re

BEGIN = re.compile(r"^(?P<indent>[ \t]*)# BEGIN SOLUTION: (?P<told>\S.*)$")
END = re.compile(r"^[ \t]*# END SOLUTION$")


def stub(source: str) -> str:
    """The solution with every marked region replaced.  Raises ValueError for marks that do not pair, or for none."""
    lines: list[str] = []
    inside, regions = "", 0
    for number, line in enumerate(source.splitlines(), start=1):
        begin, end = BEGIN.match(line), END.match(line)
        if begin and not inside:
            inside, regions = f"line {number}", regions + 1
            lines += [f"{begin['indent']}# TO DO: {begin['told']}", f"{begin['indent']}raise NotImplementedError"]
        elif end and inside:
            inside = ""
        elif begin or end or "SOLUTION" in line:
            raise ValueError(f"solution.py must pair its marks; line {number} does not: {line.strip()!r:.60}")
        elif not inside:
            lines.append(line)
    if inside:
        raise ValueError(f"solution.py must pair its marks; {inside} is not ended")
    if not regions:
        raise ValueError("solution.py must mark at least one region, # BEGIN SOLUTION: ... # END SOLUTION")
    return "\n".join(lines) + "\n"
