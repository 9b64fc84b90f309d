"""`stress`: where each engine and method breaks, with every run in a process of its own."""

from __future__ import annotations

import math
import os
import tempfile
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal

from mbkit._check import count, real
from mbkit._child_process import (
    OUT_OF_MEMORY,
    WorkerClosedError,
    WorkerDiedError,
    WorkerStartError,
    WorkerTimeoutError,
    cores,
)
from mbkit._process import LOOK_SECONDS
from mbkit.engines.registry import DERIVED, INDEPENDENT, find_engine
from mbkit.errors import InputError
from mbkit.methods.registry import METHODS
from mbkit.studies import results
from mbkit.studies._targets import methods_by_engine, numbers_of
from mbkit.studies.measurement import BAR, End, Measurement
from mbkit.studies.stress.case import Case
from mbkit.studies.stress.measurements import TERMS, CaseResult, Limits, Prepared, Row, measure, prepare
from mbkit.studies.stress.result import StressResult
from mbkit.studies.study_runs import OUT_OF_TIME, Checkpoint, Checkpointer, Progress, TooLongError
from mbkit.studies.worker import CallError, Worker, WorkerPool, check_executor, check_sendable, describe, in_worker, run

#: Seconds of a run and of the whole study, quick and not.
_RUN_SECONDS: Final = {True: 0.5, False: 2.0}
_STUDY_SECONDS: Final = {True: 100.0, False: 1700.0}
#: A run is not begun with less time than this, s.
_MIN_RUN_SECONDS: Final = 0.1
#: A row is over after so many runs in a row that did not finish.
_MAX_FAILURES_IN_A_ROW: Final = 2
#: Stage of a call -> what to add to the note of a process that ended there.
_DURING: Final = {
    "": ", making the problem",
    "truth": ", searching for its truth",
    "engine": ", making the engine",
    "method": ", deriving and compiling",
}


@dataclass
class _Row:
    """The cells of one engine and method by the index of their value."""

    engine: str
    method: str
    setting: str
    theory: float | None
    cells: dict[int, Measurement] = field(default_factory=dict)
    #: Why no more are computed; empty while more are.
    stopped: str = ""

    @property
    def expected(self) -> float:
        """Seconds of the longest run."""
        return max((c.seconds for c in self.cells.values() if not math.isnan(c.seconds)), default=0.0)

    def add(self, index: int, cell: Measurement) -> None:
        """Keep a cell, and decide whether more are worth it."""
        self.cells[index] = cell
        last = [c.end for _, c in sorted(self.cells.items())][-_MAX_FAILURES_IN_A_ROW:]
        if cell.end in ("slow", "died"):
            # More extreme values cost as much again, and tell no more.
            self.stopped = f"not run: {cell.end} at {cell.value:g} before"
        elif len(last) == _MAX_FAILURES_IN_A_ROW and not {"finished", "not run"} & set(last):
            self.stopped = f"not run: {' and '.join(dict.fromkeys(last))} at milder values before"


