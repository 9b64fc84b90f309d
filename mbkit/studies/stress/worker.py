"""A worker process, seen from the study: asked, waited for as long as it is worth, and ended."""

from __future__ import annotations

import os
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, NoReturn

from mbkit.errors import UnsupportedError
from mbkit.studies._processes import Child, EndedError, OverdueError
from mbkit.studies.stress.messages import Answer, Doing, Failed, Introduce, Request, Stage
from mbkit.studies.stress.result import End

__all__ = ["USED_UP", "LostError", "Patience", "Worker"]

#: Seconds until a worker has imported what it needs.
_START: Final = 60.0
#: Seconds that a soft bound may be missed by, and the part of it.
_GRACE: Final = (0.5, 0.25)
#: Why a value was left out when there was no time left.
USED_UP: Final = "not run: the time allowed was used up"

#: From what a worker is at to the seconds that it may take.
Patience = Callable[[Doing], float]


class LostError(Exception):
    """A worker is gone; never leaves `mbkit.studies`.

    Attributes
    ----------
    end : {"died", "slow", "not run"}
    note : str
    doing : str
        What it was at.
    """

    def __init__(self, end: End, note: str, doing: Doing) -> None:
        super().__init__(note)
        self.end, self.note, self.doing = end, note, doing


class Worker:
    """A process that answers one request at a time, in a folder of its own; started when it is asked.

    Parameters
    ----------
    home : Path
        Folder of the study.
    memory : int
        Bytes that the process may take; 0 for no bound.
    introductions : mapping of str to Introduce
        Case -> how a worker gets to know it.
    """

    def __init__(self, home: Path, memory: int, introductions: Mapping[str, Introduce]) -> None:
        self._home, self._memory = home, memory
        self._introductions = introductions
        self._child: Child | None = None
        self._known: set[str] = set()
        self._closed = threading.Event()

    def ask(self, request: Request, patience: Patience, until: float) -> Answer:
        """Return the answer to a request.

        Parameters
        ----------
        request : Request
        patience : callable
            How long what it is at may take, of the processor's time.
        until : float
            When the study is over, on `time.perf_counter`.

        Raises
        ------
        LostError
            The process ended, or was ended because it took too long.
        UnsupportedError
            Processes cannot be started here.
        """
        if self._child is None:
            self._start()
        case = request.case
        if case not in self._known and not isinstance(request, Introduce):
            answer = self._one(self._introductions[case], patience, until)
            if isinstance(answer, Failed):
                return answer
            self._known.add(case)
        return self._one(request, patience, until)

    def _one(self, request: Request, patience: Patience, until: float) -> Answer:
        assert self._child is not None
        doing: Doing = "case"
        try:
            self._child.send(request)
        except EndedError as error:
            self._lost(error, doing)
        while True:
            message = self._next(_strict(patience(doing)), until, doing)
            if not isinstance(message, Stage):
                return message  # type: ignore[no-any-return]
            doing = message.doing

    def _next(self, seconds: float, until: float, doing: Doing) -> Any:
        """Return what comes next, within so many seconds of the processor's time."""
        assert self._child is not None
        try:
            return self._child.receive(seconds, until)
        except EndedError as error:
            self._lost(error, doing)
        except OverdueError as error:
            self.end()
            if time.perf_counter() >= until:
                raise LostError("not run", USED_UP, doing) from None
            raise LostError("slow", f"stopped after {error.seconds:.2g} s{_AT.get(doing, '')}", doing) from None

    def _start(self) -> None:
        folder = Path(tempfile.mkdtemp(dir=self._home, prefix="worker-"))
        self._child = Child("mbkit.studies.stress.worker_main", self._memory, folder, _environment(self._home))
        self._known = set()
        if self._closed.is_set():
            self._child.kill()
        try:
            # It says that it is there.
            self._next(_START, time.perf_counter() + _START, "case")
        except LostError as error:
            if self._closed.is_set():
                raise
            raise UnsupportedError(
                f"stress: worker processes do not start: {error.note}; each needs some 300 MB of memory, "
                "and a Python with which mbkit can be imported"
            ) from None

    def _lost(self, error: EndedError, doing: Doing) -> NoReturn:
        """Raise what became of a process that is gone."""
        self.end()
        raise LostError("died", error.how + _AT.get(doing, ""), doing) from None

    def end(self) -> None:
        """End the process and all that it started; the next request starts another."""
        child, self._child = self._child, None
        if child is not None:
            child.end()

    def close(self) -> None:
        """End the process from another thread, which will be told that it is lost."""
        self._closed.set()
        child = self._child
        if child is not None:
            child.kill()


#: Where a worker was, for messages.
_AT: Final[dict[Doing, str]] = {
    "case": ", making the problem",
    "truth": ", searching for its truth",
    "engine": ", making the engine",
    "method": ", deriving and compiling",
}


def _strict(seconds: float) -> float:
    """Return after how many seconds a process is ended that should have stopped by itself."""
    return seconds * (1 + _GRACE[1]) + _GRACE[0]


def _environment(home: Path) -> dict[str, str]:
    # One run at a time and one thread each: run times are to be compared. What is
    # compiled is kept for the study alone, so that no other entries have to go for it.
    threads = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    kept = {"MBKIT_CACHE_DIR": str(home / "code"), "HEYOKA_CACHE_DIR": str(home / "code-heyoka")}
    return {**os.environ, **dict.fromkeys(threads, "1"), **kept}
