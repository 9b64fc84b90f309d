"""Locks that a fork waits for.

A forked child has the forking thread only. A lock of another thread would stay locked in the child, and its data may be
half written. A fork therefore takes these locks first, and parent and child release them afterwards.
"""

from __future__ import annotations

import os
from itertools import count
from typing import Any, Final, TypeVar
from weakref import WeakValueDictionary

Lock = TypeVar("Lock")

#: In the order of their creation, so that two threads that fork at once take them in the same order.
_LOCKS: Final[WeakValueDictionary[int, Any]] = WeakValueDictionary()
_NUMBERS: Final = count()
_TAKEN: Final[list[list[Any]]] = []


def fork_safe(lock: Lock) -> Lock:
    """Return the lock, a context manager that may be entered twice; a fork waits for it from now on."""
    _LOCKS[next(_NUMBERS)] = lock
    return lock


def _take() -> None:
    locks = [lock for _, lock in sorted(_LOCKS.items())]
    for lock in locks:
        lock.__enter__()
    _TAKEN.append(locks)


def _release() -> None:
    for lock in reversed(_TAKEN.pop()):
        lock.__exit__(None, None, None)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_take, after_in_parent=_release, after_in_child=_release)
