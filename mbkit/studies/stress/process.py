"""A worker process, seen from the study: asked, waited for as long as it is worth, and ended."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

from mbkit.errors import UnsupportedError
from mbkit.studies.stress.messages import Answer, Doing, Failed, Introduce, Request, Stage
from mbkit.studies.stress.result import End
from mbkit.studies.stress.server import MEMORY

__all__ = ["USED_UP", "LostError", "Patience", "Worker"]

#: What a worker starts with: the folders that modules are found in, before it changes into its own.
_PROGRAM: Final = (
    "import sys; numbers = [int(x) for x in sys.argv[1:3]]; sys.path[:] = sys.argv[3:]; "
    "from mbkit.studies.stress.server import serve; serve(*numbers)"
)
#: Seconds until a worker has imported what it needs.
_START: Final = 60.0
#: Seconds that a soft bound may be missed by, and the part of it.
_GRACE: Final = (0.5, 0.25)
#: What does not compute has so many times as long as it may compute, and what does nothing is asked
#: again after so many seconds.
_MOST: Final = 4.0
_LEAST: Final = 0.05
#: Why a value was left out when there was no time left.
USED_UP: Final = "not run: the time allowed was used up"
#: Characters of what a process said that are read.
_TAIL: Final = 20_000

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
        self._process: subprocess.Popen[bytes] | None = None
        self._channel: Connection[Any, Any] | None = None
        self._folder = home
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
        if self._process is None:
            self._start()
        case = request.case
        if case not in self._known and not isinstance(request, Introduce):
            answer = self._one(self._introductions[case], patience, until)
            if isinstance(answer, Failed):
                return answer
            self._known.add(case)
        return self._one(request, patience, until)

    def _one(self, request: Request, patience: Patience, until: float) -> Answer:
        assert self._channel is not None
        doing: Doing = "case"
        try:
            self._channel.send(request)
        except OSError:
            self._lost(doing)
        while True:
            message = self._next(_strict(patience(doing)), until, doing)
            if not isinstance(message, Stage):
                return message  # type: ignore[no-any-return]
            doing = message.doing

    def _next(self, seconds: float, until: float, doing: Doing) -> Any:
        """Return what comes next, within so many seconds of the processor's time."""
        assert self._channel is not None
        assert self._process is not None
        spent, begun = _processor_seconds(self._process.pid), time.perf_counter()
        end, last = begun + seconds, min(begun + _MOST * seconds, until)
        while True:
            try:
                if self._channel.poll(max(0.0, min(end, last) - time.perf_counter())):
                    return self._channel.recv()
            except (EOFError, OSError):
                self._lost(doing)
            # On a busy machine it may not have had the time that it was given.
            missing = seconds - (_processor_seconds(self._process.pid) - spent)
            if missing <= 0 or end >= last:
                break
            end = time.perf_counter() + max(missing, _LEAST)
        self.end()
        if time.perf_counter() >= until:
            raise LostError("not run", USED_UP, doing)
        raise LostError("slow", f"stopped after {time.perf_counter() - begun:.2g} s{_AT.get(doing, '')}", doing)

    def _start(self) -> None:
        self._folder = Path(tempfile.mkdtemp(dir=self._home, prefix="worker-"))
        ours, its = socket.socketpair()
        command = [sys.executable, "-c", _PROGRAM, str(its.fileno()), str(self._memory)]
        command += [os.path.abspath(path) for path in sys.path]
        with its, (self._folder / "output").open("wb") as output:
            self._process = subprocess.Popen(
                command,
                cwd=self._folder,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                pass_fds=[its.fileno()],
                env=_environment(self._home),
                # Ctrl-C is for the study, and what a worker started ends with it.
                start_new_session=True,
            )
        self._channel, self._known = Connection(ours.detach()), set()
        if self._closed.is_set():
            self.end()
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

    def _lost(self, doing: Doing) -> None:
        """Raise what became of a process that is gone."""
        assert self._process is not None
        try:
            code: int | None = self._process.wait(timeout=5.0)
        except subprocess.TimeoutExpired:
            code = None
        told = _why(code, self._said())
        self.end()
        raise LostError("died", told + _AT.get(doing, ""), doing)

    def _said(self) -> str:
        try:
            return (self._folder / "output").read_bytes()[-_TAIL:].decode("utf-8", "replace")
        except OSError:
            return ""

    def end(self) -> None:
        """End the process and all that it started; the next request starts another."""
        process, channel = self._process, self._channel
        self._process = self._channel = None
        if process is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        if channel is not None:
            channel.close()

    def close(self) -> None:
        """End the process from another thread, which will be told that it is lost."""
        self._closed.set()
        process = self._process
        if process is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


#: Where a worker was, for messages.
_AT: Final[dict[Doing, str]] = {
    "case": ", making the problem",
    "truth": ", searching for its truth",
    "engine": ", making the engine",
    "method": ", deriving and compiling",
}


def _processor_seconds(pid: int) -> float:
    """Return what a process has computed so far, s; the wall's time where that is not told."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
    except OSError:
        return time.perf_counter()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _strict(seconds: float) -> float:
    """Return after how many seconds a process is ended that should have stopped by itself."""
    return seconds * (1 + _GRACE[1]) + _GRACE[0]


def _environment(home: Path) -> dict[str, str]:
    # One run at a time and one thread each: run times are to be compared. What is
    # compiled is kept for the study alone, so that no other entries have to go for it.
    threads = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    kept = {"MBKIT_CACHE_DIR": str(home / "code"), "HEYOKA_CACHE_DIR": str(home / "code-heyoka")}
    return {**os.environ, **dict.fromkeys(threads, "1"), **kept}


def _why(code: int | None, said: str) -> str:
    """Return in words how a process ended."""
    if "std::bad_alloc" in said or "MemoryError" in said or "out of memory" in said.lower():
        return MEMORY
    if code is None:
        return "the process gave up the connection"
    if code == -signal.SIGKILL:
        return "the process was killed, as systems do that have no memory left"
    if code < 0:
        try:
            name = signal.Signals(-code).name
        except ValueError:
            name = f"signal {-code}"
        lines = [x.strip() for x in said.splitlines() if x.strip()]
        # What came before Python's own account of the crash.
        own = next(
            (
                k
                for k, x in enumerate(lines)
                if re.match(r"Fatal Python error|Current thread|Thread 0x|Extension modules", x)
            ),
            None,
        )
        last = lines[:own][-1:] if own is not None else lines[-1:]
        return f"the process died of {name}" + (f" ({last[0][:200]})" if last else "")
    last = said.strip().splitlines()[-1:]
    return f"the process ended with status {code}" + (f" ({last[0][:200]})" if last else "")
