"""`stress`: where each engine and method breaks, with every run in a process of its own."""

from __future__ import annotations

import pickle
import tempfile
import time
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, Final

from mbkit._check import count, real
from mbkit.engines.registry import DERIVED, ENGINES, INDEPENDENT, compared
from mbkit.errors import InputError
from mbkit.methods.registry import METHODS
from mbkit.studies import results
from mbkit.studies._checkpoint import Checkpoint, Checkpointer, Progress
from mbkit.studies._targets import methods_by_engine, numbers_of
from mbkit.studies.stress.case import Case
from mbkit.studies.stress.measure import Limits
from mbkit.studies.stress.measurements import BAR
from mbkit.studies.stress.reference import TERMS
from mbkit.studies.stress.result import StressResult
from mbkit.studies.stress.sweep import CaseSweep, run_sweeps
from mbkit.studies.worker import CallError, in_worker, processors

#: Seconds that a run may take, and the whole study, quick and not.
_SECONDS: Final = {True: 0.5, False: 2.0}
_BUDGET: Final = {True: 100.0, False: 1700.0}
_MEMORY: Final = 2 * 2**30
#: Below it no worker starts, bytes.
_MIN_MEMORY: Final = 2**29
_MAX_JOBS: Final = 16
#: Seconds between two looks at how far it is.
_TICK: Final = 0.2


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
        Bytes of a worker process, 2 GiB when not given; enforced on Linux.
    jobs : int, optional
        Processes side by side, by default one per processor, at most 16. Run times are those of a busy machine.
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
        _SECONDS[quick] if seconds is None else real("seconds", seconds, positive=True),
        real("dt", dt, positive=True),
        real("rtol", rtol, positive=True),
    )
    bar = real("bar", bar, positive=True)
    memory = _MEMORY if memory is None else count("memory", memory, least=_MIN_MEMORY)
    budget = _BUDGET[quick] if budget is None else real("budget", budget, positive=True)
    jobs = min(processors(), _MAX_JOBS) if jobs is None else count("jobs", jobs, least=1)
    checkpoints = Checkpointer(progress, checkpoint)
    swept = _swept(cases, values, quick=quick)
    methods_of = methods_by_engine(engines, _quick_methods(engines) if quick and methods is None else methods)
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
        "jobs": jobs,
    }
    doing, deadline = deque([""], maxlen=1), begun + budget
    sweeps = [
        CaseSweep(case, own, _rows(case, methods_of), case.bar or bar, limits, doing.append, deadline)
        for case, own in swept
    ]

    def result(*, complete: bool) -> StressResult:
        return StressResult(
            cases=tuple(sweep.result() for sweep in sweeps),
            complete=complete,
            versions=results.versions(),
            processor=results.processor(),
            seconds=time.perf_counter() - begun,
            settings=settings,
        )

    size = sum(sweep.size for sweep in sweeps)
    width = min(jobs, max(1, sum(1 + len(sweep.engines) for sweep in sweeps)))
    try:
        with (
            tempfile.TemporaryDirectory(prefix="mbkit-stress-", ignore_cleanup_errors=True) as home,
            closing(run_sweeps(sweeps, Path(home), memory, width, deadline, _TICK)) as ticks,
        ):
            steps = ((sum(sweep.done for sweep in sweeps) / size, doing[-1]) for _ in ticks)
            return checkpoints.run(steps, result)
    except CallError as error:
        raise InputError(
            f"cases: a case of your own cannot be used in other processes: {error}; define its functions in a module"
        ) from None


def _quick_methods(engines: object) -> dict[str, tuple[str, ...]] | None:
    """Return the quick methods of these engines; None for other engines, which are then refused by name."""
    known = {name for name in compared() if ENGINES[name].quick}
    if isinstance(engines, str) or not isinstance(engines, Iterable) or not {*engines} <= known:
        return None
    return {engine: tuple(m for m in ENGINES[engine].quick if m in METHODS) for engine in engines}


def _swept(cases: object, values: object, *, quick: bool) -> list[tuple[Case, tuple[float, ...]]]:
    """Return the cases, checked, each with its values."""
    # With the named cases come all the models that they are made of.
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
        try:
            pickle.dumps(case)
        except Exception as error:  # pickle raises errors of several kinds
            raise InputError(
                f"cases: {case.name!r} cannot be sent to other processes ({error}); define its functions in a module"
            ) from None
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
