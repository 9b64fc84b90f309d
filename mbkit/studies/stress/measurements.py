"""Data of a stress study: its rows and cases, and how far each row held.

What a worker process of a stress study computes: the reference of one value, and one cell.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, Final, Literal, NamedTuple, TypeVar, cast

import mpmath as mp
import numpy as np

from mbkit._check import EPS, Array
from mbkit.engines import Dynamics, dynamics
from mbkit.engines.oracle import OracleDynamics
from mbkit.engines.registry import DERIVED, PINOCCHIO
from mbkit.errors import MbkitError, NumericalError
from mbkit.methods.registry import ADAPTIVE_METHOD, AUTOMATIC_METHOD, METHODS, STIFF_METHOD
from mbkit.model import Model
from mbkit.simulate import Trajectory, simulate
from mbkit.simulate.plotting.style import engine_index
from mbkit.studies.compare.errors import Scales, interleaved
from mbkit.studies.compare.terms import FORWARD_DYNAMICS, States
from mbkit.studies.compare.terms import TERMS as COMPARED
from mbkit.studies.measurement import MAX_ERROR, Measurement, Outcome, Problem, Truth, run_name
from mbkit.studies.reference_motions import reference
from mbkit.studies.stress.case import Case, problem_of, step_of, times_of
from mbkit.studies.study_runs import Deadline, TooLongError, heard_warnings, quiet_simulate
from mbkit.studies.worker import report_stage

#: The engines on which mbkit recommends its automatic method.
_OURS: Final = (PINOCCHIO, DERIVED)
#: Outcomes that say nothing about a row.
UNKNOWN: Final = ("not run", "unjudged")


@dataclass(frozen=True)
class Breaking:
    """Where one engine and method breaks in one case.

    `held` is the last value up to which all milder ones held, too, and None where the mildest did not. `failed`, `how`
    and `cell` are the first value that did not hold, its outcome and measurement; None and empty where all held.
    """

    case: str
    engine: str
    method: str
    setting: str
    held: float | None
    failed: float | None
    how: Outcome | Literal[""]
    cell: Measurement | None = field(compare=False, repr=False)

    @property
    def note(self) -> str:
        """Error, warnings and note of the first value that did not hold."""
        if self.cell is None:
            return ""
        error = f"error {self.cell.seen:.1e}" if math.isfinite(self.cell.seen) else ""
        return "; ".join(x for x in (error, *self.cell.warnings, self.cell.note) if x)


@dataclass(frozen=True)
class Row:
    """One engine and method over all values of a case; for terms, the method is the term.

    `cells` are in the order of the case's values, and `setting` is the step or tolerance. `theory` is where linear
    theory lets it break; infinite where it does not, ``"no limit"`` in JSON.
    """

    engine: str
    method: str
    cells: tuple[Measurement, ...]
    setting: str = ""
    theory: float | None = None

    @property
    def _name(self) -> str:
        """Engine and method; MuJoCo's own integrators have the engine in their names."""
        return run_name(self.engine, self.method)

    def breaking(self, bar: float, case: str = "") -> Breaking:
        """Return the last value that held and the first that did not."""
        at = self.reach(bar)
        held = self.cells[at - 1].value if at else None
        cell = self.cells[at] if at < len(self.cells) else None
        how = "not run" if cell is None else cell.outcome(bar)
        if cell is None or how in UNKNOWN:
            return Breaking(case, self.engine, self.method, self.setting, held, None, "", None)
        return Breaking(case, self.engine, self.method, self.setting, held, cell.value, how, cell)

    def reach(self, bar: float) -> int:
        """Return how many values held before the first that did not."""
        return _count([cell.outcome(bar) for cell in self.cells], ("held",))


def _count(outcomes: Sequence[Outcome], wanted: Sequence[Outcome]) -> int:
    """Return how many outcomes are wanted ones before the first that is not."""
    return next((k for k, how in enumerate(outcomes) if how not in wanted), len(outcomes))


