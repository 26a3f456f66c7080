"""An autograder for Gradescope in one zip: the assignment's checks, dsim itself, the secret, and what starts them."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path

from dsim.grading import parcel, there
from dsim.grading.folder import Assignment
from dsim.pictures.files import write_atomically

STARTED = ("setup.sh", "run_autograder")
NEEDS = (
    "numpy>=2.0",
    "scipy>=1.15",
    "matplotlib>=3.9",
    "typer>=0.15",
    "rich>=13",
    "jinja2>=3.1",
    "pillow>=10",
    "hypothesis>=6.100",
)  # fmt: skip  what dsim depends on; a test compares it with pyproject.toml

SANDBOX_OR_NOTHING = """\
Isolation there: the sandbox of `dsim grade`, or no grade. Gradescope's
containers usually may not make that sandbox. Then the autograder ends with an
error, no submission is run, and nobody gets a 0 for it. Try "Test Autograder"
first; if it says NOT GRADED, either grade with `dsim grade` on a machine of
your own, or make the zip again with --other-user-there and read what that gives
up.
"""
OTHER_USER = """\
Isolation there: the sandbox of `dsim grade` where the container may make one.
Usually it may not; then, as chosen with --other-user-there, submissions run as
ANOTHER USER, which is weaker, and every such result says so.
Still so: only values leave the student's process and grades are made outside
it; the secret, the hidden checks and the results cannot be read; processes,
memory, time and file sizes have limits; nothing is left running. Each run
proves it.
No longer so: the network is open, so a submission can send away the inputs it
is given; it sees the container's public files and the list of processes; /tmp
is shared; the memory of processes that leave their parent adds up.
"""


def told(other_user: bool) -> str:
    """What isolation a submission has in Gradescope's container."""
    return OTHER_USER if other_user else SANDBOX_OR_NOTHING


def readme(assignment: Assignment, other_user: bool) -> str:
    """README.md of the zip."""
    return f"""# Autograder of {assignment.path.name}

Upload this zip under "Configure Autograder"; an image with Python 3.11 or newer builds fastest (Ubuntu 24.04).
Students hand in one file, `{assignment.path.name}.py` or `.ipynb`. Made by `dsim assignments gradescope`.

{told(other_user)}
The zip holds the secret that hidden inputs are drawn from, and the hidden checks: give it to nobody.
`setup.sh` asks the image's apt for bubblewrap (and Python, where it is older than 3.11), and pip for
`requirements.txt`; nothing else is fetched.
"""


def archive(assignment: Assignment, secret: bytes, other_user: bool) -> bytes:
    """The bytes of the zip."""
    files: dict[str, bytes] = {name: (Path(there.__file__).parent / name).read_bytes() for name in STARTED}
    files["README.md"] = readme(assignment, other_user).encode()
    files["requirements.txt"] = ("\n".join(NEEDS) + "\n").encode()
    files["settings.json"] = json.dumps({"assignment": assignment.path.name, "other_user": other_user}).encode()
    files["secret"] = secret
    for path in parcel.needed(assignment.path):
        files[f"assignment/{assignment.path.name}/{path.as_posix()}"] = (assignment.path / path).read_bytes()
    for path in parcel.sources():
        files[f"package/dsim/{path.as_posix()}"] = (parcel.PACKAGE / path).read_bytes()
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as out:
        for name, content in files.items():
            entry = zipfile.ZipInfo(name)
            entry.external_attr = (0o100755 if name in STARTED else 0o100644) << 16
            out.writestr(entry, content, zipfile.ZIP_DEFLATED)
    return data.getvalue()


def write(assignment: Assignment, to: Path, secret: bytes, other_user: bool = False) -> None:
    """The zip, readable by its owner alone, whole or not at all."""
    write_atomically(to, archive(assignment, secret, other_user)).chmod(0o600)
