"""A filter of system calls for bubblewrap: memory that belongs to no process cannot be made.

What a process maps is seen by the watch on memory and limited by prlimit; a file of `memfd_create` or a System V
segment that nobody maps is neither.  The filter answers such calls with EPERM, and lets all others pass.

It is a classic BPF program, an array of struct sock_filter: (operation, jump if true, jump if false, value), see
seccomp(2) and bpf(4).  On a processor that is not in the table there is none, and the probe of the sandbox says so.
"""

from __future__ import annotations

import platform
import struct

# machine: (AUDIT_ARCH, numbers of memfd_create, memfd_secret, shmget)
MACHINES = {"x86_64": (0xC000003E, (319, 447, 29)), "aarch64": (0xC00000B7, (279, 447, 194))}
LOAD, EQUAL, LEAST, RETURN = 0x20, 0x15, 0x35, 0x06  # BPF_LD|W|ABS, BPF_JMP|JEQ|K, BPF_JMP|JGE|K, BPF_RET|K
ALLOW, REFUSE = 0x7FFF0000, 0x00050001  # SECCOMP_RET_ALLOW, SECCOMP_RET_ERRNO with EPERM
NUMBER, ARCHITECTURE = 0, 4  # where they lie in struct seccomp_data
OTHER_NUMBERS = 0x40000000  # from here on calls of the x32 kind, which are the same calls by other numbers


def program(machine: str = "") -> bytes:
    """The filter for a machine, by default this one; b"" for one that is not in the table."""
    if (machine or platform.machine()) not in MACHINES:
        return b""
    architecture, calls = MACHINES[machine or platform.machine()]
    last = 5 + len(calls)  # the place of "refuse"; a jump counts from the instruction that follows it
    steps = [(LOAD, 0, 0, ARCHITECTURE), (EQUAL, 0, last - 2, architecture), (LOAD, 0, 0, NUMBER)]
    steps.append((LEAST, last - 4, 0, OTHER_NUMBERS))
    steps += [(EQUAL, last - 5 - place, 0, call) for place, call in enumerate(calls)]
    steps += [(RETURN, 0, 0, ALLOW), (RETURN, 0, 0, REFUSE)]
    return b"".join(struct.pack("<HBBI", *step) for step in steps)
