"""Confinement of a reader process: what a file that takes it over can still do.

A process that is confined reads its file, the companions that belong to it, and the program's own code; it opens no
other file, writes none, connects nowhere and starts nothing. Linux enforces that by three means, none of which needs a
privilege and none of which can be taken back:

- `no_new_privs`: no program that it might start gains rights;
- Landlock: files beyond the permitted ones cannot be opened, whatever their permissions; TCP is denied;
- seccomp: a filter of system calls refuses sockets, new processes and programs, tracing of others, files opened for
  writing, and the calls that administer the machine.

They hold for the thread that asks for them and those that it starts, so that a process has to be single-threaded.
Other systems have nothing of the kind that a program may use for itself without preparations; there the process is only
separate, with the limits of `worker`.

Source: Documentation/userspace-api/landlock.rst, seccomp_filter.rst and no_new_privs.rst of the Linux kernel.
"""

from __future__ import annotations

import ctypes
import errno
import os
import platform
import struct
import sys
import sysconfig
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

_PR_SET_SECCOMP, _PR_GET_SECCOMP, _PR_SET_NO_NEW_PRIVS = 22, 21, 38
_MODE_FILTER = 2
# The same on all machines.
_LANDLOCK_CREATE, _LANDLOCK_ADD, _LANDLOCK_RESTRICT = 444, 445, 446
_LANDLOCK_VERSION = 1
_PATH_BENEATH = 1
_READ_FILE, _READ_FOLDER = 1 << 2, 1 << 3
_FILE_RIGHTS = {1: 13, 2: 14, 3: 15, 4: 15, 5: 16}  # number of rights by version of the interface
_TCP_RIGHTS = 0b11  # bind, connect; since version 4
_SCOPES = 0b11  # abstract sockets, signals; since version 6
_NETWORK_SINCE, _SCOPES_SINCE = 4, 6

_ARCHITECTURES = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}
_X32_BIT = 0x40000000
_Numbers = tuple[int | None, int | None]
_NUMBERS: dict[str, _Numbers] = {
    # sockets
    "socket": (41, 198), "connect": (42, 203), "accept": (43, 202), "bind": (49, 200), "listen": (50, 201),
    "socketpair": (53, 199), "accept4": (288, 242), "sendto": (44, 206), "sendmsg": (46, 211), "sendmmsg": (307, 269),
    # other ways between processes
    "shmget": (29, 194), "semget": (64, 190), "msgget": (68, 186), "mq_open": (240, 180),
    "rt_sigqueueinfo": (129, 138), "rt_tgsigqueueinfo": (297, 240), "tkill": (200, 130),
    "pidfd_send_signal": (424, 424), "pidfd_open": (434, 434), "pidfd_getfd": (438, 438), "process_madvise": (440, 440),
    "ptrace": (101, 117), "process_vm_readv": (310, 270), "process_vm_writev": (311, 271),
    # new processes and programs
    "fork": (57, None), "vfork": (58, None), "execve": (59, 221), "execveat": (322, 281),
    # files are only read
    "creat": (85, None), "truncate": (76, 45), "rename": (82, None), "renameat": (264, 38), "renameat2": (316, 276),
    "mkdir": (83, None), "mkdirat": (258, 34), "rmdir": (84, None), "unlink": (87, None), "unlinkat": (263, 35),
    "link": (86, None), "linkat": (265, 37), "symlink": (88, None), "symlinkat": (266, 36), "mknod": (133, None),
    "mknodat": (259, 33), "chmod": (90, None), "fchmod": (91, 52), "fchmodat": (268, 53), "fchmodat2": (452, 452),
    "chown": (92, None), "fchown": (93, 55), "lchown": (94, None), "fchownat": (260, 54), "utime": (132, None),
    "utimes": (235, None), "futimesat": (261, None), "utimensat": (280, 88), "setxattr": (188, 5),
    "lsetxattr": (189, 6), "fsetxattr": (190, 7), "removexattr": (197, 14), "lremovexattr": (198, 15),
    "fremovexattr": (199, 16), "name_to_handle_at": (303, 264), "open_by_handle_at": (304, 265),
    # the machine
    "mount": (165, 40), "umount2": (166, 39), "pivot_root": (155, 41), "chroot": (161, 51), "unshare": (272, 97),
    "setns": (308, 268), "open_tree": (428, 428), "move_mount": (429, 429), "fsopen": (430, 430),
    "fsconfig": (431, 431), "fsmount": (432, 432), "fspick": (433, 433), "mount_setattr": (442, 442),
    "swapon": (167, 224), "reboot": (169, 142), "syslog": (103, 116), "personality": (135, 92),
    "init_module": (175, 105), "finit_module": (313, 273), "delete_module": (176, 106), "kexec_load": (246, 104),
    "kexec_file_load": (320, 294), "bpf": (321, 280), "perf_event_open": (298, 241), "userfaultfd": (323, 282),
    "add_key": (248, 217), "request_key": (249, 218), "keyctl": (250, 219),
    # io_uring does what the filter refuses elsewhere
    "io_uring_setup": (425, 425), "io_uring_enter": (426, 426), "io_uring_register": (427, 427),
}  # fmt: skip
"""System calls that are refused, on x86_64 and aarch64; None where there is none."""
_UNKNOWN_CALLS = (435, 437)  # clone3 and openat2, whose arguments a filter cannot see: libraries use the older calls
_CLONE, _KILL, _TGKILL = (56, 220), (62, 129), (234, 131)
_OPEN, _OPENAT, _PRCTL = (2, None), (257, 56), (157, 167)
_SET_DEATH_SIGNAL = 1
_CLONE_THREAD = 0x00010000
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC

# Classic BPF: load a word of the call's data, jump, return.
_LOAD, _JUMP_EQUAL, _JUMP_GREATER_EQUAL, _JUMP_BITS, _RETURN = 0x20, 0x15, 0x35, 0x45, 0x06
_CALL_AT, _ARCHITECTURE_AT, _ARGUMENTS_AT = 0, 4, 16
_ALLOW, _ERROR, _KILL_PROCESS = 0x7FFF0000, 0x00050000, 0x80000000

_PROGRAM_FILES = (
    "/lib", "/lib64", "/usr/lib", "/usr/lib64", "/usr/local/lib", "/etc/ld.so.cache", "/etc/localtime",
    "/usr/share/zoneinfo", "/dev/null", "/dev/zero", "/dev/urandom", "/proc/self", "/proc/cpuinfo", "/proc/meminfo",
    "/sys/devices/system/cpu", "/sys/fs/cgroup",
)  # fmt: skip
"""What libraries read when they are loaded or ask for the machine's size; nothing of a user's."""


def confine(files: Iterable[str | os.PathLike[str]]) -> None:
    """Confine this process for the rest of its life, as far as the system can.

    Args:
        files: files and folders that it may read, beside the program's own code; those that do not exist are ignored.
    """
    if sys.platform != "linux" or _prctl(_PR_SET_NO_NEW_PRIVS, 1) != 0:
        return
    _restrict_files([*files, *_code_folders(), *_PROGRAM_FILES])
    _restrict_calls()


def confinement() -> tuple[tuple[str, str], ...]:
    """Return what confines the reader processes on this system: each means by name, and whether it exists."""
    if sys.platform != "linux":
        nothing = "not on this system: reader processes are separate, with limits on time"
        return (("Landlock", nothing), ("seccomp", nothing))
    version = _landlock_version()
    if version < 1:
        landlock = "no: the kernel is older than 5.13, or was started without it (lsm=landlock)"
    else:
        landlock = f"yes, version {version}" + ("" if version >= _NETWORK_SINCE else "; TCP is left to seccomp")
    calls = "yes"
    if platform.machine() not in _ARCHITECTURES:
        calls = f"no: there is no filter for {platform.machine()} processors"
    elif _prctl(_PR_GET_SECCOMP) < 0:
        calls = "no: the kernel was built without it"
    return (("Landlock", landlock), ("seccomp", calls))


def _prctl(operation: int, *arguments: Any) -> int:
    return int(ctypes.CDLL(None).prctl(operation, *map(_word, (*arguments, 0, 0, 0, 0)[:4])))


def _system_call(number: int, *arguments: Any) -> int:
    """Make a system call; below 0 if it fails."""
    call = ctypes.CDLL(None).syscall
    call.restype = ctypes.c_long
    return int(call(ctypes.c_long(number), *map(_word, arguments)))


def _word(value: Any) -> Any:
    """Return an argument that fills a register: the kernel looks at all of it."""
    return ctypes.c_long(value) if isinstance(value, int) else value