@dataclass(eq=False)
class CaseSweep:
    """A case with its values from mild to extreme, truths and rows of (engine, method)."""

    case: Case
    values: tuple[float, ...]
    pairs: Sequence[tuple[str, str]]
    bar: float
    limits: Limits
    #: Gets the text of what is done; by default nobody reads it.
    report: Callable[[str], object] = str
    deadline: float = math.inf
    clock: Callable[[], float] = time.perf_counter
    #: Why there are no more cells.
    why: str = OUT_OF_TIME

    def __post_init__(self) -> None:
        theory = self.case.theory or (lambda _engine, _method: None)
        self.limits = replace(self.limits, seconds=self.limits.seconds * self.case.patience)
        #: By the index of the value.
        self._prepared: dict[int, Prepared] = {}
        self._rows = [_Row(e, m, self._setting(m), theory(e, m)) for e, m in self.pairs]

    @property
    def engines(self) -> tuple[str, ...]:
        """The engines that have a row."""
        return tuple(dict.fromkeys(row.engine for row in self._rows))

    @property
    def size(self) -> int:
        """Number of steps: one for each truth and for each cell."""
        return len(self.values) * (1 + len(self._rows))

    @property
    def done(self) -> int:
        """Number of steps that need no more work."""
        return len(self._prepared) + sum(len(self.values) if row.stopped else len(row.cells) for row in self._rows)

    def _setting(self, method: str) -> str:
        if self.case.measure == "terms":
            return ""
        kind = METHODS[method]
        if kind.kind == "adaptive":
            return f"rtol {max(self.limits.rtol, kind.least):.0e}"
        return f"dt {self.limits.dt:g} s"

    def _call(
        self, worker: Worker, value: float, function: Callable[..., Any], *arguments: object, **stage_seconds: float
    ) -> Any:
        """Return what a function answers for a value of the case, or the measurement of how the call ended."""
        limits: dict[str, Any] = {
            "cpu_seconds": _with_grace(self.limits.preparation),
            "stage_seconds": {stage: _with_grace(seconds) for stage, seconds in stage_seconds.items()},
        }
        end: End = "refused"
        note = ""
        # Calls before it may have left too little memory in a process: one of its own decides.
        for _ in range(2):
            generation = worker.generation
            try:
                return worker.call(function, self.case, value, *arguments, deadline=self.deadline, **limits)
            except (CallError, WorkerClosedError, WorkerStartError):
                # No cell can be computed: these end the study.
                raise
            except (WorkerTimeoutError, WorkerDiedError) as error:
                end = "slow" if isinstance(error, WorkerTimeoutError) else "died"
                if end == "slow" and self.clock() >= self.deadline:
                    return Measurement(value, "not run", note=OUT_OF_TIME)
                note = f"{error}{_DURING.get(worker.stage, '')}"
            except MemoryError as error:
                # Its process would keep memory that the next call needs.
                worker.end()
                end, note = "died", f"{OUT_OF_MEMORY} ({error})" if str(error) else OUT_OF_MEMORY
            except Exception as error:
                end, note = "slow" if isinstance(error, TooLongError) else "refused", describe(error)
            if end != "died" or worker.generation != generation:
                break
        return Measurement(value, end, note=note)

    def prepare(self, worker: Worker, until: float) -> bool:
        """Have the truths computed in order, begin none after `until`, and return whether all are there."""
        for i, value in enumerate(self.values):
            if i in self._prepared:
                continue
            left = until - self.clock()
            if left < _MIN_RUN_SECONDS:
                return False
            self.report(f"{self.case.name}: truth at {self.case.parameter} = {value:g}")
            share = left / (len(self.values) - i)
            # Terms with 34 digits have no substitute. A search has the most of a truth's time, and making its engines
            # some seconds besides.
            seconds = 60.0 if self.case.measure == "terms" else share + 2.0
            answer = self._call(worker, value, prepare, self.bar, 0.7 * share, truth=seconds)
            if isinstance(answer, Measurement):
                answer = Prepared(f"no truth: {answer.note}") if worker.stage else Prepared(answer.note, failure=answer)
            self._prepared[i] = answer
        return True

    def run(self, engine: str, worker: Worker, until: float) -> bool:
        """Compute this engine's cells in order, begin none after `until`, and return whether all are there."""
        rows = [row for row in self._rows if row.engine == engine]
        for i, value in enumerate(self.values):
            if i not in self._prepared:
                return False
            # The cheapest first, so that most cells are known when the time is over.
            for row in sorted(rows, key=lambda row: row.expected):
                if i in row.cells:
                    continue
                if failure := self._prepared[i].failure:
                    row.cells[i] = failure
                elif row.stopped:
                    row.cells[i] = Measurement(value, "not run", note=row.stopped)
                elif until - self.clock() < _MIN_RUN_SECONDS:
                    return False
                else:
                    self.report(f"{self.case.name}: {row.method} on {engine}, {self.case.parameter} = {value:g}")
                    self._run(row, rows, i, worker)
        return True

    def _run(self, row: _Row, rows: Sequence[_Row], i: int, worker: Worker) -> None:
        limits, truth = self.limits, self._prepared[i].truth
        arguments = (row.engine, row.method, limits, truth)
        cell = self._call(worker, self.values[i], measure, *arguments, run=limits.seconds)
        row.add(i, cell)
        if worker.stage == "engine" and cell.end in ("slow", "died"):
            # Every other method of this engine would end like this.
            for other in rows:
                if not other.stopped and i not in other.cells:
                    other.add(i, cell)

    def result(self) -> CaseResult:
        """Return the result up to now."""
        prepared = [self._prepared.get(i, Prepared(self.why)) for i in range(len(self.values))]
        return CaseResult(
            **(self.case.facts() | {"bar": self.bar}),
            values=self.values,
            truths=tuple(p.how for p in prepared),
            facts=tuple(dict(p.facts) for p in prepared),
            rows=tuple(self._result_row(row, {p.dt for p in prepared} - {None}) for row in self._rows),
        )

    def _result_row(self, row: _Row, given: set[float | None]) -> Row:
        unknown = row.stopped or self.why
        cells = (row.cells.get(i, Measurement(value, "not run", note=unknown)) for i, value in enumerate(self.values))
        setting = row.setting
        if given and setting.startswith("dt"):
            setting = f"dt {given.pop():g} s" if len(given) == 1 else "dt of the case"
        return Row(row.engine, row.method, tuple(cells), setting, row.theory)


