"""Grade the submission that Gradescope has put there.  Exit code 1, and no results, where nothing isolates it."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from dsim.grading import items as rubrics
from dsim.grading import results
from dsim.grading.another_user import OtherUserStudent, check_other_user
from dsim.grading.grade import Task, grade_one
from dsim.grading.items import Outcome
from dsim.grading.results import RESULTS, Graded
from dsim.grading.sandbox import SandboxedStudent, SandboxError, check_sandbox
from dsim.grading.submission import KINDS
from dsim.pictures.files import write_atomically

GIVEN = ("kit.py", "test_public.py")  # students may hand these in as well; they are not looked at
WEAKER = "Graded as another user, without a sandbox (weaker isolation). "


def isolation(other_user: bool, closed: list[Path]) -> type[SandboxedStudent]:
    """The sandbox, if it holds here; else another user, if that was chosen when the zip was made and holds.

    Raises SandboxError.
    """
    try:
        check_sandbox()
        return SandboxedStudent
    except SandboxError as error:
        if not other_user:
            raise SandboxError(f"{error}\nTo grade here all the same, under weaker isolation, make the zip again with "
                               "dsim assignments gradescope NN --other-user-there") from None  # fmt: skip
        print(f"No sandbox here ({error}).\nAs chosen when the zip was made, the submission runs as another user.")
    check_other_user(closed)
    return OtherUserStudent


def handed_in(directory: Path, name: str) -> Path | str:
    """The one submission, or what is wrong with what was handed in; NAME.py or NAME.ipynb wins where there are more."""
    found = sorted(path for path in directory.rglob("*") if path.suffix.lower() in KINDS and path.name not in GIVEN)
    named = [path for path in found if path.stem == name]
    if len(found) == 1 or len(named) == 1:
        return (named or found)[0]
    told = f"there are {', '.join(path.name[:60] for path in found[:6])}" if found else "there is none"
    return f"hand in one file, {name}.py or {name}.ipynb; {told}"


def marked(data: bytes, weaker: bool) -> bytes:
    """results.json with the isolation told in it."""
    found = json.loads(data)
    found["output"] = (WEAKER if weaker else "") + found["output"]
    found["extra_data"]["sandboxed"] = not weaker
    found["extra_data"]["isolation"] = "another user" if weaker else "sandbox"
    return (json.dumps(found, indent=1, allow_nan=False) + "\n").encode()


def main(root: Path) -> int:
    """One submission; the exit status."""
    source = root / "source"
    settings = json.loads((source / "settings.json").read_text())
    assignment = source / "assignment" / settings["assignment"]
    try:
        student = isolation(settings["other_user"], [source / "secret", assignment, root / "results", source])
    except SandboxError as error:
        print(f"NOT GRADED: {error}")
        return 1
    found = handed_in(root / "submission", assignment.name)
    with TemporaryDirectory(prefix="dsim-gradescope-") as directory:
        to = Path(directory)
        if isinstance(found, str):
            rows = rubrics.rubric(assignment / "rubric.toml")
            lost = tuple(Outcome(item, 0.0, "nothing to grade") for item in rows)
            results.write(Graded(assignment.name, lost, refused=found), to)
        else:
            grade_one(Task(assignment, found, to, (source / "secret").read_bytes(), student=student))
        data = marked((to / RESULTS).read_bytes(), student is OtherUserStudent)
    write_atomically(root / "results" / RESULTS, data).chmod(0o644)
    print(f"graded: {json.loads(data)['score']:g} of {json.loads(data)['max_score']:g}")
    return 0


if __name__ == "__main__":
    os.umask(0o077)
    sys.exit(main(Path(sys.argv[1])))