def _code_folders() -> set[str]:
    """Return the folders that the program's modules are loaded from."""
    folders = {sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")}
    folders |= {entry for entry in sys.path if Path(entry).name in ("site-packages", "dist-packages", "lib-dynload")}
    return {*folders, str(Path(__file__).resolve().parents[2])}


def _landlock_version() -> int:
    """Return the version of Landlock's interface; below 1 where there is none."""
    return _system_call(_LANDLOCK_CREATE, 0, 0, _LANDLOCK_VERSION)


def _restrict_files(readable: Iterable[str | os.PathLike[str]]) -> None:
    version = _landlock_version()
    if version < 1:
        return
    rights = (1 << _FILE_RIGHTS[min(version, max(_FILE_RIGHTS))]) - 1
    network = _TCP_RIGHTS if version >= _NETWORK_SINCE else 0
    scopes = _SCOPES if version >= _SCOPES_SINCE else 0
    fields = 1 + (version >= _NETWORK_SINCE) + (version >= _SCOPES_SINCE)
    rules = struct.pack("=QQQ", rights, network, scopes)[: 8 * fields]
    ruleset = _system_call(_LANDLOCK_CREATE, rules, len(rules), 0)
    if ruleset < 0:
        return
    try:
        for path in readable:
            with suppress(OSError, ValueError):
                _permit(ruleset, path)
        _system_call(_LANDLOCK_RESTRICT, ruleset, 0)
    finally:
        os.close(ruleset)


def _permit(ruleset: int, path: str | os.PathLike[str]) -> None:
    opened = os.open(path, os.O_PATH | os.O_CLOEXEC)
    try:
        rights = _READ_FILE | _READ_FOLDER if os.path.isdir(path) else _READ_FILE
        rule = struct.pack("=Qi", rights, opened)
        _system_call(_LANDLOCK_ADD, ruleset, _PATH_BENEATH, rule, 0)
    finally:
        os.close(opened)


class _Program(ctypes.Structure):
    _fields_ = (("length", ctypes.c_ushort), ("instructions", ctypes.c_char_p))


def _restrict_calls() -> None:
    machine = platform.machine()
    if machine not in _ARCHITECTURES:
        return
    code = b"".join(struct.pack("=HBBI", *step) for step in filter_of(machine, os.getpid()))
    program = _Program(len(code) // 8, code)
    _prctl(_PR_SET_SECCOMP, _MODE_FILTER, ctypes.byref(program))


_Step = tuple[int, int, int, int]
"""An instruction: its code, how many to skip if its condition is true and if it is false, and its operand."""


def filter_of(machine: str, process: int) -> list[_Step]:
    """Return the filter of system calls.

    Args:
        machine: `x86_64` or `aarch64`.
        process: that may send signals to itself.
    """
    which = list(_ARCHITECTURES).index(machine)
    refused = _RETURN, 0, 0, _ERROR | errno.EPERM
    steps: list[_Step] = [
        (_LOAD, 0, 0, _ARCHITECTURE_AT),
        (_JUMP_EQUAL, 1, 0, _ARCHITECTURES[machine]),
        (_RETURN, 0, 0, _KILL_PROCESS),
        (_LOAD, 0, 0, _CALL_AT),
        (_JUMP_GREATER_EQUAL, 0, 1, _X32_BIT),
        (_RETURN, 0, 0, _ERROR | errno.ENOSYS),
    ]
    for unknown in _UNKNOWN_CALLS:
        steps += [(_JUMP_EQUAL, 0, 1, unknown), (_RETURN, 0, 0, _ERROR | errno.ENOSYS)]
    # By an argument: a call, its place, the test, and whether it must be true.
    tests: tuple[tuple[_Numbers, int, int, int, bool], ...] = (
        (_CLONE, 0, _JUMP_BITS, _CLONE_THREAD, True),
        (_KILL, 0, _JUMP_EQUAL, process, True),
        (_TGKILL, 0, _JUMP_EQUAL, process, True),
        (_OPEN, 1, _JUMP_BITS, _WRITING, False),
        (_OPENAT, 2, _JUMP_BITS, _WRITING, False),
        (_PRCTL, 0, _JUMP_EQUAL, _SET_DEATH_SIGNAL, False),  # this process ends with the one that started it
    )
    for call, argument, test, operand, permitted_if in tests:
        if (number := call[which]) is None:
            continue
        steps += [
            (_JUMP_EQUAL, 0, 4, number),
            (_LOAD, 0, 0, _ARGUMENTS_AT + 8 * argument),  # the lower half: both machines are little-endian
            (test, 1, 0, operand) if permitted_if else (test, 0, 1, operand),
            refused,
            (_RETURN, 0, 0, _ALLOW),
        ]
    for numbers in _NUMBERS.values():
        if (number := numbers[which]) is not None:
            steps += [(_JUMP_EQUAL, 0, 1, number), refused]
    return [*steps, (_RETURN, 0, 0, _ALLOW)]
