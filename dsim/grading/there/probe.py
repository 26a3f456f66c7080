"""A submission that tries to get out when it runs as another user: what inside/probe.py tries, and more."""

import os
import signal

from probe import memory, processes, user

__all__ = ["memory", "processes", "readable", "stays", "user"]


def readable(paths: list[str]) -> list[str]:
    """Those of the files and directories that can be listed, opened or only seen to be there."""
    found = []
    for path in paths:
        try:
            os.stat(os.path.join(path, ".") if os.path.isdir(path) else path)
            found.append(path)
        except OSError:
            pass
    return found


def stays() -> int:
    """A process that leaves its session, its parent and its pipes; its number."""
    reader, writer = os.pipe()
    if os.fork() == 0:
        os.setsid()
        child = os.fork()
        if child == 0:
            os.closerange(0, 64)
            while True:
                signal.pause()
        os.write(writer, str(child).encode())
        os._exit(0)
    return int(os.read(reader, 20))