class Line(NamedTuple):
    """A row read from mild to extreme: how many values held, or were only inaccurate, before the first that did not.

    `seconds` is the median run time where it held, or where it finished at all; NaN where it did not.
    """

    row: Row
    broken: Breaking
    outcomes: tuple[Outcome, ...]
    reach: int
    usable: int
    seconds: float

    @classmethod
    def of(cls, row: Row, bar: float, case: str) -> Line:
        """Return a row of a case by a bar on its errors."""
        outcomes = tuple(cell.outcome(bar) for cell in row.cells)
        reach = _count(outcomes, ("held",))
        times = [c.seconds for c in row.cells if c.end == "finished" and math.isfinite(c.seconds)]
        held = [c.seconds for c in row.cells[:reach] if math.isfinite(c.seconds)]
        seconds = statistics.median(held or times or [math.nan])
        return cls(row, row.breaking(bar, case), outcomes, reach, _count(outcomes, ("held", "inaccurate")), seconds)

    @property
    def left_out(self) -> bool:
        """Whether it never ran: refused, or not reached, at every value."""
        return all(how in ("refused", "not run") for how in self.outcomes)


@dataclass(frozen=True)
class CaseResult:
    """All engines and methods on one case.

    What a `Case` has is as there, but `bar` is the one that counts here. `truths` say how the truth of each of the
    `values` is known and to which floor, and `facts` are further numbers of each.
    """

    name: str
    about: str
    family: str
    parameter: str
    unit: str
    measure: str
    bar: float
    why: str
    values: tuple[float, ...]
    truths: tuple[str, ...]
    facts: tuple[dict[str, float], ...]
    rows: tuple[Row, ...]

    @cached_property
    def _lines(self) -> list[Line]:
        """The rows in the order of what held, then of what was usable, then of run time."""

        def rank(line: Line) -> tuple[float, ...]:
            seconds = math.inf if math.isnan(line.seconds) else line.seconds
            return -line.reach, -line.usable, line.outcomes.count("silent"), seconds

        return sorted((Line.of(row, self.bar, self.name) for row in self.rows), key=rank)

    @cached_property
    def _best(self) -> dict[str, Line]:
        """The furthest method of each engine; of terms that it has, the first to break."""
        ranked = self._lines
        if self.measure == "terms":
            ranked = sorted(ranked, key=lambda line: (line.left_out, line.reach, line.usable))
        return {line.row.engine: line for line in reversed(ranked)}

    @property
    def _leader(self) -> Line | None:
        """The furthest line; of terms, the first to break of the engine that is best in all of them."""
        return max((x for x in self._best.values() if not x.left_out), key=lambda line: line.reach, default=None)

    @property
    def _choice(self) -> Line | None:
        """mbkit's own choice of method, on the engine where it held furthest, if it was run."""
        ours = (x for x in self._lines if x.row.method == AUTOMATIC_METHOD and x.row.engine in _OURS)
        return next((x for x in ours if not x.left_out), None)

    @property
    def _unbeaten(self) -> list[str]:
        """Engine and method of all that held furthest, or of terms the engines in all of them."""
        most = max((line.reach for line in self._best.values()), default=0)
        if self.measure == "terms":
            return [engine for engine, line in self._best.items() if line.reach == most > 0]
        return [line.row._name for line in self._lines if line.reach == most > 0]


def engines_of(cases: Iterable[CaseResult]) -> list[str]:
    """Return the engines that are in any row, in the order of every figure."""
    return sorted(dict.fromkeys(row.engine for case in cases for row in case.rows), key=engine_index)


#: The largest floor of a truth over the size of the motion: a worse one cannot show even gross errors.
_MAX_RELATIVE_FLOOR: Final = 1e-3

# Reference motions


def reference_motion(problem: Problem, times: Array, wanted: float, seconds: float) -> tuple[Truth | None, str]:
    """Return the truth of a motion to `wanted` of it, or None, and how it is known or why it is not."""
    try:
        truth = _closed_form(problem, times) if problem.exact else _searched(problem, times, wanted, seconds)
    except MbkitError as error:
        return None, f"no truth: {error}"
    return truth, f"{truth.how}; known to {truth.floor:.1e}"


def _searched(problem: Problem, times: Array, wanted: float, seconds: float) -> Truth:
    motion = problem.model, problem.q, problem.v, float(times[-1]), times, problem.tau
    known = reference(*motion, seconds=seconds, wanted=wanted, agree=_MAX_RELATIVE_FLOOR)
    if len(known.t) < len(times):
        raise NumericalError(known.how)
    return Truth(times, known.q, float(known.floor.max()), known.how)


