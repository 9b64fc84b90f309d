"""What the runs of one problem are measured by, searched for within a time.

Where there is no closed form, two runs that share as little as possible tell by their difference how
well either is known (Hairer, Nørsett, Wanner 1993, II.4, say why one run alone cannot). Three roads,
until one is good enough: explicit methods of high order on two engines; implicit methods of different
families, for what is stiff; Taylor series with 34 digits, for what loses digits in double.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.engines import dynamics
from mbkit.errors import MbkitError, NumericalError
from mbkit.simulate.methods import METHODS
from mbkit.studies.reference import reference
from mbkit.studies.reference_runs import gap
from mbkit.studies.rollouts import quiet_simulate
from mbkit.studies.stress.case import Problem, Truth
from mbkit.studies.stress.limit import limited

__all__ = ["Search"]

_EPS: Final = float(np.finfo(float).eps)
#: The errors of two runs can partly cancel in their difference.
_SAFETY: Final = 4.0
#: A search shorter than this finds nothing, s.
_LEAST: Final = 0.05
#: Deriving and compiling series takes seconds that no search counts: with less time left they are not begun, s.
_SERIES: Final = 5.0
#: A truth no better than this part of the motion cannot tell even gross errors.
_WORTHLESS: Final = 1e-3
#: Parts of the time left that the roads may take, in the order in which they are tried.
_PARTS: Final = (0.35, 0.5, 1.0)
#: Engine, method, and tolerance or number of steps: of high order, and the third where the second is not at hand.
_EXPLICIT: Final[tuple[tuple[str, str, float], ...]] = (
    ("lagrangian", "rk853", 1e-14),
    ("pinocchio", "dop853", 1e-13),
    ("mujoco", "dop853", 1e-13),
)
#: Those that can follow stiff motion.
_IMPLICIT: Final[tuple[tuple[str, str, float], ...]] = (
    ("lagrangian", "cvodes", 1e-12),
    ("lagrangian", "gauss6", 1000),
    ("pinocchio", "radau", 1e-11),
    ("lagrangian", "gauss6", 4000),
)

#: What a road finds: q at the times, how well it is known, and how it was made.
_Found = tuple[Array, float, str]
_Road = Callable[[Problem, Array, float, float], Iterator[_Found]]


class Search:
    """Searches for the truths of a case, one value after the other."""

    def __init__(self) -> None:
        #: What led to the end for a milder value is tried first.
        self._roads: list[_Road] = [partial(_double, _EXPLICIT), partial(_double, _IMPLICIT), _extended]

    def truth(self, problem: Problem, times: Array, wanted: float, seconds: float) -> tuple[Truth | None, str]:
        """Return the truth of a motion, or None, and how it is known or why it is not.

        Parameters
        ----------
        problem : Problem
        times : (K,) array
        wanted : float
            How well it should be known, rad or m.
        seconds : float
            What the search may take, of the processor's time.
        """
        if problem.exact is not None:
            return _closed(problem, times)
        end = time.thread_time() + seconds
        best: _Found | None = None
        reasons: list[str] = []
        for road, part in zip(list(self._roads), _PARTS, strict=True):
            left = end - time.thread_time()
            if left < (_SERIES if road is _extended else _LEAST):
                reasons.append("the time was up")
                break
            try:
                for found in road(problem, times, wanted, part * left):
                    best = found if best is None or found[1] < best[1] else best
            except MbkitError as error:
                reasons.append(str(error))
            if best is not None and best[1] <= wanted:
                self._roads.remove(road)
                self._roads.insert(0, road)
                break
        if best is None or best[1] > _WORTHLESS * problem.scale:
            parted = f"{best[2]}, which part by {best[1] / _SAFETY:.1e}" if best else ""
            return None, "no truth: " + "; ".join(x for x in (parted, *dict.fromkeys(reasons)) if x)
        q, floor, how = best
        return Truth(times, q, floor, how), f"{how}; known to {floor:.1e}"


def _closed(problem: Problem, times: Array) -> tuple[Truth | None, str]:
    """Return what a closed form says."""
    assert problem.exact is not None
    told: Any = problem.exact(times)
    q = np.asarray(told, dtype=np.float64)
    if q.shape != (len(times), problem.model.nq) or not np.isfinite(q).all():
        what = f"shape {q.shape}" if q.shape != (len(times), problem.model.nq) else "numbers that are not finite"
        return None, f"no truth: the closed form gave {what}, expected ({len(times)}, {problem.model.nq})"
    start = float(np.abs(problem.model.difference(np.asarray(problem.q, dtype=np.float64), q[0])).max())
    floor = max(problem.floor, _rounding(q))
    if start > max(1e-9 * problem.scale, 2 * floor):
        return None, f"no truth: the closed form starts {start:.1e} from q; it is of another motion"
    return Truth(times, q, floor, problem.source), f"{problem.source or 'closed form'}; known to {floor:.1e}"


def _rounding(q: Array) -> float:
    """Return what rounding to double takes away from a motion."""
    return 0.5 * _EPS * float(np.abs(q).max())


def _double(
    runs: Sequence[tuple[str, str, float]], problem: Problem, times: Array, wanted: float, seconds: float
) -> Iterator[_Found]:
    """Several runs in double, until two agree.

    Raises
    ------
    NumericalError
        There are no two that came to the end.
    """
    end = time.thread_time() + seconds
    done: list[tuple[Array, str]] = []
    best = np.inf
    for engine, method, setting in runs:
        left = end - time.thread_time()
        if left < _LEAST:
            break
        fixed = METHODS[method].kind == "fixed"
        # A whole number of steps to each saved time.
        each = max(1, round(setting / (len(times) - 1)))
        given: dict[str, Any] = {"dt": float(times[1]) / each} if fixed else {"rtol": setting}
        try:
            dyn = dynamics(problem.model, engine)
            with limited(left):
                run = quiet_simulate(dyn, problem.q, problem.v, float(times[-1]), method, save=times, **given)
        except MbkitError:
            # One that gives up, or is not there for this model, leaves the others.
            continue
        if not run.stats.finished or len(run.q) < len(times):
            continue
        told = f"{each * (len(times) - 1)} steps" if fixed else f"rtol {setting:.0e}"
        how = f"{method} on {engine} ({told})"
        for other_q, other in done:
            apart = _SAFETY * float(gap(problem.model, other_q, run.q).max()) + _rounding(run.q)
            if apart < best:
                best = apart
                yield run.q, apart, f"{other} and {how}"
        done.append((run.q, how))
        if best <= wanted:
            return
    if len(done) < 2:
        tried = ", ".join(dict.fromkeys(method for _, method, _ in runs))
        only = f"{done[0][1]} alone" if done else "none"
        raise NumericalError(f"of {tried}, {only} came to the end in {seconds:.2g} s")


def _extended(problem: Problem, times: Array, wanted: float, seconds: float) -> Iterator[_Found]:  # noqa: ARG001  # as the others
    """Taylor series with more digits than double has."""
    made = reference(problem.model, problem.q, problem.v, float(times[-1]), times, seconds=seconds)
    if len(made.t) < len(times):
        raise NumericalError(made.how)
    yield np.asarray(made.q), float(made.floor.max()), made.how
