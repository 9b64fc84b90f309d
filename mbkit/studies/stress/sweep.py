"""One case under way: what is known of each engine and method at each value, and what is worth asking next."""

from __future__ import annotations

import math
import queue
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Final

from mbkit.methods.registry import METHODS
from mbkit.studies.stress.case import Case
from mbkit.studies.stress.messages import Answer, Condition, Doing, Failed, Introduce, Prepare, Prepared, Request, Run
from mbkit.studies.stress.result import CaseResult, Cell, Row
from mbkit.studies.stress.worker import USED_UP, LostError, Patience, Worker

__all__ = ["Asks", "Bounds", "CaseSweep", "MisuseError", "Slots"]


#: How much longer than a run the making of a problem and an engine, and deriving and compiling, may take, and at
#: the least, s.
_MAKING: Final = 15.0
_MAKING_LEAST: Final = 6.0
#: A run is not begun with less time than this, s.
_LEAST: Final = 0.1
#: Runs in a row that did not finish, after which a row is over.
_IN_VAIN: Final = 2
#: The part of a truth's time that its search gets, and what making engines for it may take besides, s.
_SEARCH: Final = 0.7
_TRUTH_LEAST: Final = 2.0
#: What terms with 34 digits may take at one value, for which there is no substitute, s.
_TERMS: Final = 60.0

#: Asks a worker, which may be lost.
Asks = Callable[[Request, Patience], Answer]


@dataclass(frozen=True)
class Bounds:
    """What a run may take, and how it is set.

    Attributes
    ----------
    seconds : float
    dt, rtol : float
    """

    seconds: float
    dt: float
    rtol: float


@dataclass
class _Row:
    """One engine and method.

    Attributes
    ----------
    cells : dict
        Index of a value -> what was found.
    over : str
        Why no more is asked of it; empty while more is.
    """

    engine: str
    method: str
    setting: str
    theory: float | None
    cells: dict[int, Cell] = field(default_factory=dict)
    over: str = ""

    @property
    def expected(self) -> float:
        """Seconds of the last run."""
        return max((c.seconds for c in self.cells.values() if not math.isnan(c.seconds)), default=0.0)

    def take(self, index: int, cell: Cell) -> None:
        """Keep what was found, and decide whether more is worth it."""
        self.cells[index] = cell
        last = [c.end for _, c in sorted(self.cells.items())][-_IN_VAIN:]
        if cell.end in ("slow", "died"):
            # What is more extreme costs as much again, and tells no more.
            self.over = f"not run: {cell.end} at {cell.value:g} before"
        elif len(last) == _IN_VAIN and not {"finished", "not run"} & set(last):
            self.over = f"not run: {' and '.join(dict.fromkeys(last))} at milder values before"


