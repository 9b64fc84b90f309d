"""What the cells of one value are measured against: a reference motion, or terms with 34 digits.

Where there is no closed form, the difference of two runs that share as little as possible bounds the error of either
(Hairer, Nørsett, Wanner 1993, II.4, on why one run alone cannot). Runs are made until two agree: explicit methods of
high order on two engines; implicit methods of different families, for stiff motion; Taylor series with 34 digits, for
motion that loses digits in double.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.codegen.extended_precision import arithmetic, solve
from mbkit.engines import dynamics
from mbkit.engines.oracle import OracleDynamics
from mbkit.engines.registry import DERIVED, INDEPENDENT, PINOCCHIO
from mbkit.errors import MbkitError, NumericalError
from mbkit.methods.registry import (
    ADAPTIVE_METHOD,
    BDF_METHOD,
    GAUSS_METHOD,
    METHODS,
    SCIPY_METHOD,
    SCIPY_STIFF_METHOD,
)
from mbkit.studies.compare.errors import Scales, acceleration_errors, force_errors, matrix_errors
from mbkit.studies.compare.terms import States
from mbkit.studies.stress.case import Problem, Truth
from mbkit.studies.study_runs import cpu_limit, quiet_simulate
from mbkit.studies.work_precision.reference import gap, reference

_EPS: Final = float(np.finfo(float).eps)
#: The errors of two runs can partly cancel in their difference.
_SAFETY: Final = 4.0
#: A search is not begun with less time than this, s.
_MIN_SEARCH: Final = 0.05
#: Taylor series need seconds to derive and compile that the search does not count, s.
_MIN_SERIES: Final = 5.0
#: A truth no better than this part of the motion cannot show even gross errors.
_WORTHLESS: Final = 1e-3
#: Engine, method, and tolerance or number of steps; the third stands in for the second where that is not installed.
_RUNS: Final[tuple[tuple[str, str, float], ...]] = (
    (DERIVED, ADAPTIVE_METHOD, 1e-14),
    *((engine, SCIPY_METHOD, 1e-13) for engine in INDEPENDENT),
    (DERIVED, BDF_METHOD, 1e-12),
    (DERIVED, GAUSS_METHOD, 1000),
    (PINOCCHIO, SCIPY_STIFF_METHOD, 1e-11),
    (DERIVED, GAUSS_METHOD, 4000),
)
#: The part of the time left that one of them may take.
_PART: Final = 0.2


def reference_motion(problem: Problem, times: Array, wanted: float, seconds: float) -> tuple[Truth | None, str]:
    """Return the truth of a motion to `wanted`, rad or m, or None, and how it is known or why it is not."""
    if problem.exact is not None:
        return _closed_form(problem, times)
    end = time.thread_time() + seconds
    runs: list[tuple[Array, str]] = []
    best: Truth | None = None
    for engine, method, setting in _RUNS:
        left = end - time.thread_time()
        if left < _MIN_SEARCH or (best is not None and best.floor <= wanted):
            break
        try:
            q, how = _run(problem, times, engine, method, setting, _PART * left)
        except MbkitError:
            # The other runs may do without it.
            continue
        for other_q, other in runs:
            floor = _SAFETY * float(gap(problem.model, other_q, q).max()) + _rounding(q)
            if best is None or floor < best.floor:
                best = Truth(times, q, floor, f"{other} and {how}")
        runs.append((q, how))
    reasons = [f"{best.how}, which part by {best.floor / _SAFETY:.1e}"] if best else []
    left = end - time.thread_time()
    if best is None or best.floor > wanted:
        try:
            if left < _MIN_SERIES:
                raise NumericalError("the time was up")
            known = reference(problem.model, problem.q, problem.v, float(times[-1]), times, seconds=left)
            if len(known.t) < len(times):
                raise NumericalError(known.how)
            series = Truth(times, np.asarray(known.q), float(known.floor.max()), known.how)
            best = series if best is None or series.floor < best.floor else best
        except MbkitError as error:
            reasons.append(str(error))
    if best is None or best.floor > _WORTHLESS * problem.scale:
        return None, "no truth: " + "; ".join(reasons)
    return best, f"{best.how}; known to {best.floor:.1e}"


def _run(problem: Problem, times: Array, engine: str, method: str, setting: float, seconds: float) -> tuple[Array, str]:
    """Return q of a run in double to the end, and how it was computed."""
    fixed = METHODS[method].kind == "fixed"
    # A whole number of steps to each saved time.
    each = max(1, round(setting / (len(times) - 1)))
    step: dict[str, Any] = {"dt": float(times[1]) / each} if fixed else {"rtol": setting}
    dyn = dynamics(problem.model, engine)
    with cpu_limit(seconds):
        run = quiet_simulate(dyn, problem.q, problem.v, float(times[-1]), method, save=times, **step)
    if not run.stats.finished or len(run.q) < len(times):
        raise NumericalError(run.stats.message)
    size = f"{each * (len(times) - 1)} steps" if fixed else f"rtol {setting:.0e}"
    return run.q, f"{method} on {engine} ({size})"


def _closed_form(problem: Problem, times: Array) -> tuple[Truth | None, str]:
    assert problem.exact is not None
    exact: Any = problem.exact(times)
    q = np.asarray(exact, dtype=np.float64)
    if q.shape != (len(times), problem.model.nq) or not np.isfinite(q).all():
        what = f"shape {q.shape}" if q.shape != (len(times), problem.model.nq) else "numbers that are not finite"
        return None, f"no truth: the closed form gave {what}, expected ({len(times)}, {problem.model.nq})"
    start = float(np.abs(problem.model.difference(np.asarray(problem.q, dtype=np.float64), q[0])).max())
    floor = max(problem.floor, _rounding(q))
    if start > max(1e-9 * problem.scale, 2 * floor):
        return None, f"no truth: the closed form starts {start:.1e} from q; it is of another motion"
    return Truth(times, q, floor, problem.source), f"{problem.source or 'closed form'}; known to {floor:.1e}"


def _rounding(q: Array) -> float:
    """Return the error of rounding a motion to double."""
    return 0.5 * _EPS * float(np.abs(q).max())


# Terms. Errors are those of `mbkit.studies.compare.errors`, but for forward dynamics: there its error is divided by
# cond(M), to judge engines; here it is not, because a user of an acceleration has its whole error, about
# eps cond(M) of what acts.

#: Method of `Dynamics` -> its arguments, fields of `States`.
TERMS: Final = {"mass_matrix": ("q",), "inverse_dynamics": ("q", "v", "a"), "forward_dynamics": ("q", "v", "tau")}
#: Beyond this condition number doubles do not know the smallest eigenvalue of a matrix.
_MAX_DOUBLE_CONDITION: Final = 1e15
#: Columns of an inverse that are computed side by side.
_BLOCK: Final = 16
#: The largest error that a result holds, for JSON has no infinity.
MAX_ERROR: Final = 1e300


@dataclass(frozen=True)
class Terms:
    """The states of a problem, and the oracle's values there."""

    at: States
    #: Term -> high and low part.
    values: dict[str, tuple[Array, Array]]
    #: Term -> why the oracle has no value.
    missing: dict[str, str]
    #: In units of 2**exponent kg, m and s, in which nothing overflows.
    scales: Scales
    exponent: int


