"""A class as it comes: grade it and say how long it took.

    python tests/benchmarks/class_of_1000.py 1000 --assignment 01 --jobs 2

Solutions and alternatives, mutants, stubs, attacks that end at once, and at most one in twenty that runs into a limit.
Prints minutes, submissions a second and the parent's peak memory; exit code 1 where a score is not the one that its
kind earns.
"""

from __future__ import annotations

import argparse
import ast
import csv
import random
import resource
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from dsim.grading import folder
from dsim.grading.grade import grade, submissions_in
from dsim.grading.items import rubric
from dsim.grading.regions import stub

ATTACKS = (
    "import os\nos._exit(0)\n",
    "import sys\nprint('{\"score\": 999}')\nsys.exit(0)\n",
    "class Yes(float): pass\nanswer = Yes(3)\n",
    "import socket\nsocket.create_connection(('192.0.2.1', 80), 1)\n",
    "x = [1] * (2**33)\n",
)


SHARES = {"right": 0.4, "mutant": 0.4, "stub": 0.05, "attack": 0.11, "slow": 0.04}


def write_class(
    assignment: folder.Assignment, count: int, to: Path, seed: int = 0, shares: dict[str, float] = SHARES
) -> dict[str, str]:
    """`count` submissions in a directory; name -> kind: right, mutant, stub, attack, slow."""
    rng, path = random.Random(seed), assignment.path
    solution = (path / "solution.py").read_text()
    right = [solution, *(file.read_text() for file in sorted((path / "alternatives").glob("*.py")))]
    mutants = [file.read_text() for file in sorted((path / "mutants").glob("*.py"))]
    slow = ["while True: pass\n", solution + f"\n\ndef {first_function(solution)}(*arguments):\n    while True: pass\n"]
    sources = {"right": right, "mutant": mutants, "stub": [stub(solution)], "attack": ATTACKS, "slow": slow}
    to.mkdir(parents=True, exist_ok=True)
    kinds = {}
    for number in range(count):
        kind = rng.choices(list(shares), list(shares.values()))[0]
        name = f"s{number:04d}"
        (to / f"{name}.py").write_text(rng.choice(sources[kind]))
        kinds[name] = kind
    return kinds


def first_function(source: str) -> str:
    """The name of the first function that a student has to write."""
    return next(node.name for node in ast.parse(source).body if isinstance(node, ast.FunctionDef))


def wrong_scores(kinds: dict[str, str], grades: Path, most: float) -> list[str]:
    """Those whose score is not what their kind earns."""
    with grades.open(newline="") as file:
        scores = {row["submission"]: float(row["score"]) for row in csv.DictReader(file)}
    fits = {"right": lambda s: s == most, "mutant": lambda s: s < most, "stub": lambda s: s == 0,
            "attack": lambda s: s == 0, "slow": lambda s: s < most}  # fmt: skip
    found = [
        f"{name}, {kind}: {scores.get(name)}" for name, kind in kinds.items() if not fits[kind](scores.get(name, -1))
    ]
    return found + [f"{name}: not handed in" for name in scores if name not in kinds]


def main() -> int:
    parser = argparse.ArgumentParser(description="Grade a generated class and time it.")
    parser.add_argument("count", type=int)
    parser.add_argument("--assignment", default="01")
    parser.add_argument("--jobs", type=int, default=2)
    given = parser.parse_args()
    assignment = folder.find(given.assignment, folder.root())
    with tempfile.TemporaryDirectory(prefix="dsim-class-") as directory:
        submissions, to = Path(directory, "in"), Path(directory, "out")
        kinds = write_class(assignment, given.count, submissions)
        start = time.perf_counter()
        grade(assignment.path, submissions_in(submissions), to, given.jobs)
        took = time.perf_counter() - start
        most = sum(item.points for item in rubric(assignment.path / "rubric.toml"))
        wrong = wrong_scores(kinds, to / "grades.csv", most)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = children.ru_utime + children.ru_stime
    print(f"{given.count} submissions of {assignment.path.name}, {dict(Counter(kinds.values()))}")
    print(f"{took / 60:.2f} minutes, {given.count / took:.1f} a second; {cpu / given.count:.2f} s of CPU a submission;")
    print(f"the parent's peak memory {memory:.0f} MB; {len(wrong)} wrong scores")
    print("\n".join(wrong[:20]))
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