def _with_grace(seconds: float) -> float:
    """Return the processor time after which a process is ended that should have stopped by itself."""
    # It may miss its limit by a quarter and half a second.
    return 1.25 * seconds + 0.5


# All cases side by side


@dataclass(eq=False)
class _Task:
    """The truths of a case, or one engine on it; `work` takes a worker and a time, and returns whether all is done."""

    work: Callable[[Worker, float], bool]
    #: Has to be begun before, once more than this one, unless it is done.
    after: _Task | None = None
    rounds: int = 0
    state: Literal["waiting", "running", "done"] = "waiting"

    @property
    def ready(self) -> bool:
        before = self.after
        first = before is None or before.state == "done" or (before.state == "waiting" and before.rounds > self.rounds)
        return first and self.state == "waiting"


def run_sweeps(sweeps: Sequence[CaseSweep], home: Path, memory: int, jobs: int, deadline: float) -> Generator[None]:
    """Work through the cases with so many workers side by side; yield every now and then.

    Each task gets an equal part of the time left when it begins. The time that it does not need passes on to those
    after it, and in the end to the tasks that were not done, which go on where they were.
    """
    tasks: list[_Task] = []
    for sweep in sweeps:
        first = _Task(sweep.prepare)
        tasks += [first, *(_Task(partial(sweep.run, engine), first) for engine in sweep.engines)]
    # One thread each: run times are compared. The study has a cache of its own, so that no entries of the user's are
    # removed for it.
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    caches = {"MBKIT_CACHE_DIR": str(home / "code"), "HEYOKA_CACHE_DIR": str(home / "code-heyoka")}
    running: dict[Future[bool], _Task] = {}
    with WorkerPool(jobs, home, memory, {**os.environ, **threads, **caches}) as pool:
        while True:
            while len(running) < jobs and (ready := [task for task in tasks if task.ready]):
                task = min(ready, key=lambda task: task.rounds)
                task.rounds, task.state = task.rounds + 1, "running"
                # Those of this round: the others wait for the time that it leaves.
                waiting = 1 + sum(t.state == "waiting" and t.rounds < task.rounds for t in tasks)
                begun = time.perf_counter()
                left = max(deadline - begun, 0.0)
                until = begun + min(left, left * jobs / waiting)
                running[pool.lend(task.work, until)] = task
            if not running:
                return
            for future in wait(running, LOOK_SECONDS, FIRST_COMPLETED).done:
                task = running.pop(future)
                task.state = "done" if future.result() or time.perf_counter() >= deadline else "waiting"
            yield


def _alone(
    memory: int,
    seconds: float,
    case: Case,
    values: tuple[float, ...],
    pairs: Sequence[tuple[str, str]],
    bar: float,
    limits: Limits,
) -> CaseResult:
    """Work through a case with a worker of its own, in a process of an executor."""
    deadline = time.perf_counter() + seconds
    one = CaseSweep(case, values, pairs, bar, limits, deadline=deadline)
    with tempfile.TemporaryDirectory(prefix="mbkit-stress-", ignore_cleanup_errors=True) as home:
        deque(run_sweeps([one], Path(home), memory, 1, deadline), maxlen=0)
    return one.result()


# The study


