"""Reference trajectories, known to a stated number of digits up to a stated time.

Two runs of one motion share no error but that of the description: Taylor series of different orders in extended
precision, or two engines with a method each in double precision. Where they part, the reference ends.
"""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import pairwise
from math import inf
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import EPS, Array, real
from mbkit._escape import one_line
from mbkit.codegen.backend import Machine
from mbkit.codegen.extended_precision import Extended, arithmetic
from mbkit.codegen.program import program
from mbkit.codegen.taylor import PRECISIONS, order_of, precision, taylor_system
from mbkit.derivation import Equations, equations_of
from mbkit.derivation.steps.onto_constraints import thorough_projection
from mbkit.engines import Dynamics, dynamics
from mbkit.engines.applications.random_states import states_of
from mbkit.engines.base import at_time
from mbkit.engines.registry import DERIVED, INDEPENDENT
from mbkit.errors import InputError, MbkitError, UnsupportedError
from mbkit.methods.registry import (
    ADAPTIVE_METHOD,
    METHODS,
    SCIPY_METHOD,
    SCIPY_STIFF_METHOD,
    SERIES_METHOD,
    STIFF_METHOD,
)
from mbkit.model import Model
from mbkit.model.builder import expect_model
from mbkit.simulate import Trajectory
from mbkit.simulate.progress import Progress, ProgressFunction
from mbkit.simulate.run import simulate
from mbkit.simulate.solvers.taylor import TaylorSteps
from mbkit.simulate.solvers.trajectory_record import StoppedError
from mbkit.simulate.time_grid import save_times
from mbkit.simulate.torque import Torque, TorqueFunction
from mbkit.studies.study_runs import Deadline, TooLongError, quiet_simulate

# Pairs of runs of one motion: their difference bounds the error of either.

# Parts of the motion that two engines run by turns, so that they stop soon after they part.
_MAX_STRETCHES: Final = 20
#: Engines and methods of each of two independent runs, best first: all, the quick ones, and those for stiff motion.
_EngineChoices = tuple[tuple[tuple[str, str], ...], ...]
_INDEPENDENT_CHOICES: Final[_EngineChoices] = (
    tuple((DERIVED, method) for method in (SERIES_METHOD, ADAPTIVE_METHOD, SCIPY_METHOD)),
    tuple((engine, SCIPY_METHOD) for engine in INDEPENDENT),
)
_QUICK_CHOICES: Final[_EngineChoices] = (_INDEPENDENT_CHOICES[0][1:], _INDEPENDENT_CHOICES[1])
_STIFF_CHOICES: Final[_EngineChoices] = (
    ((DERIVED, STIFF_METHOD),),
    tuple((engine, SCIPY_STIFF_METHOD) for engine in INDEPENDENT),
)
#: The largest difference of two runs that agree, relative to the size of the motion.
MAX_RELATIVE_GAP: Final = 1e-12
# Two runs that are farther apart than this, rad or m, have parted for good.
_PARTED_GAP: Final = 1e-6


#: (high, low) parts of numbers with twice a double's digits.
Pair = tuple[Array, Array]


