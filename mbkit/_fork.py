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
#: Time of the first wait for a lock, s.
_FIRST_WAIT_SECONDS: Final = 0.02
_TAKEN: Final[list[list[Any]]] = []


def fork_safe(lock: Lock) -> Lock:
    """Return the lock, which its thread may take twice; a fork waits for it from now on."""
    _LOCKS[next(_NUMBERS)] = lock
    return lock


def _take() -> None:
    """Take all locks, though other threads take several of them in orders of their own.

    It waits for the first as long as that takes, holding none, and for each other one for a while: two threads that
    wait for each other part then. The while doubles, as some work takes long.
    """
    locks, busy, patience = list(_LOCKS.values()), 0, _FIRST_WAIT_SECONDS
    while True:
        locks = [*locks[busy:], *locks[:busy]]
        times = (-1.0, *[patience] * (len(locks) - 1))
        waited = (lock.acquire(timeout=time) for lock, time in zip(locks, times, strict=False))
        held = next((k for k, taken in enumerate(waited) if not taken), len(locks))
        if held == len(locks):
            _TAKEN.append(locks)
            return
        _free(locks[:held])
        busy, patience = held, 2.0 * patience


def _free(locks: list[Any]) -> None:
    for lock in reversed(locks):
        lock.release()


def _release() -> None:
    _free(_TAKEN.pop())


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_take, after_in_parent=_release, after_in_child=_release)