def stress(
    cases: Sequence[str | Case] | str | Case | None = None,
    engines: Sequence[str] = (DERIVED, *INDEPENDENT),
    methods: Sequence[str] | Mapping[str, Sequence[str]] | None = None,
    *,
    values: Sequence[float] | Mapping[str, Sequence[float]] | None = None,
    quick: bool = False,
    dt: float = 1e-3,
    rtol: float = 1e-8,
    bar: float = BAR,
    seconds: float | None = None,
    memory: int | None = None,
    budget: float | None = None,
    jobs: int | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
    checkpoint: Checkpoint | None = None,
) -> StressResult:
    """Sweep each case's number over decades, and return where each engine and method breaks, and how.

    Parameters
    ----------
    cases : sequence of str or Case, optional
        Names of `mbkit.studies.stress.cases`, or your own cases, whose functions are in a module, or in a script with
        its work below ``if __name__ == "__main__":``; by default all named ones.
    engines : sequence of str
    methods : sequence of str, or mapping of str to sequence of str, optional
        Names of `mbkit.simulate.METHODS`, for all engines that have them or for each; by default all, in a quick study
        one of each kind. A case may restrict them; cases about terms use none.
    values : sequence of float, or mapping of str to sequence of float, optional
        From mild to extreme, instead of the cases' own: for all cases, or by name.
    quick : bool
        Fewer values, methods and seconds.
    dt, rtol : float
        Step of fixed-step methods, s, where a case prescribes none, shortened to end on the times of measurement;
        rtol and atol of adaptive methods, raised to the least that a method allows.
    bar : float
        A value is held up to this error, relative to the size of the motion or term, unless a case has its own bar.
    seconds, budget : float, optional
        Processor time of a run, 2 s, quick 0.5 s; making the problem, deriving and compiling have fifteen times as
        long. And time of the whole study, 1700 s, quick 100 s; cells beyond it are "not run".
    memory : int, optional
        Bytes of a worker process, 2 GiB by default; enforced on Linux.
    jobs : int, optional
        Processes side by side, by default one per processor, at most 16. Run times are those of a busy machine.
    executor : concurrent.futures.Executor, optional
        Works through one case a call, with a worker process there: a pool of processes, Dask's or MPI's. Each case then
        has its part of the budget, however many run side by side. Errors do not depend on it.
    progress : callable, optional
        Called as ``progress(fraction, text)``. An exception of it ends the study, after `checkpoint` has the result.
    checkpoint : path or callable, optional
        Receives the result so far every few seconds and at the end: a JSON file, whole at any time, or a function.

    Raises
    ------
    InputError, UnknownNameError, UnsupportedError
        Unusable arguments; worker processes do not start. Failures of an engine or method are in the result.
    InterruptedSweepError
        Upon Ctrl-C: a `KeyboardInterrupt` whose `result` holds the finished cells, as `checkpoint` does.

    Notes
    -----
    Every run takes place in a worker process, which is ended when a run takes too long, and replaced when it died; so
    a crash, an endless loop and too little memory are results.

    The error of a motion is the largest difference of q to its truth over ten times, on the manifold, divided by the
    problem's scale. The truth is a closed form, or the motion on which two independent runs agree;
    `CaseResult.truths` says which, and how well it is known. Without a truth, a wrong energy speaks against a run, and
    a right one not for it. The error of a term is normwise per state, against 34 digits. Run times are processor time
    of the whole run, without compilation.

    After a value at which a row is too slow or its process died, or after two in a row that diverged, were refused or
    gave NaN, more extreme values are not run. An error above the bar ends no row.

    Examples
    --------
    >>> import mbkit as mb
    >>> result = mb.stress("joint_spring", engines=["pinocchio"], methods=["rk4"])  # doctest: +SKIP
    >>> print(result.to_markdown())  # doctest: +SKIP
    """
    if in_worker():
        raise InputError(
            "stress: called by one of its own workers, which imports the script that a case is defined in; "
            "put what the script does below: if __name__ == '__main__':"
        )
    begun = time.perf_counter()
    if not isinstance(quick, bool):
        raise InputError(f"quick: expected True or False, got {quick!r}")
    limits = Limits(
        _RUN_SECONDS[quick] if seconds is None else real("seconds", seconds, positive=True),
        real("dt", dt, positive=True),
        real("rtol", rtol, positive=True),
    )
    bar = real("bar", bar, positive=True)
    # No worker starts with less.
    memory = 2 * 2**30 if memory is None else count("memory", memory, least=2**29)
    budget = _STUDY_SECONDS[quick] if budget is None else real("budget", budget, positive=True)
    width = min(cores(), 16) if jobs is None else count("jobs", jobs, least=1)
    check_executor(executor)
    if executor is not None and jobs is not None:
        raise InputError("jobs: expected none beside an executor, which has its own; leave it out")
    checkpoints = Checkpointer(progress, checkpoint)
    swept = _swept(cases, values, quick=quick)
    methods_of = methods_by_engine(engines, methods)
    if quick and methods is None:
        methods_of = {
            e: tuple(m for m in find_engine(e).quick if m in METHODS) or all_ for e, all_ in methods_of.items()
        }
    settings: dict[str, Any] = {
        "engines": list(methods_of),
        "methods": {engine: list(names) for engine, names in methods_of.items()},
        "quick": quick,
        "dt": limits.dt,
        "rtol": limits.rtol,
        "bar": bar,
        "seconds": limits.seconds,
        "memory": memory,
        "budget": budget,
        "jobs": None if executor else width,
        "executor": type(executor).__name__ if executor else None,
    }
    doing, deadline = deque([""], maxlen=1), begun + budget
    parts = [(case, own, _rows(case, methods_of), case.bar or bar, limits) for case, own in swept]
    sweeps = [CaseSweep(*part, doing.append, deadline) for part in parts]
    #: Answers of an executor, by the case's name.
    answers: dict[str, CaseResult] = {}

    def result(*, complete: bool) -> StressResult:
        return StressResult(
            cases=tuple(answers.get(sweep.case.name) or sweep.result() for sweep in sweeps),
            complete=complete,
            **results.provenance(begun),
            settings=settings,
        )

    def elsewhere(executor: Executor) -> Iterator[tuple[float, str]]:
        by_name = {sweep.case.name: sweep for sweep in sweeps}
        calls = {part[0].name: partial(_alone, memory, budget / len(parts), *part) for part in parts}
        for k, (name, answer) in enumerate(run(calls, executor=executor)):
            if isinstance(answer, (CallError, WorkerStartError)):
                raise answer
            if isinstance(answer, Exception):
                by_name[name].why = f"not run: {describe(answer)}"
            else:
                answers[name] = answer
            yield (k + 1) / len(calls), name

    size = sum(sweep.size for sweep in sweeps)
    width = min(width, max(1, sum(1 + len(sweep.engines) for sweep in sweeps)))
    try:
        if executor is not None:
            return checkpoints.run(elsewhere(executor), result)
        with (
            tempfile.TemporaryDirectory(prefix="mbkit-stress-", ignore_cleanup_errors=True) as home,
            closing(run_sweeps(sweeps, Path(home), memory, width, deadline)) as ticks,
        ):
            steps = ((sum(sweep.done for sweep in sweeps) / size, doing[-1]) for _ in ticks)
            return checkpoints.run(steps, result)
    except CallError as error:
        raise InputError(
            f"cases: a case of your own cannot be used in other processes: {error}; define its functions in a module"
        ) from None