@dataclass(frozen=True)
class Motion:
    """The motion: model, start, duration, saved times from 0, and applied torque."""

    model: Model
    q0: Array
    v0: Array
    duration: float
    save: Array
    torque: Torque
    #: The torque as the caller passed it.
    torque_argument: Any

    @cached_property
    def equations(self) -> Equations:
        """The own derivation, with every number of the model as a symbol."""
        return equations_of(self.model, constants="symbols")

    @cached_property
    def start(self) -> tuple[Pair, Pair]:
        """q0 and v0 as pairs of doubles; under constraints the state beside them that holds these to 32 digits."""
        if not self.model.constrained:
            return (self.q0, 0 * self.q0), (self.v0, 0 * self.v0)
        own = arithmetic()
        q, v, *_ = Extended(program(thorough_projection(self.equations, exact=True)), own)(
            *(own.array(x[None]) for x in (self.q0, self.v0)), *self._constants(np.zeros(1))
        )
        return own.pair(q[0, :, 0]), own.pair(v[0, :, 0])

    def gap(self, q: Pair, t: Array) -> Array:
        """Return how far the constraints are open at configurations, (K,), rad or m; zeros without any."""
        if not self.model.constrained:
            return np.zeros(len(t))
        own = arithmetic()
        run = Extended(program(self.equations.function("constraint_residual")), own)
        f, _ = own.pair(run(own.from_pair(*q), *self._constants(t))[0][..., 0])
        return np.asarray(np.abs(f).max(axis=1, initial=0.0))

    def values(self, t: Array) -> Array:
        """Return the values of the equations' numbers at these times, (K, k)."""
        out = np.tile(self.equations.constant_values, (len(t), 1))
        if (clock := self.model.time_parameter) is not None:
            # Parameters stand first among them.
            out[:, [*self.model.parameters].index(clock)] = t
        return out

    def _constants(self, t: Array) -> list[Any]:
        values = self.values(t)
        return [arithmetic().array(values)] if values.size else []

    @property
    def stops(self) -> list[float]:
        """Times at which a held torque jumps, and the end."""
        ends = self.save.tolist() if self.torque.held else []
        return sorted({*ends, self.duration} - {0.0})


@dataclass(frozen=True)
class RunPair:
    """The states of a pair of runs, at the times that both reached: (high, low) parts of (K, nq) and (K, nv) arrays."""

    q: tuple[Array, Array]
    v: tuple[Array, Array]
    #: (2, K), the largest difference of q and of v between the two runs.
    apart: Array
    how: str
    #: Why they ended before the duration did.
    why: str = ""
    #: Steps of the first run, 0 if not known.
    steps: int = 0
    #: Whether both runs have the same formulas.
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


def taylor_pair(motion: Motion, deadline: Deadline, bits: int) -> RunPair:
    """Return two Taylor runs at different orders, in a format of so many bits, from exactly the doubles of the model.

    `UnsupportedError` without heyoka or this format, and for a model too large.
    """
    kind, model, nq = precision(bits), motion.model, motion.model.nq
    with deadline.paused():
        system = taylor_system(motion.equations)
    constants = kind.array(motion.equations.constant_values)
    # One order less: so other steps, rounding and truncation.
    tolerances = kind.eps, 8.0 * kind.eps
    runs: list[list[Any]] = []
    steps, why = 0, ""
    for i, tolerance in enumerate(tolerances):
        half = deadline if i else deadline.part(deadline.left / 2)
        with ExitStack() as stack:
            with deadline.paused():
                integrator = stack.enter_context(system.integrator(kind, tolerance))
            stepper = TaylorSteps(system, integrator, kind, constants)
            # The second goes no farther than the first came.
            states, count, early = _states(motion, kind, stepper, half, len(runs[0]) if runs else len(motion.save))
        runs.append(states)
        steps, why = steps or count, why or early
    first, second = (np.stack(states[: min(map(len, runs))]) for states in runs)
    q, v = kind.pair(first[:, :nq]), kind.pair(first[:, nq:])
    # The same rounding may open the loops of both runs alike.
    opened = motion.gap(q, motion.save[: len(first)])
    apart = [np.maximum(gap(model, first[:, :nq], second[:, :nq]), opened), _largest(first[:, nq:] - second[:, nq:])]
    orders = " and ".join(str(order_of(x)) for x in tolerances)
    how = f"Taylor series of orders {orders} in {PRECISIONS[bits]} numbers on the own derivation"
    return RunPair(q, v, np.array(apart), how, why, steps, shared=True)


def _states(motion: Motion, kind: Any, steps: TaylorSteps, deadline: Deadline, most: int) -> tuple[list[Any], int, str]:
    """Return up to so many saved states as far as they come, the steps, and why they end early."""
    model, saved = motion.model, motion.save.tolist()[:most]
    y0 = _unit(model, kind.array(*(np.concatenate(parts) for parts in zip(*motion.start, strict=True))))
    states, count, force = [y0], 0, motion.torque.of_member(None)
    try:
        for t in steps(0.0, y0, motion.stops, force):
            count += 1
            while len(states) < len(saved) and saved[len(states)] <= t:
                states.append(_unit(model, steps.at(saved[len(states)])))
            if len(states) == len(saved):
                break
            deadline.look(t / motion.duration)
    except StoppedError as error:
        return states, count, f"{error} after t = {steps.t:.6g} s"
    except TooLongError:
        return states, count, f"the seconds allowed for it were used up at t = {steps.t:.6g} s"
    return states, count, ""


