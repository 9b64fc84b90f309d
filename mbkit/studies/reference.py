"""A trajectory that others are measured by, known to a stated number of digits for a stated time.

Two runs of one motion are made so that they share no error but the description: in
extended precision by Taylor series of different orders, or in double by two engines
with a method each. Where they stop agreeing, because of chaos or because one gave up,
the reference ends and says so.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, real
from mbkit.derivation.machine import Machine
from mbkit.derivation.taylor import order_of, precision, taylor_system
from mbkit.engines import dynamics
from mbkit.engines.base import require_tree
from mbkit.errors import InputError, MbkitError, UnsupportedError
from mbkit.model import Model
from mbkit.model.expected import expect_model
from mbkit.simulate.applied import TorqueFunction
from mbkit.simulate.grid import save_times
from mbkit.simulate.progress import Progress, ProgressFunction
from mbkit.simulate.torque import Torque
from mbkit.studies.reference_runs import Deadline, Known, Motion, gap, taylor_pair, two_engines

__all__ = ["Reference", "reference"]

#: How well two runs must agree, relative to the size of the motion.
AGREE: Final = 1e-12
# The errors of two runs can partly cancel in their difference: measured against more
# digits, either was up to three times as wrong as they were apart.
_SAFETY: Final = 4.0
# Quadruple numbers cost about this many seconds per operation, order² and step.
_QUADRUPLE: Final = 1.0e-8
# Steps per second of motion that a small system takes: a guess before there is a run.
_STEPS: Final = 40.0
# States at which accelerations are compared.
_WITNESSED: Final = 64
# Two doubles hold 106 bits of a number, which can be somewhat larger than the motion.
_PAIR: Final = 2.0**-105
_EPS: Final = float(np.finfo(np.float64).eps)


@dataclass(frozen=True, eq=False)
class Reference:
    """A motion as far as it is known; arrays are read-only.

    Attributes
    ----------
    t : (K,) array
        The times asked for, up to `horizon`; s.
    q : (K, nq) array
    v : (K, nv) array
        Rounded to double.
    q_low, v_low : (K, nq) and (K, nv) arrays
        What rounding left: q + q_low has the reference's own digits.
    floor : (K,) array
        How well q is known, rad or m: four times the largest difference between the
        two runs so far, and what rounding to double takes away.
    digits : float
        How many digits q + q_low and v + v_low have at the least, relative to the size
        of the motion.
    scale : (float, float)
        The size of the motion: the farthest that a coordinate gets from its start
        (rad or m, of mixed coordinates their largest number), and the largest velocity.
    horizon : float
        The last of the times up to which both runs agree to 1e-12 of the size of
        the motion, in q and in v; s.
    how : str
        How it was made, and why it ends where it ends, for a report.
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
        # Arrays come out of a pickle writeable, unless they are made read-only anew.
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
    progress: bool | ProgressFunction | None = None,
) -> Reference:
    """Return the motion from a state, known to 12 digits or cut where it is not.

    Parameters
    ----------
    model : Model
        Whose named parameters have values.
    q0 : (nq,) array_like
    v0 : (nv,) array_like
    duration : float
        s.
    save : (K,) array_like
        Increasing times within the duration, s; 0 is added if it is not among them.
    torque : array_like or callable, optional
        (nv,), held all the time; (K - 1, nv), held over each interval of `save`,
        which then runs from 0 to `duration`; or a function of (t, q, v), for which
        only two engines make a reference.
    seconds : float
        How long the search may take, without what is derived and compiled. What is known by then is
        returned.
    progress : bool or callable, optional
        As in `mbkit.simulate`.

    Returns
    -------
    Reference

    Raises
    ------
    InputError
        A wrong shape, state, time or torque.
    UnsupportedError
        Neither heyoka nor two engines for this model are at hand, or it has loops or prescribed motions.

    Notes
    -----
    In this order, until one holds to the end: Taylor series in quadruple precision, if
    its cost is small beside `seconds`; in 80-bit numbers, 2000 times finer than double
    and some 30 times faster than quadruple ones; in quadruple precision, if there is
    time; Taylor series (or an embedded Runge-Kutta pair) in double on the own derivation
    beside DOP853 on another engine. Series share the derivation's formulas, so the
    accelerations along them are compared with another engine's.

    Examples
    --------
    >>> import mbkit as mb
    >>> from mbkit.studies.reference import reference
    >>> truth = reference(mb.catalog.pendulum(), [1.0], [0.0], 2.0, [0.0, 1.0, 2.0])
    >>> truth.horizon
    2.0
    """
    motion = _checked(model, q0, v0, duration, save, torque)
    seconds = real("seconds", seconds, positive=True)
    if not motion.duration or not model.nv:
        return _nothing_moves(motion)
    with Progress(progress, f"{model.name}: reference") as bar:
        deadline = Deadline(seconds, bar.update)
        found, refused = _search(motion, deadline, seconds)
        bar.update(1.0)
    if not found:
        raise UnsupportedError(f"reference: {'; '.join(refused)}")
    # The one that holds longest, and of those the first.
    best, known = max(((_cut(motion, known), known) for known in found), key=lambda pair: pair[0].horizon)
    return replace(best, how=best.how + _witness(motion, best)) if known.shared else best


