"""An end to calls that take too long and ask nobody whether to go on."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Final

from mbkit.studies.rollouts import TooLongError

__all__ = ["limited"]

#: A signal that code in C++ lost is sent again, s.
_AGAIN: Final = 0.25


@contextmanager
def limited(seconds: float) -> Iterator[None]:
    """Raise `TooLongError` after so many seconds of the processor's time.

    Python is interrupted wherever it is, and so is CasADi, which looks for signals while CVODES runs. What
    does not look for them goes on: that takes an end to the process. Threads but the main one get no
    signals, and no bound.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    sent = threading.Event()

    def stop(_number: int, _frame: FrameType | None) -> None:
        sent.set()
        raise TooLongError(f"given up after {seconds:.2g} s")

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds, _AGAIN)
    try:
        yield
    except KeyboardInterrupt:
        if not sent.is_set():
            raise
        # CasADi's answer to any signal.
        raise TooLongError(f"given up after {seconds:.2g} s") from None
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)
