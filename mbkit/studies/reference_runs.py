"""Pairs of runs of one motion: by their difference it is told how well either is known."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.derivation.equations import Equations, equations_of
from mbkit.derivation.taylor import PRECISIONS, order_of, precision, taylor_system
from mbkit.engines import dynamics
from mbkit.errors import MbkitWarning, UnsupportedError
from mbkit.model import Model
from mbkit.simulate.applied import TorqueFunction
from mbkit.simulate.methods import METHODS
from mbkit.simulate.run import simulate
from mbkit.simulate.taylor import StoppedError, TaylorSteps
from mbkit.simulate.torque import Torque

__all__ = ["Deadline", "Known", "LateError", "Motion", "gap", "taylor_pair", "two_engines"]

# Times between which two engines march on by turns: enough to stop soon after they
# part, few enough for a method's start to cost nothing.
_LEGS: Final = 20
# Tolerance of the second Taylor run: one order less, so with other steps, other
# rounding and a larger truncation, which is still about the rounding's size.
_COARSER: Final = 8.0
#: Engine and method of each of two independent roads, best first.
_ROADS: Final = (
    (("lagrangian", "taylor"), ("lagrangian", "rk853"), ("lagrangian", "dop853")),
    (("pinocchio", "dop853"), ("mujoco", "dop853")),
)


class LateError(Exception):
    """The time is up; never leaves `mbkit.studies`."""


class Deadline:
    """What is left of the time that a search may take, and how far it is.

    Parameters
    ----------
    seconds : float
    tell : callable
        Gets the fraction done.
    """

    def __init__(self, seconds: float, tell: Callable[[float], None]) -> None:
        self._end, self._tell = time.perf_counter() + seconds, tell
        self._start, self._length = 0.0, 1.0
        # Seconds that did not count, of all parts together, and those before this part.
        self._uncounted, self._before = [0.0], 0.0

    @property
    def left(self) -> float:
        """Seconds."""
        return self._end + self._uncounted[0] - self._before - time.perf_counter()

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Do not count the time within, for this and all parts: what is derived and compiled."""
        start = time.perf_counter()
        yield
        self._uncounted[0] += time.perf_counter() - start

    def part(self, start: float, length: float, seconds: float | None = None) -> Deadline:
        """Return the same for a part of the way, with a shorter time of its own if given."""
        out = Deadline(self.left if seconds is None else min(seconds, self.left), self._tell)
        out._uncounted, out._before = self._uncounted, self._uncounted[0]
        out._start, out._length = self._start + start * self._length, length * self._length
        return out

    def look(self, done: float) -> None:
        """Tell the fraction done of this part, and raise `LateError` when its time is up."""
        self._tell(min(self._start + self._length * done, 1.0))
        if self.left < 0:
            raise LateError


@dataclass(frozen=True)
class Motion:
    """What is to be known: start, end, times from 0 and what acts."""

    model: Model
    q0: Array
    v0: Array
    duration: float
    save: Array
    torque: Torque
    given: Any

    @cached_property
    def equations(self) -> Equations:
        """The own derivation, with every number of the model as a symbol."""
        return equations_of(self.model, constants="symbols")

    @property
    def stops(self) -> list[float]:
        """Times at which a held torque jumps, and the end."""
        ends = self.save.tolist() if self.torque.held else []
        return sorted({*ends, self.duration} - {0.0})


@dataclass(frozen=True)
class Known:
    """What a pair of runs says, at as many of the times as both reached.

    Attributes
    ----------
    q, v : pairs (high, low) of (K, nq) and (K, nv) arrays
    apart : (2, K) array
        Largest difference of q and of v between the two.
    how : str
        Which runs these are.
    why : str
        Why they ended before the duration did; empty if they did not.
    steps : int
        Of the first run, 0 if not known.
    shared : bool
        Whether both runs have the same formulas.
    """

    q: tuple[Array, Array]
    v: tuple[Array, Array]
    apart: Array
    how: str
    why: str = ""
    steps: int = 0
    shared: bool = False


def gap(model: Model, a: Any, b: Any) -> Array:
    """Return the largest difference of each pair of configurations, rad or m, from (K, nq) arrays of any format.

    Of two near rotations the angle between them, twice the distance of their quaternions.
    """
    apart = np.asarray(a - b, dtype=np.float64)
    for start, _ in model.quaternions:
        part = slice(start, start + 4)
        both = np.asarray(a[:, part] + b[:, part], dtype=np.float64)
        near = np.minimum(np.linalg.norm(apart[:, part], axis=1), np.linalg.norm(both, axis=1))
        apart[:, part] = 2 * near[:, None]
    return np.asarray(np.abs(apart).max(axis=1, initial=0.0))


def taylor_pair(motion: Motion, bits: int, deadline: Deadline) -> Known:
    """Return what two Taylor runs at different orders say, in a format of so many bits.

    Every number of the model and of the state is the double that it is, exactly.

    Raises
    ------
    UnsupportedError
        No heyoka, no such format, or a model too large.
    """
    kind = precision(bits)
    why = ""
    with deadline.paused():
        system = taylor_system(motion.equations)
    runs: list[list[Any]] = []
    behind = kind.array(motion.equations.constant_values)
    steps = 0
    for i, tolerance in enumerate((kind.eps, _COARSER * kind.eps)):
        half = deadline.part(i / 2, 0.5, None if i else deadline.left / 2)
        with ExitStack() as stack:
            with deadline.paused():
                integrator = stack.enter_context(system.integrator(kind, tolerance))
            stepper = TaylorSteps(system, integrator, kind, behind)
            # The second goes no farther than the first came.
            states, count, early = _states(motion, kind, stepper, half, len(runs[0]) if runs else len(motion.save))
        runs.append(states)
        steps, why = steps or count, why or early
    n, nq = min(map(len, runs)), motion.model.nq
    first, second = (np.stack(states[:n]) for states in runs)
    apart = [gap(motion.model, first[:, :nq], second[:, :nq]), _largest(first[:, nq:] - second[:, nq:])]
    orders = " and ".join(str(order_of(x)) for x in (kind.eps, _COARSER * kind.eps))
    how = f"Taylor series of orders {orders} in {PRECISIONS[bits]} numbers on the own derivation"
    return Known(kind.pair(first[:, :nq]), kind.pair(first[:, nq:]), np.array(apart), how, why, steps, shared=True)