def _unit(model: Model, y: Any) -> Any:
    y = y.copy()
    for start, _ in model.quaternions:
        part = y[start : start + 4]
        y[start : start + 4] = part / np.sqrt((part * part).sum())
    return y


def _largest(x: Any) -> Array:
    return np.asarray(np.abs(np.asarray(x, dtype=np.float64)).max(axis=1, initial=0.0))


def two_engines(
    motion: Motion,
    deadline: Deadline,
    choices: _EngineChoices = _INDEPENDENT_CHOICES,
    rtol: float = 0.0,
    parted: float = _PARTED_GAP,
) -> RunPair:
    """Return runs of two engines, each with a method of its own, marching by turns until they part.

    Their tolerance is the least that the methods take, or `rtol`.
    """
    with deadline.paused():
        chosen = [_available_choice(motion, several) for several in choices]
    how = " and ".join(f"{method} on {dyn.engine}" for dyn, method in chosen)
    states = [(motion.q0[None], motion.v0[None]) for _ in chosen]
    times, why = motion.save, ""
    ends = np.unique(np.linspace(0, len(times) - 1, min(_MAX_STRETCHES, len(times) - 1) + 1).astype(int))
    for k, end in pairwise(ends.tolist()):
        stretches: list[Trajectory] = []
        try:
            for (dyn, method), (q, v) in zip(chosen, states, strict=True):
                stretches.append(_stretch(motion, dyn, method, rtol, q[-1], v[-1], slice(k, end + 1), deadline))
                if not stretches[-1].stats.finished:
                    why = f"{method} on {dyn.engine} ended early, within {times[k]:.6g} to {times[end]:.6g} s"
        except TooLongError:
            why = f"the seconds allowed for it were used up after t = {times[k]:.6g} s"
            break
        n = min(len(stretch.t) for stretch in stretches)
        states = [
            (np.concatenate([q, stretch.q[1:n]]), np.concatenate([v, stretch.v[1:n]]))
            for (q, v), stretch in zip(states, stretches, strict=True)
        ]
        # Runs that have parted for good need not be followed to the end.
        if why or gap(motion.model, states[0][0][-1:], states[1][0][-1:])[0] > parted:
            break
    (q, v), (other_q, other_v) = states
    apart = np.array([gap(motion.model, q, other_q), _largest(v - other_v)])
    return RunPair((q, np.zeros_like(q)), (v, np.zeros_like(v)), apart, how, why)


def _available_choice(motion: Motion, choices: tuple[tuple[str, str], ...]) -> tuple[Dynamics, str]:
    reasons = []
    for engine, method in choices:
        try:
            if motion.torque.callable and not METHODS[method].callables:
                continue
            dyn = dynamics(motion.model, engine)
            _require_rigid(dyn)
            # A run of no length shows whether the engine has the method.
            simulate(dyn, motion.q0, motion.v0, 0.0, method)
        except UnsupportedError as error:
            reasons.append(f"{engine}: {error}")
        else:
            return dyn, method
    raise UnsupportedError(f"reference: no independent engine for {motion.model.name}; {'; '.join(reasons)}")


def _require_rigid(dyn: Dynamics) -> None:
    """Refuse an engine whose loops give way: its motion is another one."""
    if dyn.model.constrained and dyn._soft_constraints:
        raise UnsupportedError(f"{dyn.engine} holds loops softly")


def _stretch(
    motion: Motion, dyn: Dynamics, method: str, rtol: float, q: Array, v: Array, rows: slice, deadline: Deadline
) -> Trajectory:
    """Return the motion between two of the saved times."""
    times, torque = motion.save[rows], motion.torque_argument
    if motion.torque.held:
        torque = np.asarray(torque)[rows.start : rows.stop - 1]
    start, length = float(times[0]), float(times[-1] - times[0])
    settings = {"torque": torque, "save": times, "t0": start, "rtol": max(METHODS[method].least, rtol)}
    return quiet_simulate(dyn, q, v, length, method, progress=deadline.look, **settings)


