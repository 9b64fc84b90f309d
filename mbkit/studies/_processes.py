"""A Python process of our own, seen from who started it: told, listened to for as long as it is worth, ended."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ProcessPoolExecutor, wait
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final, TypeVar

from mbkit import _interrupt

__all__ = ["MEMORY", "MOST", "Child", "EndedError", "OverdueError", "Pool", "WorkerDiedError", "processors", "run"]


#: What a process starts with: the folders that modules are found in, before it changes into its own.
_PROGRAM: Final = (
    "import sys; from importlib import import_module; module, *numbers = sys.argv[1:4]; sys.path[:] = sys.argv[4:]; "
    "import_module(module).serve(*map(int, numbers))"
)
#: How the end of memory is told.
MEMORY: Final = "it took more memory than allowed"
#: What does not compute has so many times as long as it may compute, and what does nothing is asked
#: again after so many seconds.
MOST: Final = 4.0
_LEAST: Final = 0.05
#: Characters of what a process said that are read.
_TAIL: Final = 20_000


class EndedError(Exception):
    """A process ended by itself; never leaves `mbkit.studies`.

    Attributes
    ----------
    how : str
        In words.
    signal : str
        The signal that it died of, such as ``"SIGSEGV"``; empty where none.
    last : str
        The last line that it said.
    """

    def __init__(self, how: str, signal: str = "", last: str = "") -> None:
        super().__init__(how)
        self.how, self.signal, self.last = how, signal, last


class OverdueError(Exception):
    """A process took longer than it may, and is still there; never leaves `mbkit.studies`.

    Attributes
    ----------
    seconds : float
        How long it was listened to.
    """

    def __init__(self, seconds: float) -> None:
        super().__init__(f"nothing heard for {seconds:.2g} s")
        self.seconds = seconds


class Child:
    """A process, which starts at once.

    Parameters
    ----------
    module : str
        Whose function ``serve(handle, memory)`` it runs; see `mbkit._serving`.
    memory : int
        Bytes that it may take; 0 for no bound.
    folder : Path
        Of its own: it works there, and what it says is kept there.
    environment : mapping of str to str
    """

    def __init__(self, module: str, memory: int, folder: Path, environment: Mapping[str, str]) -> None:
        self._output = folder / "output"
        self._heard = 0
        ours, its = socket.socketpair()
        command = [sys.executable, "-c", _PROGRAM, module, str(its.fileno()), str(memory)]
        command += [os.path.abspath(path) for path in sys.path]
        with its, self._output.open("wb") as output:
            self._process = subprocess.Popen(
                command,
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                pass_fds=[its.fileno()],
                env=dict(environment),
                # Ctrl-C is for who started it, and what it started ends with it.
                start_new_session=True,
            )
        _interrupt.at_end(self.kill)
        self._channel: Connection[Any, Any] = Connection(ours.detach())

    @property
    def alive(self) -> bool:
        """Whether it is there."""
        return self._process.poll() is None

    def send(self, message: Any) -> None:
        """Tell it something.

        Raises
        ------
        EndedError
        """
        with contextlib.suppress(OSError):
            # What it says from now on is about this.
            self._heard = self._output.stat().st_size
        try:
            self._channel.send(message)
        except OSError:
            raise self._ended() from None

    def receive(self, seconds: float, until: float = float("inf")) -> Any:
        """Return what it says next.

        Parameters
        ----------
        seconds : float
            What it may take until then, of the processor's time.
        until : float
            Until when there is time at all, on `time.perf_counter`.

        Raises
        ------
        EndedError, OverdueError
        """
        spent, begun = _processor_seconds(self._process.pid), time.perf_counter()
        end, last = begun + seconds, min(begun + MOST * seconds, until)
        while True:
            try:
                if self._channel.poll(max(0.0, min(end, last) - time.perf_counter())):
                    return self._channel.recv()
            except (EOFError, OSError):
                raise self._ended() from None
            # On a busy machine it may not have had the time that it was given.
            missing = seconds - (_processor_seconds(self._process.pid) - spent)
            if missing <= 0 or end >= last:
                raise OverdueError(time.perf_counter() - begun)
            end = time.perf_counter() + max(missing, _LEAST)

    def kill(self) -> None:
        """End it and all that it started, from any thread; who listens to it will be told."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)

    def end(self) -> None:
        """End it, and wait until it is gone."""
        self.kill()
        _interrupt.at_end(self.kill, remove=True)
        self._process.wait()
        self._channel.close()

    def leave(self) -> None:
        """Let go of it without ending it, in a process that is a copy of the one that started it."""
        _interrupt.at_end(self.kill, remove=True)
        self._channel.close()
        self._process.returncode = 0

    def _ended(self) -> EndedError:
        """Return what became of it."""
        try:
            code: int | None = self._process.wait(timeout=5.0)
        except subprocess.TimeoutExpired:
            code = None
        return _account(code, self._said())

    def _said(self) -> str:
        try:
            return self._output.read_bytes()[self._heard :][-_TAIL:].decode("utf-8", "replace")
        except OSError:
            return ""


