"""Run a command with what deploy/gsfeatloc-localizer.service forbids, as far as that needs no systemd.

    python scripts/under_unit.py python -P -m pytest test/node/test_node.py

That is the filter of system calls, the capabilities, the umask, and no core file. It needs libseccomp and
systemd-analyze, which knows the sets of system calls. Namespaces (ProtectSystem, PrivateDevices ...), the cgroup
(MemoryMax, TasksMax) and RestrictAddressFamilies are left out.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import errno
import os
import resource
import subprocess
import sys
from pathlib import Path

UNIT = Path(__file__).parents[1] / "deploy" / "gsfeatloc-localizer.service"
# linux/prctl.h, seccomp.h
_PR_CAPBSET_DROP, _PR_SET_NO_NEW_PRIVS = 24, 38
_ALLOW, _ERRNO = 0x7FFF0000, 0x00050000


def settings(name: str) -> list[str]:
    """Return the values of a setting of the unit."""
    lines = UNIT.read_text(encoding="utf-8").splitlines()
    return [line.partition("=")[2] for line in lines if line.startswith(f"{name}=")]


def expand(names: list[str]) -> set[str]:
    """Return the system calls in sets such as @system-service, and those named themselves."""
    calls: set[str] = set()
    for name in names:
        if name.startswith("@"):
            command = ["systemd-analyze", "syscall-filter", name]
            listed = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[1:]
            calls |= expand([line.strip() for line in listed if line.strip() and not line.strip().startswith("#")])
        else:
            calls.add(name)
    return calls


def allowed() -> set[str]:
    """Return the system calls that the unit allows; as of systemd, the first list says whether it allows or denies."""
    calls: set[str] = set()
    for value in settings("SystemCallFilter"):
        if value.startswith("~"):
            calls -= expand(value[1:].split())
        else:
            calls |= expand(value.split())
    return calls


def load_filter(calls: set[str]) -> None:
    """Let this process and its children make these system calls; all others fail with EPERM."""
    seccomp = ctypes.CDLL(ctypes.util.find_library("seccomp") or "libseccomp.so.2")
    seccomp.seccomp_init.restype = ctypes.c_void_p
    context = ctypes.c_void_p(seccomp.seccomp_init(_ERRNO | errno.EPERM))
    for call in calls:
        number = seccomp.seccomp_syscall_resolve_name(call.encode())
        # Below 0: not of this kind of processor.
        if number >= 0 and seccomp.seccomp_rule_add(context, ctypes.c_uint32(_ALLOW), number, 0):
            raise OSError(f"libseccomp does not take {call}")
    if seccomp.seccomp_load(context):
        raise OSError("the kernel does not take the filter of system calls")


def drop_capabilities() -> None:
    """Let no program that is run from here on have a capability."""
    libc = ctypes.CDLL(None, use_errno=True)
    last = int(Path("/proc/sys/kernel/cap_last_cap").read_text())
    for capability in range(last + 1):
        # An ordinary user has none to drop.
        libc.prctl(_PR_CAPBSET_DROP, capability, 0, 0, 0)
    if libc.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0):
        raise OSError(ctypes.get_errno(), "prctl")


def main(command: list[str]) -> None:
    """Become the command."""
    calls = allowed()
    os.umask(int(settings("UMask")[0], 8))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    drop_capabilities()
    load_filter(calls)
    os.execvp(command[0], command)


if __name__ == "__main__":
    main(sys.argv[1:])