class CaseSweep:
    """A case with its values, truths and rows.

    Parameters
    ----------
    key : str
        What workers call it.
    case : Case
    values : sequence of float
        From mild to extreme.
    rows : sequence of (engine, method)
    bar : float
    bounds : Bounds
    told : callable
        Is told of each little step, in words.
    """

    def __init__(
        self,
        key: str,
        case: Case,
        values: Sequence[float],
        rows: Sequence[tuple[str, str]],
        bar: float,
        bounds: Bounds,
        told: Callable[[str], None],
    ) -> None:
        self.key, self.case, self.values, self.bar = key, case, tuple(values), bar
        self._bounds = replace(bounds, seconds=bounds.seconds * case.patience)
        self._told = told
        self._prepared: dict[int, Prepared] = {}
        self._facts: dict[int, dict[str, float]] = {}
        #: Values at which the problem itself could not be made.
        self._unmade: dict[int, Cell] = {}
        self._rows = [_Row(e, m, self._setting(m), case.theory(e, m) if case.theory else None) for e, m in rows]

    @property
    def engines(self) -> tuple[str, ...]:
        """Those that have a row."""
        return tuple(dict.fromkeys(row.engine for row in self._rows))

    @property
    def size(self) -> int:
        """How many little steps there are: one for each truth and for each cell."""
        return len(self.values) * (1 + len(self._rows))

    @property
    def done(self) -> int:
        """How many of them need no more work."""
        rest = sum(len(self.values) if row.over else len(row.cells) for row in self._rows)
        return len(self._facts) + rest

    def _setting(self, method: str) -> str:
        if self.case.measure == "terms":
            return ""
        kind = METHODS[method]
        if kind.kind == "adaptive":
            return f"rtol {max(self._bounds.rtol, kind.least):.0e}"
        return f"dt {self._bounds.dt:g} s"

    # Truths

    def prepare(self, ask: Asks, until: float) -> bool:
        """Have the problems made and their truths found; nothing is begun after some time on `time.perf_counter`.

        Returns
        -------
        bool
            Whether all is done.
        """
        for i, value in enumerate(self.values):
            if i in self._facts:
                continue
            left = until - time.perf_counter()
            if left < _LEAST:
                return False
            self._told(f"{self.case.name}: truth at {self.case.parameter} = {value:g}")
            self._prepare(i, value, ask, left / (len(self.values) - i))
        return True

    def _prepare(self, i: int, value: float, ask: Asks, share: float) -> None:
        def patience(doing: Doing) -> float:
            if doing == "case":
                return self._making
            return _TERMS if self.case.measure == "terms" else share + _TRUTH_LEAST

        self._facts[i] = {}
        try:
            answer = ask(Prepare(self.key, i, value, self.bar, _SEARCH * share), patience)
        except LostError as lost:
            answer = Failed(lost.end, lost.note, lost.doing)
        if isinstance(answer, Failed):
            if answer.doing == "case":
                self._unmade[i] = Cell(value, answer.end, note=answer.note)
            else:
                self._prepared[i] = Prepared(f"no truth: {answer.note}")
            return
        assert isinstance(answer, Prepared)
        self._prepared[i], self._facts[i] = answer, dict(answer.facts)
        try:
            condition = ask(Condition(self.key, i, value), patience)
        except LostError:
            return
        if isinstance(condition, float) and math.isfinite(condition):
            self._facts[i].setdefault("cond(M)", condition)

    @property
    def _making(self) -> float:
        return max(_MAKING_LEAST, _MAKING * self._bounds.seconds)

    # Runs

    def run(self, engine: str, ask: Asks, until: float) -> bool:
        """Fill the rows of an engine, value by value; nothing is begun after some time on `time.perf_counter`.

        Returns
        -------
        bool
            Whether all is done.
        """
        mine = [row for row in self._rows if row.engine == engine]
        for i, value in enumerate(self.values):
            if i not in self._facts:
                # Its truth is not searched for yet.
                return False
            # What was cheap before comes first, so that most of it is known when the time is over.
            for row in sorted(mine, key=lambda row: row.expected):
                if i in row.cells:
                    continue
                if i in self._unmade:
                    row.cells[i] = self._unmade[i]
                elif row.over:
                    row.cells[i] = Cell(value, "not run", note=row.over)
                elif until - time.perf_counter() < _LEAST:
                    return False
                else:
                    self._told(f"{self.case.name}: {row.method} on {engine}, {self.case.parameter} = {value:g}")
                    self._cell(row, mine, i, ask)
        return True

    def _cell(self, row: _Row, mine: Sequence[_Row], i: int, ask: Asks) -> None:
        value, bounds = self.values[i], self._bounds

        def patience(doing: Doing) -> float:
            return bounds.seconds if doing == "run" else self._making

        asked = Run(self.key, i, value, row.engine, row.method, bounds.dt, bounds.rtol, bounds.seconds, self._making)
        try:
            answer = ask(asked, patience)
        except LostError as lost:
            answer = Failed(lost.end, lost.note, lost.doing)
        if isinstance(answer, Failed):
            cell, doing = Cell(value, answer.end, note=answer.note), answer.doing
        else:
            assert isinstance(answer, Cell)
            cell, doing = answer, "run"
        row.take(i, cell)
        if doing == "engine" and cell.end in ("slow", "died"):
            # So it would go with every other method of this engine.
            for other in mine:
                if not other.over and i not in other.cells:
                    other.take(i, cell)

    # What is known

    def result(self) -> CaseResult:
        """Return what is known by now."""
        case, count = self.case, len(self.values)
        prepared = [self._prepared.get(i, Prepared(USED_UP)) for i in range(count)]
        truths = tuple(self._unmade[i].note if i in self._unmade else prepared[i].told for i in range(count))
        return CaseResult(
            **{k: x for k, x in case.facts().items() if k != "bar"},
            bar=self.bar,
            values=self.values,
            truths=truths,
            facts=tuple(dict(self._facts.get(i, {})) for i in range(count)),
            rows=tuple(self._row(row) for row in self._rows),
        )

    def _row(self, row: _Row) -> Row:
        unknown = [Cell(value, "not run", note=row.over or USED_UP) for value in self.values]
        cells = tuple(row.cells.get(i, unknown[i]) for i in range(len(self.values)))
        setting = row.setting
        prescribed = {p.dt for p in tuple(self._prepared.values())} - {None}
        if prescribed and setting.startswith("dt"):
            setting = f"dt {prescribed.pop():g} s" if len(prescribed) == 1 else "dt of the case"
        return Row(row.engine, row.method, cells, setting, row.theory)


# Who does what when: slots that work side by side, and the time of the study shared out among them.


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