# The floor over the difference of two runs: errors partly cancel in it, and by more digits a run was up to three times
# as wrong.
_FLOOR_PER_GAP: Final = 4.0
# A small system's steps per second of motion: a guess before there is a run.
_TYPICAL_STEPS_PER_SECOND: Final = 40.0


@dataclass(frozen=True, eq=False)
class Reference:
    """A motion as far as it is known; arrays are read-only.

    Attributes
    ----------
    t : (K,) array
        The times of `save`, up to `horizon`; s.
    q, v : (K, nq) and (K, nv) arrays
        Rounded to double.
    q_low, v_low : (K, nq) and (K, nv) arrays
        What rounding left: q + q_low has the reference's own digits.
    floor : (K,) array
        How well q is known, rad or m: four times the largest difference between the two runs so far, and what
        rounding to double takes away.
    digits : float
        Least number of digits of q + q_low and v + v_low, relative to the size of the motion.
    scale : (float, float)
        The size of the motion: the farthest that a coordinate gets from its start, rad or m, and the largest velocity.
    horizon : float
        The last of the times up to which both runs agree to 1e-12 of the size of the motion, in q and in v; s.
    how : str
        How it was computed, and why it ends where it ends.
    """

    t: Array
    q: Array
    v: Array
    q_low: Array
    v_low: Array
    floor: Array
    digits: float
    scale: tuple[float, float]
    horizon: float
    how: str

    def __post_init__(self) -> None:
        for name in ("t", "q", "v", "q_low", "v_low", "floor"):
            array = np.array(getattr(self, name), dtype=np.float64)
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        # Arrays come out of a pickle writeable; the constructor makes them read-only again.
        return type(self), tuple(getattr(self, f.name) for f in fields(self))

    def __repr__(self) -> str:
        return f"<Reference to t = {self.horizon:g} s, {self.digits:.1f} digits: {self.how}>"


def reference(
    model: Model,
    q0: ArrayLike,
    v0: ArrayLike,
    duration: float,
    save: ArrayLike,
    torque: ArrayLike | TorqueFunction | None = None,
    *,
    seconds: float = 30.0,
    wanted: float = MAX_RELATIVE_GAP,
    agree: float = MAX_RELATIVE_GAP,
    progress: bool | ProgressFunction | None = None,
) -> Reference:
    """Return the motion from a state, known to 12 digits or cut where it is not.

    Parameters
    ----------
    model : Model
        Whose named parameters have values.
    q0, v0 : (nq,) and (nv,) array_like
    duration : float
        s.
    save : (K,) array_like
        Increasing times within the duration, s; 0 is added if it is not among them.
    torque : array_like or callable, optional
        (nv,), held all the time; (K - 1, nv), held over each interval of `save`, which then runs from 0 to `duration`;
        or a function of (t, q, v), for which only two engines make a reference, as for forces that jump.
    seconds : float
        Limit of the search's processor time, without derivation and compilation. The best reference by then is
        returned.
    wanted, agree : float
        How well two runs agree, relative to the size of the motion, where the search ends; and at the least, for beyond
        it the reference is cut. With less than 12 digits wanted, two engines are asked first, explicit methods and then
        methods for stiff motion.
    progress : bool or callable, optional
        As in `mbkit.simulate`.

    Raises
    ------
    InputError, UnsupportedError
        Unusable arguments, such as a start at which a loop is open; neither heyoka nor two engines for this model.

    Notes
    -----
    In this order, until one holds to the end: Taylor series in quadruple precision, if its cost is small beside
    `seconds`; in 80-bit numbers, 2000 times finer than double and some 30 times faster than quadruple ones; in
    quadruple precision, if there is time; Taylor series (or an embedded Runge-Kutta pair) in double on the own
    derivation beside DOP853 on another engine. Series share the derivation's formulas, so the accelerations along them
    are compared with another engine's.

    Under constraints the start is the state beside q0 and v0 that holds them to 32 digits. The series hold f̈ = 0 with
    the digits of their numbers, and how far the loops open on the way counts as an error of the reference.

    Examples
    --------
    >>> import mbkit as mb
    >>> from mbkit.studies.reference_motions import reference
    >>> truth = reference(mb.catalog.pendulum(), [1.0], [0.0], 2.0, [0.0, 1.0, 2.0])
    >>> truth.horizon
    2.0
    """
    motion = checked_motion(model, q0, v0, duration, save, torque)
    seconds = real("seconds", seconds, positive=True)
    if not motion.duration or not model.nv:
        return _at_rest(motion)
    with Progress(progress, f"{model.name}: reference") as bar:
        pairs, refused = _search(motion, Deadline(seconds, bar.update, time.thread_time), seconds, wanted, agree)
        bar.update(1.0)
    if not pairs:
        raise UnsupportedError(f"reference: {'; '.join(refused)}")
    # The one that holds longest, and of those the best.
    cut = ((_cut(motion, known, agree), known) for known in pairs)
    best, known = max(cut, key=lambda pair: (pair[0].horizon, pair[0].digits))
    return replace(best, how=best.how + _accelerations_text(motion, best)) if known.shared else best