def reference_terms(problem: Problem, oracle: OracleDynamics) -> Terms:
    """Return the oracle's values at a problem's states; accelerations are random, by a fixed seed."""
    model = problem.model
    q, v = (np.atleast_2d(x) for x in (model.check_q(problem.q), model.check_v(problem.v)))
    n = max(len(q), len(v))
    q, v = np.broadcast_to(q, (n, model.nq)), np.broadcast_to(v, (n, model.nv))
    tau = np.zeros(model.nv) if problem.tau is None else model.check_v(problem.tau, "tau")
    a = np.random.default_rng(0).standard_normal((n, model.nv))
    at = States(q, v, a, np.broadcast_to(tau, (n, model.nv)), ("given",) * n)
    values, missing = {}, {}
    for term, arguments in TERMS.items():
        try:
            values[term] = oracle.extended(term, *(getattr(at, x) for x in arguments))
        except NumericalError as error:
            missing[term] = f"no truth: {error}"
    M = oracle.mass_matrix(q)
    exponent = _exponent(M)
    acting = np.abs(at.tau) + np.abs(oracle.nle(q, v)) + np.abs(oracle.passive(q, v))
    gravity = float(np.linalg.norm(model.gravity))
    weight = gravity * float(np.sqrt(np.ldexp(model.mass, exponent))) if gravity and model.has_bodies else 0.0
    with np.errstate(all="ignore"):
        scales = Scales.of(np.ldexp(M, exponent), v, np.ldexp(acting, exponent), weight)
    return Terms(at, values, missing, replace(scales, condition=np.ones(n)), exponent)


def _exponent(M: Array) -> int:
    """Return the power of 2 that scales the largest number of a matrix to 1/2 ... 1."""
    return -int(np.frexp(np.abs(M).max())[1])


def error_of(term: str, value: Array, truth: Terms) -> float:
    """Return the worst error of a term over the states."""
    high, low = truth.values[term]
    with np.errstate(all="ignore"):
        error = (value - high) - low
        if term == "forward_dynamics":
            errors = acceleration_errors(error, high, truth.scales)
        else:
            # Forces and inertias are both proportional to kg.
            error, high = np.ldexp(error, truth.exponent), np.ldexp(high, truth.exponent)
            measured = matrix_errors if term == "mass_matrix" else partial(force_errors, heavy=True)
            errors = measured(error, high, truth.scales)
        return min(float(errors.relative.max()), MAX_ERROR)


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
    return float(np.linalg.norm(high[k], 2)) * _norm_of_inverse(high[k], low[k])


def _norm_of_inverse(high: Array, low: Array) -> float:
    """Return the 2-norm of the inverse of a matrix with 34 digits, NaN where there is none."""
    own, n = arithmetic(), len(high)
    M, pattern = own.from_pair(high, low), (high != 0) | (low != 0)
    columns = []
    for rows in np.array_split(np.eye(n), range(_BLOCK, n, _BLOCK)):
        many = np.broadcast_to(M, (len(rows), n, n))
        columns.append(own.pair(solve(many, own.array(rows), pattern, range(n), own))[0])
    inverse = np.concatenate(columns)
    return float(np.linalg.norm(inverse, 2)) if np.isfinite(inverse).all() else np.nan
