"""How a process that `mbkit.studies._processes` starts begins: bounded, quiet, and never outliving who asked for it."""

from __future__ import annotations

import ctypes
import faulthandler
import signal
import sys
from multiprocessing.connection import Connection
from typing import Any, Final

__all__ = ["opened"]

#: Linux's prctl: the signal that a process gets when the thread that started it is gone.
_PR_SET_PDEATHSIG: Final = 1


def opened(handle: int, memory: int, *, follow: bool) -> Connection[Any, Any]:
    """Return the connection to who started this process.

    Parameters
    ----------
    handle : int
        File descriptor.
    memory : int
        Bytes that the process may take; 0 for no bound.
    follow : bool
        Whether it ends at once with the thread that started it, whatever it is at.
    """
    # Ctrl-C is the parent's.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if follow and sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    faulthandler.enable()
    _bound(memory)
    return Connection(handle)


def _bound(memory: int) -> None:
    import resource

    # A crash leaves no core file behind.
    resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))
    if memory:
        # What is written to, not what LLVM and heyoka only reserve.
        hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
        limit = memory if hard == resource.RLIM_INFINITY else min(memory, hard)
        resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))