def _checked(model: Model, q0: ArrayLike, v0: ArrayLike, duration: float, save: ArrayLike, torque: Any) -> Motion:
    expect_model(model)
    model.require_values("a reference")
    require_tree(model, "reference")
    q, v = model.check_q(q0, "q0"), model.check_v(v0, "v0")
    if q.ndim != 1 or v.ndim != 1:
        raise InputError(f"q0, v0: expected one state, got shapes {q.shape} and {v.shape}; give one after the other")
    duration = real("duration", duration, nonnegative=True)
    times = save_times(save, 0.0, duration)
    whole = times[0] == 0 and times[-1] == duration
    read = Torque(torque, model, None, len(times) - 1 if whole else None)
    times = times if times[0] == 0 else np.concatenate([[0.0], times])
    return Motion(model, q, v, duration, times, read, torque)


def _nothing_moves(motion: Motion) -> Reference:
    shape = len(motion.save), 1
    q, v = np.tile(motion.q0, shape), np.tile(motion.v0, shape)
    floor = np.zeros(len(q))
    how = "the given state, since nothing moves"
    return Reference(motion.save, q, v, 0 * q, 0 * v, floor, float("inf"), (1.0, 1.0), float(motion.save[-1]), how)


def _search(motion: Motion, deadline: Deadline, seconds: float) -> tuple[list[Known], list[str]]:
    found: list[Known] = []
    refused: list[str] = []

    def look(way: Any, *given: Any, within: float | None = None) -> bool:
        # Whether a way leads to the end is known at its end: the first gets half of the bar.
        tried = len(found) + len(refused)
        part = deadline.part(1 - 0.5**tried, 0.5 ** (tried + 1), within)
        try:
            found.append(way(motion, *given, part))
        except UnsupportedError as error:
            refused.append(str(error))
            return False
        return bool(_cut(motion, found[-1]).horizon == motion.save[-1])

    if not motion.torque.callable:
        small = _quadruple_seconds(motion, _STEPS * motion.duration) < seconds / 6
        if small and look(taylor_pair, 113, within=seconds / 2):
            return found, refused
        if look(taylor_pair, 64):
            return found, refused
        steps = found[-1].steps if found else _STEPS * motion.duration
        if not small and _quadruple_seconds(motion, steps) < deadline.left:
            look(taylor_pair, 113)
    if not found:
        # Double is never better than what was found with more.
        look(two_engines)
    return found, refused


def _quadruple_seconds(motion: Motion, steps: float) -> float:
    """Return about how long two runs of so many steps take in quadruple precision; infinite where there is none."""
    try:
        order, operations = order_of(precision(113).eps), taylor_system(motion.equations).operations
    except UnsupportedError:
        return float("inf")
    return 2 * steps * operations * order**2 * _QUADRUPLE


def _cut(motion: Motion, known: Known) -> Reference:
    """Return what a pair of runs says, up to where they part."""
    model, (q, q_low), (v, v_low) = motion.model, known.q, known.v
    moved = gap(model, q, np.broadcast_to(q[:1], q.shape))
    # What rests has no size; it is then known absolutely.
    scale = float(moved.max()) or 1.0, float(np.abs(v).max()) or 1.0
    apart = np.maximum.accumulate(known.apart, axis=1)
    relative = np.max(apart / np.array(scale)[:, None], axis=0)
    holds = relative <= AGREE
    n = len(holds) if holds.all() else int(np.argmin(holds))
    end = float(motion.save[n - 1])
    worst = max(float(relative[:n].max()), _PAIR)
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
        floor=_SAFETY * apart[0, :n] + 0.5 * _EPS * size,
        digits=float(-np.log10(_SAFETY * worst)),
        scale=scale,
        horizon=end,
        how=how,
    )


def _witness(motion: Motion, found: Reference) -> str:
    """Return what another engine says of the formulas along a motion."""
    which = np.unique(np.linspace(0, len(found.t) - 1, min(_WITNESSED, len(found.t))).astype(int))
    q, v = found.q[which], found.v[which]
    force, last = motion.torque.of_member(None), max(len(motion.stops) - 1, 0)
    tau = np.array([force(min(int(k), last)) for k in which])
    constants = np.broadcast_to(motion.equations.constant_values, (len(q), len(motion.equations.constant_values)))
    own = Machine(motion.equations.function("forward_dynamics"))
    a = own(q, v, tau, *([constants] if constants.size else []))[0][..., 0]
    for engine in ("pinocchio", "mujoco"):
        try:
            other = dynamics(motion.model, engine).forward_dynamics(q, v, tau)
        except MbkitError:
            continue
        apart = np.abs(a - other).max() / (np.abs(a).max() or 1.0)
        return f"; accelerations along it differ by {apart:.1e} from those of {engine}"
    return "; no other engine holds the model, so nobody but the own derivation vouches for its formulas"
