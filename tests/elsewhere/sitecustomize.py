"""Takes away what Windows lacks, from this process and from those that it starts: Python finds this file by its name.

What others need on Linux stays: SIGKILL and descriptors for the standard library, ``os.uname`` for NumPy.
"""

import importlib.abc
import os
import signal
import socket
import sys

MODULES = {"curses", "fcntl", "grp", "pty", "pwd", "readline", "resource", "syslog", "termios", "tty"}
OF_WINDOWS = {"SIGABRT", "SIGFPE", "SIGILL", "SIGINT", "SIGSEGV", "SIGTERM"}
OF_THE_LIBRARY = {"SIGKILL", "SIG_DFL", "SIG_IGN"}
CALLS = {
    "fork", "forkpty", "getegid", "getgid", "getgroups", "getloadavg", "getpgid", "getpriority", "getresuid",
    "killpg", "mkfifo", "mknod", "nice", "openpty", "posix_spawn", "register_at_fork", "sched_getaffinity",
    "sched_setaffinity", "setpgid", "setsid", "sync", "sysconf",
}  # fmt: skip
TIMERS = {"SIG_BLOCK", "SIG_SETMASK", "SIG_UNBLOCK", "alarm", "pause", "pthread_kill", "pthread_sigmask", "setitimer"}


class _Missing(importlib.abc.MetaPathFinder):
    def find_spec(self, name: str, path: object, target: object = None) -> None:
        """Refuse modules that are of POSIX alone."""
        if name in MODULES:
            raise ModuleNotFoundError(f"No module named {name!r}, as on Windows", name=name)


def _refuse_proc(event: str, arguments: tuple[object, ...]) -> None:
    if event == "open" and isinstance(arguments[0], str | bytes) and os.fsdecode(arguments[0]).startswith("/proc"):
        raise FileNotFoundError(f"there is no {arguments[0]!r}, as on Windows")


signals = {name for name in vars(signal) if name.startswith("SIG") and name[3] not in "_"}
for name in (signals - OF_WINDOWS - OF_THE_LIBRARY) | TIMERS:
    if hasattr(signal, name):
        delattr(signal, name)
for name in CALLS:
    if hasattr(os, name):
        delattr(os, name)
for name in ("AF_UNIX", "AF_NETLINK", "SO_REUSEPORT"):
    if hasattr(socket, name):
        delattr(socket, name)
for name in MODULES & set(sys.modules):
    del sys.modules[name]
sys.meta_path.insert(0, _Missing())
sys.addaudithook(_refuse_proc)
