"""A submission that tries to get out.  The sandbox is in use only after it has failed at all of it."""

import contextlib
import ctypes
import os
import signal
import socket
from typing import Any

import numpy as np


def processes(most: int) -> int:
    """How many children could be started, at most `most`; all are ended again."""
    children = []
    try:
        for _ in range(most):
            child = os.fork()
            if child == 0:
                signal.pause()
                os._exit(0)
            children.append(child)
    except OSError:
        pass
    for child in children:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    return len(children)


def memory(gigabytes: float) -> bool:
    """Whether so much memory was given."""
    try:
        np.empty(int(gigabytes * 2**30), dtype=np.uint8)
    except MemoryError:
        return False
    return True


def homeless_memory() -> list[str]:
    """Calls that gave memory which no process need map: a file of memfd_create, a segment of System V."""
    found = []
    with contextlib.suppress(OSError):
        os.close(os.memfd_create("probe"))
        found.append("memfd_create")
    system = ctypes.CDLL(None)
    segment = system.shmget(0, 4096, 0o1600)  # IPC_PRIVATE; IPC_CREAT and rights for its owner
    if segment >= 0:
        system.shmctl(segment, 0, None)  # IPC_RMID
        found.append("shmget")
    return found


def network() -> bool:
    """Whether any interface beside loopback exists, or a packet could be sent."""
    if [name for _, name in socket.if_nameindex() if name != "lo"]:
        return True
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            out.sendto(b"out", ("192.0.2.1", 9))
    except OSError:
        return False
    return True


def writable() -> list[str]:
    """Directories in which a file could be made, /tmp apart."""
    found = []
    for root, directories, _ in os.walk("/"):
        if root.startswith(("/proc", "/tmp")):
            directories.clear()
            continue
        try:
            with open(os.path.join(root, ".probe"), "w"):
                found.append(root)
        except OSError:
            pass
    return found


def visible(name: str) -> list[str]:
    """Paths of files or directories called so."""
    return [os.path.join(root, name) for root, ds, fs in os.walk("/") if name in ds or name in fs][:20]


def user() -> tuple[Any, ...]:
    """(real user, effective user, capabilities as hexadecimal)."""
    with open("/proc/self/status") as status:
        lines = {line.partition(":")[0]: line.partition(":")[2].strip() for line in status}
    return os.getuid(), os.geteuid(), lines["CapEff"], lines["CapPrm"], lines["CapBnd"], lines["NoNewPrivs"]