def _closed_form(problem: Problem, times: Array) -> Truth:
    assert problem.exact is not None
    model, q = problem.model, np.asarray(problem.exact(times), dtype=np.float64)
    if q.shape != (len(times), model.nq) or not np.isfinite(q).all():
        what = f"shape {q.shape}" if q.shape != (len(times), model.nq) else "numbers that are not finite"
        raise NumericalError(f"the closed form gave {what}, expected ({len(times)}, {model.nq})")
    start = float(np.abs(model.difference(np.asarray(problem.q, dtype=np.float64), q[0])).max())
    # A motion is rounded to double.
    floor = max(problem.floor, 0.5 * EPS * float(np.abs(q).max()))
    if start > max(1e-9 * problem.scale, 2 * floor):
        raise NumericalError(f"the closed form starts {start:.1e} from q; it is of another motion")
    return Truth(times, q, floor, problem.source or "closed form")


# Reference terms. Errors are those of `mbkit.studies.compare.errors`, but for forward dynamics: there its error is
# divided by cond(M), to judge engines; here it is not, because a user of an acceleration has its whole error, about
# eps cond(M) of what acts.

#: By the method of `Dynamics`.
TERMS: Final = {x.quantity: x for x in COMPARED if x.name in ("M", "inverse dynamics", "forward dynamics")}
#: Beyond this condition number doubles do not know the smallest eigenvalue of a matrix.
_MAX_DOUBLE_CONDITION: Final = 1e15
#: Digits of their singular values.
_SINGULAR_VALUE_DIGITS: Final = 40


@dataclass(frozen=True)
class Terms:
    """The states of a problem, and the oracle's values there."""

    at: States
    #: Term -> high and low part, or why the oracle has no value.
    values: dict[str, tuple[Array, Array] | str]
    #: Scales in units of 2**exponent kg, m and s, in which nothing overflows.
    scales: Scales
    exponent: int


def reference_terms(problem: Problem, oracle: OracleDynamics) -> Terms:
    """Return the oracle's values at a problem's states; accelerations are random, by a fixed seed."""
    model = problem.model
    q, v = (np.atleast_2d(x) for x in (model.check_q(problem.q), model.check_v(problem.v)))
    n = max(len(q), len(v))
    tau = np.zeros(model.nv) if problem.tau is None else model.check_v(problem.tau, "tau")
    a = np.random.default_rng(0).standard_normal((n, model.nv))
    # Writeable arrays, as users have them: engines have a fast path for those.
    q, v, tau = (np.array(np.broadcast_to(x, (n, x.shape[-1]))) for x in (q, v, tau))
    at = States(q, v, a, tau, ("given",) * n)
    values: dict[str, tuple[Array, Array] | str] = {}
    for name, term in TERMS.items():
        try:
            values[name] = term.reference(oracle, at)
        except NumericalError as error:
            values[name] = f"no truth: {error}"
    M = oracle.mass_matrix(q)
    exponent = _exponent(M)
    acting = np.abs(at.tau) + np.abs(oracle.nle(q, v)) + np.abs(oracle.passive(q, v))
    gravity = float(np.linalg.norm(model.gravity))
    weight = gravity * float(np.sqrt(np.ldexp(model.mass, exponent))) if gravity and model.has_bodies else 0.0
    with np.errstate(all="ignore"):
        scales = Scales.of(np.ldexp(M, exponent), v, np.ldexp(acting, exponent), weight)
    return Terms(at, values, replace(scales, condition=np.ones(n)), exponent)


def _exponent(M: Array) -> int:
    """Return the power of 2 that scales the largest number of a matrix to 1/2 ... 1."""
    return -int(np.frexp(np.abs(M).max())[1])


def condition(oracle: OracleDynamics, q: Array) -> float:
    """Return the largest condition number of M (2-norm, SI) of the states; NaN if singular, 34 digits beyond 1e15."""
    high, low = oracle.extended("mass_matrix", np.atleast_2d(q))
    exponent = _exponent(high)
    high, low = np.ldexp(high, exponent), np.ldexp(low, exponent)
    with np.errstate(all="ignore"):
        numbers = np.linalg.cond(high)
    if not (numbers >= _MAX_DOUBLE_CONDITION).any():
        return float(numbers.max())
    k = int(np.argmax(numbers))
    with mp.workdps(_SINGULAR_VALUE_DIGITS):
        values = mp.svd_r(mp.matrix(high[k].tolist()) + mp.matrix(low[k].tolist()), compute_uv=False)
        least, largest = min(values), max(values)
        return float(largest / least) if least > largest * 10.0**-_SINGULAR_VALUE_DIGITS else np.nan


