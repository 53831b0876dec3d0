"""Runs a stranger's policy or reconstructor, shut in: the child process of :mod:`tslam_bench.evaluation.confinement`.

It shuts itself in before it imports anything but the standard library, since a process with threads cannot: no network, every
file read only but a scratch folder, true shapes and the submission out of sight, no other process visible, no privileges.
Where the system does not allow namespaces, an audit hook of Python refuses the same; that stops mistakes, not attackers.

Requests come on standard input, answers go to standard output (:mod:`tslam_bench.evaluation.messages`).
"""

from __future__ import annotations

import ctypes
import json
import os
import resource
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

_NEW_USER, _NEW_NETWORK, _NEW_MOUNTS, _NEW_PROCESSES = 0x10000000, 0x40000000, 0x00020000, 0x20000000
_RECURSIVE, _PRIVATE, _BIND = 0x4000, 1 << 18, 0x1000
_MOUNT_SETATTR, _AT_RECURSIVE, _READ_ONLY = 442, 0x8000, 1
_DIE_WITH_PARENT, _NO_NEW_PRIVILEGES, _DROP_BOUNDING = 1, 38, 24
_PROCESSES = 64
_NO_NAMESPACES = 71
_REFUSED = (
    "socket.",
    "subprocess.",
    "os.exec",
    "os.fork",
    "os.posix_spawn",
    "os.spawn",
    "os.system",
    "os.kill",
    "ftplib.",
)
_WRITING = ("w", "a", "x", "+")


class _Attributes(ctypes.Structure):
    _fields_ = [(name, ctypes.c_uint64) for name in ("set", "clear", "propagation", "namespace")]


def main() -> None:
    """Shuts this process in and answers requests until standard input ends."""
    requests, answers = os.dup(0), os.dup(1)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(2, 1)  # what the stranger's code prints is no answer
    config = json.loads(_read_line(requests))
    held = _shut_in(config) if config["namespaces"] else None
    if held is None:
        sys.addaudithook(_hook(config["scratch"], config["hidden"]))
        held = {"network": "audit hook", "files": "audit hook"}
    os.chdir(config["scratch"])
    _limit(config, held["network"] == "namespace")
    sys.path[:] = config["path"]
    from tslam_bench.evaluation.confined_server import serve

    serve(config, held, requests, answers)


def _read_line(descriptor: int) -> bytes:
    line = bytearray()
    while not line.endswith(b"\n"):
        part = os.read(descriptor, 1)
        if not part:
            sys.exit(0)
        line += part
    return bytes(line)


def _shut_in(config: dict[str, Any]) -> dict[str, str] | None:
    """Namespaces of its own for this process; None if the system does not allow them."""
    libc = ctypes.CDLL(None, use_errno=True)
    user, group = os.getuid(), os.getgid()
    if libc.unshare(_NEW_USER | _NEW_NETWORK | _NEW_MOUNTS | _NEW_PROCESSES):
        return None
    for name, line in (("setgroups", "deny"), ("uid_map", f"{user} {user} 1"), ("gid_map", f"{group} {group} 1")):
        try:
            Path("/proc/self", name).write_text(line)
        except OSError as error:  # some systems give the namespace and nothing in it
            _give_up(error)
    child = os.fork()  # the first process of the new namespace: when it ends, all others in it do
    if child:
        for descriptor in (0, 1):
            os.close(descriptor)
        _, status = os.waitpid(child, 0)
        os._exit(os.waitstatus_to_exitcode(status) & 0xFF)
    libc.prctl(_DIE_WITH_PARENT, 9, 0, 0, 0)
    try:
        _mount_all(libc, config)
    except OSError as error:
        _give_up(error)
    for capability in range(64):
        libc.prctl(_DROP_BOUNDING, capability, 0, 0, 0)
    header, none = (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()
    if libc.capset(header, none) or libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0):
        _give_up(OSError("privileges cannot be dropped"))
    return {"network": "namespace", "files": "read only, truth hidden"}


def _give_up(error: OSError) -> NoReturn:
    """Half of it is worse than the other way: the parent asks for that one."""
    print(f"confinement: {error}", file=sys.stderr, flush=True)
    os._exit(_NO_NAMESPACES)


def _mount_all(libc: ctypes.CDLL, config: dict[str, Any]) -> None:
    def mount(source: str | None, target: str, kind: str | None, flags: int, options: str | None = None) -> None:
        texts = [None if text is None else os.fsencode(text) for text in (source, target, kind, options)]
        if libc.mount(texts[0], texts[1], texts[2], ctypes.c_ulong(flags), texts[3]):
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number), target)

    mount(None, "/", None, _RECURSIVE | _PRIVATE)
    mount("proc", "/proc", "proc", 0)
    for path in config["hidden"]:
        if Path(path).is_dir():
            mount("tmpfs", path, "tmpfs", 0, "size=4k")
        elif Path(path).exists():
            mount(os.devnull, path, None, _BIND)
    read_only = _Attributes(_READ_ONLY, 0, 0, 0)
    if libc.syscall(_MOUNT_SETATTR, -100, b"/", _AT_RECURSIVE, ctypes.byref(read_only), ctypes.sizeof(read_only)):
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number), "/")
    mount("tmpfs", config["scratch"], "tmpfs", 0, f"size={config['file_bytes']}")


def _limit(config: dict[str, Any], own_processes: bool) -> None:
    limits = {
        resource.RLIMIT_AS: config["memory_bytes"],
        resource.RLIMIT_FSIZE: config["file_bytes"],
        resource.RLIMIT_CPU: config["seconds"],
        resource.RLIMIT_CORE: 0,
    }
    if own_processes:  # elsewhere all processes of the user count
        limits[resource.RLIMIT_NPROC] = _PROCESSES
    for kind, most in limits.items():
        _, hard = resource.getrlimit(kind)
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(kind, (most, most))


def _hook(scratch: str, hidden: Sequence[str]) -> Any:
    """Refuses network, processes, writing outside ``scratch``, and reading what is ``hidden``."""
    own, secret = os.path.realpath(scratch) + os.sep, [os.path.realpath(path) for path in hidden]
    writes = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND

    def refuse(event: str, given: tuple[Any, ...]) -> None:
        if event.startswith(_REFUSED):
            raise PermissionError(f"{event}: not allowed here")
        if event in ("open", "os.listdir", "os.scandir") and given and isinstance(given[0], str | bytes | os.PathLike):
            path = os.path.realpath(os.fsdecode(given[0]))
            if any(path == each or path.startswith(each + os.sep) for each in secret):
                raise FileNotFoundError(2, "No such file or directory", path)
            mode, flags = (given[1] or "", given[2] or 0) if event == "open" and len(given) > 2 else ("", 0)
            writing = any(letter in mode for letter in _WRITING) or bool(flags & writes)
            if writing and not path.startswith(own) and path != os.devnull:
                raise PermissionError(1, "Operation not permitted", path)

    return refuse


if __name__ == "__main__":
    main()