def checked_motion(
    model: Model, q0: ArrayLike, v0: ArrayLike, duration: float, save: ArrayLike, torque: Any = None
) -> Motion:
    """Return a motion from checked arguments; see `reference`."""
    expect_model(model)
    model.require_values("a reference")
    q, v = model.check_q(q0, "q0"), model.check_v(v0, "v0")
    if q.ndim != 1 or v.ndim != 1:
        raise InputError(f"q0, v0: expected one state, got shapes {q.shape} and {v.shape}; give one after the other")
    if model.constrained:
        states_of(model).manifold.at(0.0).check(q, v)
        model.require_independent(q)
    duration = real("duration", duration, nonnegative=True)
    times = save_times(save, 0.0, duration)
    whole = times[0] == 0 and times[-1] == duration
    read = Torque(torque, model, None, len(times) - 1 if whole else None)
    times = times if times[0] == 0 else np.concatenate([[0.0], times])
    return Motion(model, q, v, duration, times, read, torque)


def _at_rest(motion: Motion) -> Reference:
    t = motion.save
    q, v, floor = np.tile(motion.q0, (len(t), 1)), np.tile(motion.v0, (len(t), 1)), np.zeros(len(t))
    how = "the initial state, since nothing moves"
    return Reference(t, q, v, 0 * q, 0 * v, floor, inf, (1.0, 1.0), float(t[-1]), how)


def _search(
    motion: Motion, deadline: Deadline, seconds: float, wanted: float, agree: float
) -> tuple[list[RunPair], list[str]]:
    pairs: list[RunPair] = []
    refused: list[str] = []

    def holds(way: Any, *more: Any, within: float = inf) -> bool:
        # A way shows only at its end whether it leads there.
        try:
            pairs.append(way(motion, deadline.part(within), *more))
        except UnsupportedError as error:
            refused.append(str(error))
            return False
        return bool(_cut(motion, pairs[-1], wanted).horizon == motion.save[-1])

    if wanted > MAX_RELATIVE_GAP:
        for choices, rtol, part in (
            (_QUICK_CHOICES, 0.0, 0.25),
            # A tolerance below a thousandth of the wanted error costs methods for stiff motion dear.
            (_STIFF_CHOICES, 1e-3 * wanted, 0.75),
        ):
            if holds(two_engines, choices, rtol, max(agree, _PARTED_GAP), within=part * deadline.left):
                return pairs, refused
        # Series need seconds to derive and compile, which the search does not count.
        if deadline.left < 5.0:
            return pairs, refused
    # A series cannot follow jumps; runs follow them phase by phase.
    if not (motion.torque.callable or "jump" in motion.model.effects):
        small = _quadruple_seconds(motion, _TYPICAL_STEPS_PER_SECOND * motion.duration) < seconds / 6
        if small and holds(taylor_pair, 113, within=seconds / 2):
            return pairs, refused
        if holds(taylor_pair, 64):
            return pairs, refused
        steps = pairs[-1].steps if pairs else _TYPICAL_STEPS_PER_SECOND * motion.duration
        if not small and _quadruple_seconds(motion, steps) < deadline.left:
            holds(taylor_pair, 113)
    if not pairs:
        # Double is never better than more digits.
        holds(two_engines)
    return pairs, refused