# Cells

#: Processor time: the wall's is also other processes'. A run has one thread, and Linux gives the time of the whole
#: process to some milliseconds only, unless there is a timer on it.
_clock = time.thread_time

#: The time limit of making the problem and the engine and of compiling, over a run's; and its least.
_PREPARATION_PER_RUN_TIME: Final = 15.0
_MIN_PREPARATION_SECONDS: Final = 6.0
#: A run shorter than this is timed three times in all.
_SHORT_RUN_SECONDS: Final = 5e-3
#: Methods that another may switch to, which are compiled before it is timed.
_SWITCHES_TO: Final = {AUTOMATIC_METHOD: (ADAPTIVE_METHOD, STIFF_METHOD)}
#: Steps of an engine's own integrator from which the time of all steps is estimated.
_TRIAL_STEPS: Final = 2000


@dataclass(frozen=True)
class Prepared:
    """The reference of one value; `how` says how it is known, or why it is not."""

    how: str
    truth: Truth | Terms | None = None
    facts: Mapping[str, float] = field(default_factory=dict)
    #: Step that the problem prescribes, s.
    dt: float | None = None
    #: The cell of every method, where there is no problem.
    failure: Measurement | None = None


@dataclass(frozen=True)
class Limits:
    """Processor time of a run, its step and tolerance."""

    seconds: float
    dt: float
    rtol: float

    @property
    def preparation(self) -> float:
        """Processor time of making the problem and the engine, and compiling, s."""
        return max(_MIN_PREPARATION_SECONDS, _PREPARATION_PER_RUN_TIME * self.seconds)


T = TypeVar("T")
#: Problem, oracle and engines of one value of a case, for all calls about it.
_cache: Final[dict[Any, Any]] = {}


def _cached(case: Case, value: float, name: str, make: Callable[[], T]) -> T:
    """Return what was made before for this value, or make it; that of the value before is freed."""
    if _cache.get(None) != (case.name, value):
        _cache.clear()
        _cache[None] = case.name, value
    if name not in _cache:
        _cache[name] = make()
    made: T = _cache[name]
    return made


def _problem(case: Case, value: float) -> Problem:
    return _cached(case, value, "problem", partial(problem_of, case, value))


def _oracle(case: Case, value: float) -> OracleDynamics:
    return _cached(case, value, "34 digits", partial(OracleDynamics, _problem(case, value).model))


def _engine(model: Model, engine: str) -> tuple[Dynamics, list[str]]:
    """Return an engine, and the warnings of its construction."""
    with heard_warnings() as heard:
        dyn = dynamics(model, engine)
    return dyn, heard


def prepare(case: Case, value: float, bar: float, seconds: float) -> Prepared:
    """Return the reference of a value, searched for within so many seconds of processor time."""
    problem = _problem(case, value)
    truth: Truth | Terms | None = None
    report_stage("truth")
    if case.measure == "terms":
        how, truth = "the own derivation with 34 digits", reference_terms(problem, _oracle(case, value))
    elif case.measure == "energy":
        how = "the energy at the start, with 34 digits"
    else:
        truth, how = reference_motion(problem, times_of(problem, case.measure), 0.1 * bar, seconds)
    facts = {name: float(x) for name, x in problem.facts.items()}
    with suppress(MbkitError):
        number = condition(_oracle(case, value), problem.q)
        facts |= {} if "cond(M)" in facts or math.isnan(number) else {"cond(M)": number}
    return Prepared(how, truth, facts, problem.dt)


def measure(
    case: Case, value: float, engine: str, method: str, limits: Limits, truth: Truth | Terms | None
) -> Measurement:
    """Return one cell: a run by a method, or the evaluation of the term of this name, timed, and its error."""
    problem = _problem(case, value)
    report_stage("engine")
    dyn, heard = _cached(case, value, f"engine {engine}", partial(_engine, problem.model, engine))
    if isinstance(truth, Terms):
        cell = _evaluate(problem, method, dyn, truth)
    elif case.measure == "terms":
        return Measurement(value, "not run", note="not run: no truth")
    else:
        judge = dyn if truth is not None else _oracle(case, value)
        cell = _integrate(problem, times_of(problem, case.measure), method, limits, dyn, truth, judge)
        if case.measure == "energy" and cell.end == "finished":
            cell = replace(cell, error=cell.energy)
    # A warning of the engine's construction holds for all that it does.
    warned = (*heard, *cell.warnings) if cell.end == "finished" else cell.warnings
    return replace(cell, value=value, warnings=warned)