def _states(motion: Motion, kind: Any, steps: TaylorSteps, deadline: Deadline, most: int) -> tuple[list[Any], int, str]:
    """Return up to so many saved states as far as they come, the steps, and why they end early."""
    model, saved = motion.model, motion.save.tolist()[:most]
    y0 = _unit(model, kind.array(np.concatenate([motion.q0, motion.v0])))
    out, count, force = [y0], 0, motion.torque.of_member(None)
    try:
        for t in steps(0.0, y0, motion.stops, force):
            count += 1
            while len(out) < len(saved) and saved[len(out)] <= t:
                out.append(_unit(model, steps.at(saved[len(out)])))
            if len(out) == len(saved):
                break
            deadline.look(t / motion.duration)
    except StoppedError as error:
        return out, count, f"{error} after t = {steps.t:.6g} s"
    except LateError:
        return out, count, f"the time was up at t = {steps.t:.6g} s"
    return out, count, ""


def _unit(model: Model, y: Any) -> Any:
    y = y.copy()
    for start, _ in model.quaternions:
        part = y[start : start + 4]
        y[start : start + 4] = part / np.sqrt((part * part).sum())
    return y


def _largest(x: Any) -> Array:
    return np.asarray(np.abs(np.asarray(x, dtype=np.float64)).max(axis=1, initial=0.0))


def two_engines(motion: Motion, deadline: Deadline) -> Known:
    """Return what two engines say, each with a method of its own, marching by turns until they part.

    Raises
    ------
    UnsupportedError
        There are no two engines that hold the model.
    """
    with deadline.paused():
        roads = [_road(motion, choices) for choices in _ROADS]
    how = " and ".join(f"{method} on {engine}" for engine, method, _ in roads)
    runs = [[motion.q0[None], motion.v0[None]] for _ in roads]
    times, why = motion.save, ""
    ends = np.unique(np.linspace(0, len(times) - 1, min(_LEGS, len(times) - 1) + 1).astype(int))
    for j, (k, end) in enumerate(pairwise(ends.tolist())):
        legs = []
        for i, ((_, method, dyn), (q, v)) in enumerate(zip(roads, runs, strict=True)):
            part = deadline.part((2 * j + i) / (2 * len(ends)), 1 / (2 * len(ends)))
            leg = _leg(motion, dyn, method, q[-1], v[-1], slice(k, end + 1), part)
            if leg is None:
                why = f"the time was up after t = {times[k]:.6g} s"
                break
            if not leg.stats.finished:
                why = f"{method} on {dyn.engine} ended early, within {times[k]:.6g} to {times[end]:.6g} s"
            legs.append(leg)
        if len(legs) < len(roads):
            break
        n = min(len(leg.t) for leg in legs)
        runs = [
            [np.concatenate([q, leg.q[1:n]]), np.concatenate([v, leg.v[1:n]])]
            for (q, v), leg in zip(runs, legs, strict=True)
        ]
        # What has parted for good need not be followed to the end.
        if why or gap(motion.model, runs[0][0][-1:], runs[1][0][-1:])[0] > 1e-6:
            break
    (q, v), (other_q, other_v) = runs
    apart = np.array([gap(motion.model, q, other_q), _largest(v - other_v)])
    return Known((q, np.zeros_like(q)), (v, np.zeros_like(v)), apart, how, why)


def _road(motion: Motion, choices: tuple[tuple[str, str], ...]) -> tuple[str, str, Any]:
    reasons = []
    for engine, method in choices:
        try:
            if motion.torque.callable and not METHODS[method].callables:
                continue
            dyn = dynamics(motion.model, engine)
            # Whether the method is there shows when it is asked for nothing.
            simulate(dyn, motion.q0, motion.v0, 0.0, method)
        except UnsupportedError as error:
            reasons.append(f"{engine}: {error}")
        else:
            return engine, method, dyn
    raise UnsupportedError(f"reference: no independent engine for {motion.model.name}; {'; '.join(reasons)}")


def _leg(motion: Motion, dyn: Any, method: str, q: Array, v: Array, rows: slice, deadline: Deadline) -> Any:
    """Return the motion between two of the saved times, or None when the time is up."""
    times = motion.save[rows]
    start = float(times[0])
    given: Any = motion.given
    if motion.torque.held:
        given = np.asarray(given)[rows.start : rows.stop - 1]
    elif callable(given):
        given = _later(given, start)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MbkitWarning)
            return simulate(
                dyn,
                q,
                v,
                float(times[-1] - start),
                method,
                rtol=METHODS[method].least,
                torque=given,
                save=times - start,
                progress=deadline.look,
            )
    except LateError:
        return None


def _later(function: TorqueFunction, start: float) -> TorqueFunction:
    return lambda t, q, v: function(start + t, q, v)