def _quadruple_seconds(motion: Motion, steps: float) -> float:
    """Return about how long two runs of so many steps take in quadruple precision, s; infinite without it."""
    try:
        order, operations = order_of(precision(113).eps), taylor_system(motion.equations).operations
    except UnsupportedError:
        return inf
    # Two runs, at so many seconds per operation, order² and step in quadruple precision.
    return 2 * steps * operations * order**2 * 1e-8


def _cut(motion: Motion, known: RunPair, agree: float) -> Reference:
    """Return the reference from a pair of runs, up to where they part."""
    model, (q, q_low), (v, v_low) = motion.model, known.q, known.v
    moved = gap(model, q, np.broadcast_to(q[:1], q.shape))
    # A motion at rest has no size; it is then known absolutely.
    scale = float(moved.max()) or 1.0, float(np.abs(v).max()) or 1.0
    apart = np.maximum.accumulate(known.apart, axis=1)
    relative = np.max(apart / np.array(scale)[:, None], axis=0)
    holds = relative <= agree
    n = len(holds) if holds.all() else int(np.argmin(holds))
    end = float(motion.save[n - 1])
    # A pair of doubles has 106 bits of a number that can be somewhat larger than the motion.
    worst = max(float(relative[:n].max()), 2.0**-105)
    how = f"{known.how}, which agree to {worst:.1e} of the motion"
    if n < len(motion.save):
        why = known.why if n == len(q) else f"beyond, they part to {relative[n]:.1e} at t = {motion.save[n]:.6g} s"
        how += f" until t = {end:.6g} s, where the reference ends: {why}"
    size = np.abs(q[:n]).max(axis=1, initial=0.0)
    return Reference(
        t=motion.save[:n],
        q=q[:n],
        v=v[:n],
        q_low=q_low[:n],
        v_low=v_low[:n],
        floor=_FLOOR_PER_GAP * apart[0, :n] + 0.5 * EPS * size,
        digits=float(-np.log10(_FLOOR_PER_GAP * worst)),
        scale=scale,
        horizon=end,
        how=how,
    )


def _accelerations_text(motion: Motion, best: Reference) -> str:
    """Return a text that compares accelerations along a motion with those of another engine."""
    which = np.unique(np.linspace(0, len(best.t) - 1, min(64, len(best.t))).astype(int))
    q, v = best.q[which], best.v[which]
    force, last = motion.torque.of_member(None), max(len(motion.stops) - 1, 0)
    tau = np.array([force(min(int(k), last)) for k in which])
    constants = [motion.values(best.t[which])] if len(motion.equations.constant_values) else []
    a = Machine(motion.equations.function("forward_dynamics"))(q, v, tau, *constants)[0][..., 0]
    failed = []
    for engine in INDEPENDENT:
        try:
            dyn = dynamics(motion.model, engine)
            _require_rigid(dyn)
            other = _accelerations(dyn, best.t[which], q, v, tau)
        except MbkitError as error:
            failed.append(one_line(str(error), 120))
            continue
        apart = np.abs(a - other).max() / (np.abs(a).max() or 1.0)
        return f"; accelerations along it differ by {apart:.1e} from those of {engine}"
    reasons = "; ".join(failed)
    return f"; no other engine gives its accelerations, so that no other derivation checked its formulas ({reasons})"


def _accelerations(dyn: Dynamics, t: Array, q: Array, v: Array, tau: Array) -> Array:
    if dyn.model.time_parameter is None:
        return np.asarray(dyn.forward_dynamics(q, v, tau))
    states = zip(t.tolist(), q, v, tau, strict=True)
    return np.array([at_time(dyn, time).forward_dynamics(*state) for time, *state in states])
