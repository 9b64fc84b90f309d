"""Named calls in worker processes, none of which can take the others down."""

from __future__ import annotations

import multiprocessing
import os
import signal
import tempfile
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ProcessPoolExecutor, wait
from typing import Any, Final, TypeVar

__all__ = ["Pool", "WorkerDiedError", "processors", "run"]

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
