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

_LOCKS: Final[WeakValueDictionary[int, Any]] = WeakValueDictionary()
_NUMBERS: Final = count()
_TAKEN: Final[list[list[Any]]] = []


def fork_safe(lock: Lock) -> Lock:
    """Return the lock, which its thread may take twice; a fork waits for it from now on."""
    _LOCKS[next(_NUMBERS)] = lock
    return lock


def _take() -> None:
    """Take all locks, and hold none while it waits for one: other threads take several, in orders of their own."""
    locks, first = list(_LOCKS.values()), 0
    while True:
        # The one that was not free comes first.
        locks = [*locks[first:], *locks[:first]]
        # Only the first is waited for.
        busy = next((k for k, lock in enumerate(locks) if not lock.acquire(blocking=k == 0)), None)
        if busy is None:
            _TAKEN.append(locks)
            return
        _free(locks[:busy])
        first = busy


def _free(locks: list[Any]) -> None:
    for lock in reversed(locks):
        lock.release()


def _release() -> None:
    _free(_TAKEN.pop())


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_take, after_in_parent=_release, after_in_child=_release)
