"""Ctrl-C in a command: one line, status 130, at once; and locks that a fork waits for.

Python raises KeyboardInterrupt in its main thread after a library call returns, and libraries may swallow, print or
report it as a failure of their own. So a thread listens too. A command prints one line, is silent from then on, has
`CLOSING_SECONDS` to close its files, and ends. A study that can show a part of its result marks itself with `keeping`:
there the first Ctrl-C is a KeyboardInterrupt, and the second ends the command.

Only light modules of Python are imported here, because the entry point installs this before anything else.

A forked child has the forking thread only. A lock of another thread would stay locked in the child, and its data may be
half written. A fork therefore takes these locks first, and parent and child release them afterwards.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from itertools import count
from weakref import WeakValueDictionary

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any, Final, TypeVar

    Lock = TypeVar("Lock")

    #: Exit status of an interrupted command.
INTERRUPTED = 130
#: Seconds in which an interrupted command may close its files.
CLOSING_SECONDS = 0.3
#: Seconds that the main thread has for what it does at Ctrl-C.
_HANDLER_SECONDS = 0.05
#: Seconds between two looks at a run: for Ctrl-C where other code runs, and for reports of how far it is.
LOOK_SECONDS = 0.1
_LINE = b"interrupted: the command did not finish\n"
#: To the line's beginning, clear it, and show the cursor that a progress bar hides.
_CLEAR = b"\r\x1b[2K\x1b[?25h"


class Section:
    """A part of a command to which Ctrl-C is special; used by ``with``, and may stand in another of its kind."""

    def __init__(self) -> None:
        self.depth = 0

    def __enter__(self) -> Section:
        self.depth += 1
        return self

    def __exit__(self, *_: object) -> None:
        self.depth -= 1
        if _interrupts.pending and not uninterrupted.depth:
            _interrupts.pending = False
            raise KeyboardInterrupt


class _Interrupts:
    """State of the command."""

    def __init__(self) -> None:
        # Number of Ctrl-C, and of those that the main thread knows of.
        self.heard = self.count = 0
        # Whether one came while a file was written, and is still to be raised; whether the command has said so.
        self.pending = self.ending = False
        # A signal handler may come upon itself.
        self.lock = threading.RLock()
        self.at_end: set[Callable[[], object]] = set()


#: A file is being written: Ctrl-C waits until it is whole.
uninterrupted = Section()
#: The finished part will be shown and written: the first Ctrl-C raises KeyboardInterrupt, and the caller goes on.
keeping = Section()
_interrupts = _Interrupts()


def _install() -> None:
    """Listen to Ctrl-C in this process, unless its parent ignores it or a listener is there already."""
    if sys.platform == "win32" or threading.current_thread() is not threading.main_thread():
        return
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return
    listening, waking = os.pipe()
    os.set_blocking(waking, False)
    signal.set_wakeup_fd(waking, warn_on_full_buffer=False)
    signal.signal(signal.SIGINT, _raise)
    threading.Thread(target=_listen, args=(listening,), name="mbkit Ctrl-C", daemon=True).start()


def received() -> bool:
    """Return whether Ctrl-C has come."""
    return _interrupts.count > 0


def raise_again() -> None:
    """Raise KeyboardInterrupt where Ctrl-C has come and a library has swallowed it."""
    if _interrupts.count:
        raise KeyboardInterrupt


def beside(call: Callable[[], object]) -> None:
    """Call a library in a thread, so that Ctrl-C raises KeyboardInterrupt at once; the thread ends with the process."""
    errors: list[BaseException] = []

    def run() -> None:
        try:
            call()
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    while thread.is_alive():
        thread.join(_HANDLER_SECONDS)
    if errors:
        raise errors[0]


def at_end(action: Callable[[], object], *, remove: bool = False) -> None:
    """Call a function, such as one that ends a process, when an interrupted command ends; or no longer."""
    (_interrupts.at_end.discard if remove else _interrupts.at_end.add)(action)


def _listen(listening: int) -> None:
    """End the command from a thread while the main thread is in a library."""
    while True:
        _interrupts.heard += os.read(listening, 64).count(signal.SIGINT)
        time.sleep(_HANDLER_SECONDS)
        if _interrupts.count < _interrupts.heard and (not keeping.depth or _interrupts.heard > 1):
            _begin_end()


def _begin_end() -> None:
    """Print that the command was interrupted, print nothing more, and end it if the main thread does not in time."""
    with _interrupts.lock:
        if _interrupts.ending:
            return
        _interrupts.ending = True
        os.write(2, _CLEAR + _LINE if os.isatty(2) else _LINE)
        # Libraries report an interruption as a failure of theirs.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        threading.Thread(target=_end, args=(True,), daemon=True).start()


def _end(later: bool = False) -> None:
    """End this process and those that it started, at once or when its files are closed."""
    if later:
        time.sleep(CLOSING_SECONDS)
        while uninterrupted.depth:
            time.sleep(0.01)
    for action in list(_interrupts.at_end):
        action()
    os._exit(INTERRUPTED)


def _raise(*_: object) -> None:
    _interrupts.count = max(_interrupts.count + 1, _interrupts.heard)
    if not keeping.depth or _interrupts.count > 1:
        _begin_end()
    if uninterrupted.depth:
        _interrupts.pending = True
    else:
        raise KeyboardInterrupt


class _Ending:
    """Listens to Ctrl-C, and ends the process with the status of an interrupted command where that came."""

    def __enter__(self) -> None:
        _install()

    def __exit__(self, kind: object, *_: object) -> None:
        if isinstance(kind, type) and issubclass(kind, KeyboardInterrupt):
            _begin_end()
        if _interrupts.ending:
            _end()


#: Around all that the entry point does.
ending = _Ending()


_LOCKS: Final[WeakValueDictionary[int, Any]] = WeakValueDictionary()
_NUMBERS: Final = count()
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
    locks, busy, patience = list(_LOCKS.values()), 0, 0.02
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
