"""Who does what when: slots that work side by side, and the time of the study shared out among them."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from mbkit.studies.stress.messages import Answer, Failed, Introduce, Request
from mbkit.studies.stress.process import USED_UP, LostError, Patience, Worker
from mbkit.studies.stress.sweep import Asks, CaseSweep

__all__ = ["MisuseError", "Slots"]


class MisuseError(Exception):
    """A worker cannot even be told what to do; never leaves `mbkit.studies`."""


class _StoppedError(Exception):
    """The study is over before its end."""


@dataclass(eq=False)
class _Task:
    """What one slot does in one go.

    Attributes
    ----------
    work : callable
        Takes who is asked, and until when; returns whether all is done.
    after : _Task or None
        What has to be begun before, as many times and once more, unless it is done.
    rounds : int
        How many times it was begun.
    """

    work: Callable[[Asks, float], bool]
    after: _Task | None = None
    rounds: int = 0
    busy: bool = False
    done: bool = False


class Slots:
    """Works through cases with so many processes side by side.

    Parameters
    ----------
    sweeps : sequence of CaseSweep
    introductions : mapping of str to Introduce
    home : Path
        Folder of the study.
    jobs : int
    memory : int
        Bytes of each process; 0 for no bound.
    until : float
        When all is over, on `time.perf_counter`.

    Notes
    -----
    Each task, the truths of a case or one engine on it, gets an equal part of the time left when it
    begins; what it does not need passes on to those after it, and in the end to those that were
    not done, which go on where they were.
    """

    def __init__(
        self,
        sweeps: Sequence[CaseSweep],
        introductions: Mapping[str, Introduce],
        home: Path,
        jobs: int,
        memory: int,
        until: float,
    ) -> None:
        self._tasks: list[_Task] = []
        for sweep in sweeps:
            first = _Task(sweep.prepare)
            self._tasks.append(first)
            self._tasks += [_Task(partial(sweep.run, engine), first) for engine in sweep.engines]
        self._until, self._jobs = until, jobs
        self._stopping = threading.Event()
        self._changed = threading.Condition()
        self._faults: queue.Queue[BaseException | None] = queue.Queue()
        self._workers = [Worker(home, memory, introductions) for _ in range(jobs)]
        self._threads = [threading.Thread(target=self._slot, args=(w,), daemon=True) for w in self._workers]

    def __enter__(self) -> Slots:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        with self._changed:
            self._changed.notify_all()
        for worker in self._workers:
            worker.close()
        for thread in self._threads:
            thread.join()

    def ticks(self, seconds: float) -> Iterator[None]:
        """Yield every so many seconds until all is done; raise what went wrong in a slot."""
        left = len(self._threads)
        while left:
            try:
                fault = self._faults.get(timeout=seconds)
            except queue.Empty:
                yield
                continue
            if fault is not None:
                raise fault
            left -= 1

    def _slot(self, worker: Worker) -> None:
        try:
            while (task := self._next()) is not None:
                begun = time.perf_counter()
                left = max(self._until - begun, 0.0)
                with self._changed:
                    # Those of this round: the others wait for what is left of it.
                    waiting = 1 + sum(not t.done and not t.busy and t.rounds < task.rounds for t in self._tasks)
                done = task.work(partial(self._ask, worker), begun + min(left, left * self._jobs / waiting))
                with self._changed:
                    task.busy, task.done = False, done or time.perf_counter() >= self._until
                    self._changed.notify_all()
        except BaseException as fault:  # whatever it is, the study must hear of it
            if not self._stopping.is_set():
                self._faults.put(fault)
        else:
            self._faults.put(None)
        finally:
            worker.end()

    def _next(self) -> _Task | None:
        """Return the first task that can be begun, waiting for one if need be; None when there is none left."""
        with self._changed:
            while not self._stopping.is_set():
                open_tasks = [t for t in self._tasks if not t.done]
                if not open_tasks:
                    return None
                ready = [t for t in open_tasks if not t.busy and _follows(t)]
                if ready:
                    task = min(ready, key=lambda t: t.rounds)
                    task.rounds, task.busy = task.rounds + 1, True
                    return task
                self._changed.wait()
        return None

    def _ask(self, worker: Worker, request: Request, patience: Patience) -> Answer:
        if time.perf_counter() >= self._until:
            raise LostError("not run", USED_UP, "case")
        try:
            answer = worker.ask(request, patience, self._until)
        except LostError:
            if self._stopping.is_set():
                # Ended by us: that is nobody's failure.
                raise _StoppedError from None
            raise
        if isinstance(answer, Failed) and answer.misuse:
            raise MisuseError(answer.note)
        return answer


def _follows(task: _Task) -> bool:
    """Return whether what has to come before a task has come."""
    before = task.after
    return before is None or before.done or (not before.busy and before.rounds > task.rounds)