def _integrate(
    problem: Problem, times: Array, method: str, limits: Limits, dyn: Dynamics, truth: Truth | None, judge: Dynamics
) -> Measurement:
    """Return the measurement of a run; `judge` has more digits of the energy than a run that it alone judges."""
    kind, duration = METHODS[method], float(times[-1])
    adaptive = kind.kind == "adaptive"
    dt = 0.0 if adaptive else step_of(problem, times, limits.dt)
    setting: dict[str, Any] = {"rtol": max(limits.rtol, kind.least)} if adaptive else {"dt": dt}

    def run(end: float, name: str, call: Any = quiet_simulate, seconds: float = math.inf, **more: Any) -> Trajectory:
        look = None if math.isinf(seconds) else Deadline(seconds, clock=_clock).look
        more = {"save": [end], "torque": problem.tau, "progress": look, **setting, **more}
        return cast("Trajectory", call(dyn, problem.q, problem.v, end, name, **more))

    report_stage("method")
    try:
        # Steps are few in so short an interval, however stiff the system.
        short = 1e-15 * float(times[1]) if adaptive else dt
        for name in (*_SWITCHES_TO.get(method, ()), method):
            run(short, name)
        if method in _SWITCHES_TO:
            # The controller's own functions are compiled when it first uses them.
            run(duration, method, save=times, seconds=2.0 * limits.seconds)
        report_stage("run")
        steps = round(duration / dt) if kind.kind == "native" else 0
        if steps >= 2 * _TRIAL_STEPS:
            # An engine's own integrator does not stop when it is asked to.
            begun = _clock()
            run(_TRIAL_STEPS * dt, method)
            expected = (_clock() - begun) * steps / _TRIAL_STEPS
            if expected > limits.seconds:
                return Measurement(0.0, "slow", note=f"not run: {steps} steps would take {expected:.2g} s")
        with heard_warnings() as heard:
            begun = _clock()
            found = run(duration, method, simulate, limits.seconds, save=times, doubt=False)
            spent = [_clock() - begun]
    except TooLongError as error:
        return Measurement(0.0, "slow", note=str(error))
    while spent[0] < _SHORT_RUN_SECONDS and len(spent) < 3:
        begun = _clock()
        run(duration, method, save=times, doubt=False)
        spent.append(_clock() - begun)
    # Its checks integrate again: their time is not the run's.
    report_stage("check")
    cell = problem.measured(0.0, truth, times, judge, found)
    cell = replace(cell, seconds=float(np.median(spent)))
    if cell.end == "diverged":
        return cell
    doubts = (f"{dyn.model.name}: {method}: {one}" for one in found.check().doubts)
    return replace(cell, warnings=tuple(dict.fromkeys([*heard, *doubts])))


def _evaluate(problem: Problem, term: str, dyn: Dynamics, truth: Terms) -> Measurement:
    """Return the error of a term over all states, and the time of one evaluation."""
    report_stage("method")
    quantity, known = TERMS[term], truth.values[term]
    with heard_warnings() as heard:
        computed = quantity.call(dyn, truth.at)
    report_stage("run")
    ns, _ = interleaved({"": quantity.single(dyn, truth.at)}, rounds=3)[""]
    cell = Measurement(0.0, "finished", seconds=1e-9 * ns, warnings=tuple(heard))
    if not np.isfinite(computed).all():
        return replace(cell, end="nan", note="numbers that are not finite, and nothing was said")
    if isinstance(known, str):
        return replace(cell, note=known)
    # Forces and inertias are both proportional to kg, accelerations are not.
    accelerations = term == FORWARD_DYNAMICS
    exponent = 0 if accelerations else truth.exponent
    with np.errstate(all="ignore"):
        error, high = (np.ldexp(x, exponent) for x in ((computed - known[0]) - known[1], known[0]))
        worst = min(float(quantity.errors(error, high, truth.scales).relative.max()), MAX_ERROR)
    return replace(cell, error=worst / problem.scale if accelerations else worst)