def _swept(cases: object, values: object, *, quick: bool) -> list[tuple[Case, tuple[float, ...]]]:
    """Return the cases, checked, each with its values."""
    # The named cases bring all their models.
    from mbkit.studies.stress.cases import get, names

    several = names() if cases is None else (cases,) if isinstance(cases, (str, Case)) else cases
    if not isinstance(several, Iterable):
        raise InputError(f"cases: expected names or Case objects, got {cases!r}")
    chosen: dict[str, Case] = {}
    for one in several:
        if not isinstance(one, (str, Case)):
            raise InputError(f"cases: expected names or Case objects, got {one!r}")
        case = get(one) if isinstance(one, str) else one
        if case.name in chosen:
            raise InputError(f"cases: {case.name!r} is there twice; a result finds a case by its name")
        chosen[case.name] = case
        check_sendable(f"cases: {case.name!r}", case)
    if not chosen:
        raise InputError("cases: expected at least one, got none; leave it out for all")
    of_cases = values if isinstance(values, Mapping) else dict.fromkeys(chosen, values)
    for name in of_cases:
        if name not in chosen:
            raise InputError(f"values: {name!r} is not among the cases: {', '.join(chosen)}")
    swept = []
    for name, case in chosen.items():
        own = of_cases.get(name)
        if own is None:
            own = case.quick if quick and case.quick else case.values
        numbers = numbers_of("values", own)
        if len(set(numbers)) < len(numbers):
            raise InputError(f"values: expected different numbers for {name}, got {list(numbers)}")
        swept.append((case, numbers))
    return swept


def _rows(case: Case, methods_of: Mapping[str, Sequence[str]]) -> list[tuple[str, str]]:
    if case.measure == "terms":
        return [(engine, term) for engine in methods_of for term in TERMS]
    return [(e, m) for e, names in methods_of.items() for m in names if not case.methods or m in case.methods]