def _processor_seconds(pid: int) -> float:
    """Return what a process has computed so far, s; the wall's time where that is not told."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
    except OSError:
        return time.perf_counter()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _account(code: int | None, said: str) -> EndedError:
    """Return in words how a process ended."""
    if "std::bad_alloc" in said or "MemoryError" in said or "out of memory" in said.lower():
        return EndedError(MEMORY)
    if code is None:
        return EndedError("the process gave up the connection")
    if code == -signal.SIGKILL:
        return EndedError("the process was killed, as systems do that have no memory left", "SIGKILL")
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
        last = "".join(x[:200] for x in (lines[:own][-1:] if own is not None else lines[-1:]))
        return EndedError(f"the process died of {name}" + (f" ({last})" if last else ""), name, last)
    last = "".join(x[:200] for x in said.strip().splitlines()[-1:])
    return EndedError(f"the process ended with status {code}" + (f" ({last})" if last else ""), "", last)


# Named calls in worker processes, none of which can take the others down.

T = TypeVar("T")

# Engines and the threads that draw progress do not survive a fork.
_CONTEXT: Final = multiprocessing.get_context("spawn")


class WorkerDiedError(RuntimeError):
    """The process that made a call ended without an answer: a crash, or no memory left."""


def processors() -> int:
    """Return how many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run(
    calls: Mapping[str, Callable[[], T]], *, executor: Executor | None = None, jobs: int | None = None
) -> Iterator[tuple[str, T | Exception]]:
    """Yield the name and the result, or the exception, of each call as it finishes.

    Parameters
    ----------
    calls : mapping of str to callable
        What to call; picklable where processes do it.
    executor : concurrent.futures.Executor, optional
        Who does it; by default a pool of processes of our own, ended afterwards.
    jobs : int, optional
        Size of our own pool; by default as many as there are processors.

    Notes
    -----
    When a process of our own pool dies, the calls that were under way are made
    again, each in a process of its own, so that the one at fault is known by name
    and the others get their results.
    """
    left = dict(calls)
    if executor is not None:
        for name, result in _through(executor, left, len(left)):
            del left[name]
            yield name, result
        yield from _unmade(left)
        return
    width = min(jobs or processors(), len(left))
    while left:
        before = len(left)
        suspects: list[str] = []
        with Pool(width) as pool:
            for name, result in _through(pool, left, width):
                if isinstance(result, WorkerDiedError):
                    suspects.append(name)
                else:
                    del left[name]
                    yield name, result
        for name in suspects:
            with Pool(1) as pool:
                yield from _through(pool, {name: left.pop(name)}, 1)
        if len(left) == before:
            yield from _unmade(left)
            return


def _unmade(calls: Mapping[str, Callable[[], T]]) -> Iterator[tuple[str, Exception]]:
    for name in calls:
        yield name, WorkerDiedError("not computed: the executor takes no more calls")


def _through(
    executor: Executor, calls: Mapping[str, Callable[[], T]], width: int
) -> Iterator[tuple[str, T | Exception]]:
    """Keep `width` calls under way; whoever is under way when a process dies is a suspect."""
    waiting = list(calls.items())[::-1]
    running: dict[Future[T], str] = {}
    broken = False
    try:
        while running or (waiting and not broken):
            while waiting and len(running) < width and not broken:
                name, call = waiting[-1]
                try:
                    running[executor.submit(call)] = name
                    waiting.pop()
                except RuntimeError:
                    broken = True
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                name = running.pop(future)
                error = None if future.cancelled() else future.exception()
                if future.cancelled() or isinstance(error, BrokenExecutor):
                    broken = True
                    yield name, WorkerDiedError("its process ended without an answer: a crash, or no memory left")
                elif error is None:
                    yield name, future.result()
                elif isinstance(error, Exception):
                    yield name, error
                else:
                    raise error
    finally:
        # Whoever stopped listening does not want what has not begun.
        for future in running:
            future.cancel()


class Pool(ProcessPoolExecutor):
    """A pool whose processes leave Ctrl-C to the parent, work in a folder of their own, and end with it."""

    def __init__(self, width: int) -> None:
        # MuJoCo writes its log into the working folder.
        self._folder = tempfile.TemporaryDirectory(prefix="mbkit-", ignore_cleanup_errors=True)
        super().__init__(width, mp_context=_CONTEXT, initializer=_begin, initargs=(self._folder.name,))
        self._others = set(multiprocessing.active_children())

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """Make a call in one of the processes, which may start for it."""
        # A process that starts inherits this, and Ctrl-C does not disturb it while it imports.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            return super().submit(fn, *args, **kwargs)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def __exit__(self, kind: object, *rest: object) -> None:
        if kind is not None:
            for process in set(multiprocessing.active_children()) - self._others:
                process.terminate()
        self.shutdown(wait=True, cancel_futures=True)
        self._folder.cleanup()


def _begin(folder: str) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.chdir(folder)
